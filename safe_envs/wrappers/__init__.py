"""What keeps an env safe: conditions, their QPs, the safety filter and its gym wrappers."""

from safe_envs.wrappers import conditions
from safe_envs.wrappers.conditions import *  # noqa: F403
from safe_envs.wrappers.delayed_filter import DelayedFilter
from safe_envs.wrappers.env_wrappers.cost_return import (
    CostReturnWrapper,
    make_vec_with_cost,
    make_with_cost,
)
from safe_envs.wrappers.env_wrappers.external_env import ActionMap, FilterSpec
from safe_envs.wrappers.env_wrappers.monitor import SafetyMonitor
from safe_envs.wrappers.env_wrappers.monitor_vector import SafetyMonitorVector
from safe_envs.wrappers.env_wrappers.safety_filter import SafetyFilterWrapper
from safe_envs.wrappers.env_wrappers.safety_filter_vector import SafetyFilterVectorWrapper
from safe_envs.wrappers.env_wrappers.safety_statistics import (
    RecordSafetyStatistics,
    RecordSafetyStatisticsVector,
)
from safe_envs.wrappers.env_wrappers.specification_monitor import SpecificationMonitor
from safe_envs.wrappers.env_wrappers.specification_monitor_vector import SpecificationMonitorVector
from safe_envs.wrappers.filter_qp import FilterDecision
from safe_envs.wrappers.safety_filter import SafetyFilter

__all__ = [
    "ActionMap",
    "CostReturnWrapper",
    "DelayedFilter",
    "FilterDecision",
    "FilterSpec",
    "RecordSafetyStatistics",
    "RecordSafetyStatisticsVector",
    "SafetyFilter",
    "SafetyFilterVectorWrapper",
    "SafetyFilterWrapper",
    "SafetyMonitor",
    "SafetyMonitorVector",
    "SpecificationMonitor",
    "SpecificationMonitorVector",
    "make_vec_with_cost",
    "make_with_cost",
]
__all__ += conditions.__all__

if __name__ == "wrappers":  # imported through the link at the top level of a checkout
    from safe_envs.checkout_links import redirect

    redirect(__name__)
