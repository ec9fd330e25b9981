"""What keeps an env safe: conditions, their QPs, the safety filter and its gym wrappers.

What is named here is imported when it is first used.
"""

from typing import TYPE_CHECKING

from safe_envs.lazy_attributes import lazy_attributes

if TYPE_CHECKING:
    from safe_envs.wrappers.conditions.base import Condition
    from safe_envs.wrappers.conditions.bayesian import BayesianSCBF
    from safe_envs.wrappers.conditions.cbf import CBF, ECBF, HOCBF
    from safe_envs.wrappers.conditions.certified import Certified
    from safe_envs.wrappers.conditions.class_k import ClassK, power
    from safe_envs.wrappers.conditions.constraint import AffineConstraint
    from safe_envs.wrappers.conditions.learned import DDSCBF, LearnedCondition, LearnedHOCBF
    from safe_envs.wrappers.conditions.names import condition_names
    from safe_envs.wrappers.conditions.reciprocal import RCBF, SRCBF
    from safe_envs.wrappers.conditions.registry import CONDITIONS, LEARNED
    from safe_envs.wrappers.conditions.spec_text import (
        parse_condition,
        parse_conditions,
        require_readable,
        spec_of,
    )
    from safe_envs.wrappers.conditions.stochastic import SCBF, SZCBF
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
    from safe_envs.wrappers.filter_qp import FilterDecision
    from safe_envs.wrappers.safety_filter import SafetyFilter

__all__ = [
    "CBF",
    "CONDITIONS",
    "DDSCBF",
    "ECBF",
    "HOCBF",
    "LEARNED",
    "RCBF",
    "SCBF",
    "SRCBF",
    "SZCBF",
    "ActionMap",
    "AffineConstraint",
    "BayesianSCBF",
    "Certified",
    "ClassK",
    "Condition",
    "CostReturnWrapper",
    "DelayedFilter",
    "FilterDecision",
    "FilterSpec",
    "LearnedCondition",
    "LearnedHOCBF",
    "RecordSafetyStatistics",
    "RecordSafetyStatisticsVector",
    "SafetyFilter",
    "SafetyFilterVectorWrapper",
    "SafetyFilterWrapper",
    "SafetyMonitor",
    "SafetyMonitorVector",
    "SpecificationMonitor",
    "SpecificationMonitorVector",
    "condition_names",
    "make_vec_with_cost",
    "make_with_cost",
    "parse_condition",
    "parse_conditions",
    "power",
    "require_readable",
    "spec_of",
]

_MODULES = {
    "ActionMap": "safe_envs.wrappers.env_wrappers.external_env",
    "AffineConstraint": "safe_envs.wrappers.conditions.constraint",
    "BayesianSCBF": "safe_envs.wrappers.conditions.bayesian",
    "CBF": "safe_envs.wrappers.conditions.cbf",
    "CONDITIONS": "safe_envs.wrappers.conditions.registry",
    "Certified": "safe_envs.wrappers.conditions.certified",
    "ClassK": "safe_envs.wrappers.conditions.class_k",
    "Condition": "safe_envs.wrappers.conditions.base",
    "CostReturnWrapper": "safe_envs.wrappers.env_wrappers.cost_return",
    "DDSCBF": "safe_envs.wrappers.conditions.learned",
    "DelayedFilter": "safe_envs.wrappers.delayed_filter",
    "ECBF": "safe_envs.wrappers.conditions.cbf",
    "FilterDecision": "safe_envs.wrappers.filter_qp",
    "FilterSpec": "safe_envs.wrappers.env_wrappers.external_env",
    "HOCBF": "safe_envs.wrappers.conditions.cbf",
    "LEARNED": "safe_envs.wrappers.conditions.registry",
    "LearnedCondition": "safe_envs.wrappers.conditions.learned",
    "LearnedHOCBF": "safe_envs.wrappers.conditions.learned",
    "RCBF": "safe_envs.wrappers.conditions.reciprocal",
    "RecordSafetyStatistics": "safe_envs.wrappers.env_wrappers.safety_statistics",
    "RecordSafetyStatisticsVector": "safe_envs.wrappers.env_wrappers.safety_statistics",
    "SCBF": "safe_envs.wrappers.conditions.stochastic",
    "SRCBF": "safe_envs.wrappers.conditions.reciprocal",
    "SZCBF": "safe_envs.wrappers.conditions.stochastic",
    "SafetyFilter": "safe_envs.wrappers.safety_filter",
    "SafetyFilterVectorWrapper": "safe_envs.wrappers.env_wrappers.safety_filter_vector",
    "SafetyFilterWrapper": "safe_envs.wrappers.env_wrappers.safety_filter",
    "SafetyMonitor": "safe_envs.wrappers.env_wrappers.monitor",
    "SafetyMonitorVector": "safe_envs.wrappers.env_wrappers.monitor_vector",
    "SpecificationMonitor": "safe_envs.wrappers.env_wrappers.specification_monitor",
    "SpecificationMonitorVector": "safe_envs.wrappers.env_wrappers.specification_monitor_vector",
    "condition_names": "safe_envs.wrappers.conditions.names",
    "make_vec_with_cost": "safe_envs.wrappers.env_wrappers.cost_return",
    "make_with_cost": "safe_envs.wrappers.env_wrappers.cost_return",
    "parse_condition": "safe_envs.wrappers.conditions.spec_text",
    "parse_conditions": "safe_envs.wrappers.conditions.spec_text",
    "power": "safe_envs.wrappers.conditions.class_k",
    "require_readable": "safe_envs.wrappers.conditions.spec_text",
    "spec_of": "safe_envs.wrappers.conditions.spec_text",
}

__getattr__, __dir__ = lazy_attributes(__name__, _MODULES, globals())

if __name__ == "wrappers":  # imported through the link at the top level of a checkout
    from safe_envs.checkout_links import redirect

    redirect(__name__)
