"""What keeps an env safe: conditions, their QPs, the safety filter and its gym wrappers.

What is named here is imported when it is first used.
"""

from typing import TYPE_CHECKING

from safe_envs.lazy_attributes import lazy_attributes
from safe_envs.wrappers import conditions

if TYPE_CHECKING:
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
    from safe_envs.wrappers.env_wrappers.specification_monitor_vector import (
        SpecificationMonitorVector,
    )
    from safe_envs.wrappers.env_wrappers.state_estimator import StateEstimatorWrapper
    from safe_envs.wrappers.env_wrappers.state_estimator_vector import StateEstimatorVectorWrapper
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
    "StateEstimatorVectorWrapper",
    "StateEstimatorWrapper",
    "make_vec_with_cost",
    "make_with_cost",
]
__all__ += conditions.__all__

_MODULES = {
    **dict.fromkeys(conditions.__all__, conditions.__name__),
    "ActionMap": "safe_envs.wrappers.env_wrappers.external_env",
    "CostReturnWrapper": "safe_envs.wrappers.env_wrappers.cost_return",
    "DelayedFilter": "safe_envs.wrappers.delayed_filter",
    "FilterDecision": "safe_envs.wrappers.filter_qp",
    "FilterSpec": "safe_envs.wrappers.env_wrappers.external_env",
    "RecordSafetyStatistics": "safe_envs.wrappers.env_wrappers.safety_statistics",
    "RecordSafetyStatisticsVector": "safe_envs.wrappers.env_wrappers.safety_statistics",
    "SafetyFilter": "safe_envs.wrappers.safety_filter",
    "SafetyFilterVectorWrapper": "safe_envs.wrappers.env_wrappers.safety_filter_vector",
    "SafetyFilterWrapper": "safe_envs.wrappers.env_wrappers.safety_filter",
    "SafetyMonitor": "safe_envs.wrappers.env_wrappers.monitor",
    "SafetyMonitorVector": "safe_envs.wrappers.env_wrappers.monitor_vector",
    "SpecificationMonitor": "safe_envs.wrappers.env_wrappers.specification_monitor",
    "SpecificationMonitorVector": "safe_envs.wrappers.env_wrappers.specification_monitor_vector",
    "StateEstimatorVectorWrapper": "safe_envs.wrappers.env_wrappers.state_estimator_vector",
    "StateEstimatorWrapper": "safe_envs.wrappers.env_wrappers.state_estimator",
    "make_vec_with_cost": "safe_envs.wrappers.env_wrappers.cost_return",
    "make_with_cost": "safe_envs.wrappers.env_wrappers.cost_return",
}

__getattr__, __dir__ = lazy_attributes(__name__, _MODULES, globals())

if __name__ == "wrappers":  # imported through the link at the top level of a checkout
    from safe_envs.checkout_links import redirect

    redirect(__name__)
