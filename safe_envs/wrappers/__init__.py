"""What keeps an env safe: conditions, their QPs, the safety filter and its gym wrappers.

What is named here is imported when it is first used.
"""

from typing import TYPE_CHECKING

from safe_envs.filters import conditions
from safe_envs.lazy_attributes import lazy_attributes

if TYPE_CHECKING:
    from safe_envs.filters.conditions import *  # noqa: F403
    from safe_envs.filters.delayed_filter import DelayedFilter
    from safe_envs.filters.qp import FilterDecision
    from safe_envs.filters.safety_filter import SafetyFilter
    from safe_envs.wrappers.estimator import StateEstimatorVectorWrapper, StateEstimatorWrapper
    from safe_envs.wrappers.external_env import ActionMap, FilterSpec
    from safe_envs.wrappers.monitor import SafetyMonitor, SafetyMonitorVector
    from safe_envs.wrappers.safety_filter import SafetyFilterVectorWrapper, SafetyFilterWrapper
    from safe_envs.wrappers.specification import SpecificationMonitor, SpecificationMonitorVector
    from safe_envs.wrappers.statistics import (
        CostReturnWrapper,
        RecordSafetyStatistics,
        RecordSafetyStatisticsVector,
        make_vec_with_cost,
        make_with_cost,
    )


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
    "ActionMap": "safe_envs.wrappers.external_env",
    "CostReturnWrapper": "safe_envs.wrappers.statistics",
    "DelayedFilter": "safe_envs.filters.delayed_filter",
    "FilterDecision": "safe_envs.filters.qp",
    "FilterSpec": "safe_envs.wrappers.external_env",
    "RecordSafetyStatistics": "safe_envs.wrappers.statistics",
    "RecordSafetyStatisticsVector": "safe_envs.wrappers.statistics",
    "SafetyFilter": "safe_envs.filters.safety_filter",
    "SafetyFilterVectorWrapper": "safe_envs.wrappers.safety_filter",
    "SafetyFilterWrapper": "safe_envs.wrappers.safety_filter",
    "SafetyMonitor": "safe_envs.wrappers.monitor",
    "SafetyMonitorVector": "safe_envs.wrappers.monitor",
    "SpecificationMonitor": "safe_envs.wrappers.specification",
    "SpecificationMonitorVector": "safe_envs.wrappers.specification",
    "StateEstimatorVectorWrapper": "safe_envs.wrappers.estimator",
    "StateEstimatorWrapper": "safe_envs.wrappers.estimator",
    "make_vec_with_cost": "safe_envs.wrappers.statistics",
    "make_with_cost": "safe_envs.wrappers.statistics",
}

__getattr__, __dir__ = lazy_attributes(__name__, _MODULES, globals())

if __name__ == "wrappers":  # imported through the link at the top level of a checkout
    from safe_envs.checkout_links import redirect

    redirect(__name__)
