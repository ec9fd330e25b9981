"""What keeps an env safe: conditions, their QPs, the safety filter and its gym wrappers."""

from safe_envs.wrappers.conditions import (
    CBF,
    CONDITIONS,
    DDSCBF,
    ECBF,
    HOCBF,
    LEARNED,
    RCBF,
    SCBF,
    SRCBF,
    SZCBF,
    AffineConstraint,
    BayesianSCBF,
    ClassK,
    Condition,
    LearnedCondition,
    LearnedHOCBF,
    condition_names,
    parse_condition,
    parse_conditions,
    power,
    require_readable,
    spec_of,
)
from safe_envs.wrappers.env_wrappers.external_env import ActionMap, FilterSpec
from safe_envs.wrappers.env_wrappers.monitor import SafetyMonitor
from safe_envs.wrappers.env_wrappers.monitor_vector import SafetyMonitorVector
from safe_envs.wrappers.env_wrappers.safety_filter import SafetyFilterWrapper
from safe_envs.wrappers.env_wrappers.safety_filter_vector import (
    SafetyFilterVectorWrapper,
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
    "ClassK",
    "Condition",
    "FilterDecision",
    "FilterSpec",
    "LearnedCondition",
    "LearnedHOCBF",
    "SafetyFilter",
    "SafetyFilterVectorWrapper",
    "SafetyFilterWrapper",
    "SafetyMonitor",
    "SafetyMonitorVector",
    "condition_names",
    "parse_condition",
    "parse_conditions",
    "power",
    "require_readable",
    "spec_of",
]

if __name__ == "wrappers":  # imported through the link at the top level of a checkout
    from safe_envs.checkout_links import redirect

    redirect(__name__)
