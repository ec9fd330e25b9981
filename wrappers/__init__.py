"""What keeps an env safe: conditions, their QPs, the safety filter and its gym wrappers."""

from wrappers.conditions import (
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
    parse_condition,
    parse_conditions,
    power,
    require_readable,
    spec_of,
)
from wrappers.env_wrapper import SafetyFilterWrapper
from wrappers.filter_spec import ActionMap, FilterSpec
from wrappers.monitor import SafetyMonitor
from wrappers.safety_filter import FilterResult, SafetyFilter
from wrappers.vector_monitor import SafetyMonitorVector
from wrappers.vector_wrapper import SafetyFilterVectorWrapper

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
    "FilterResult",
    "FilterSpec",
    "LearnedCondition",
    "LearnedHOCBF",
    "SafetyFilter",
    "SafetyFilterVectorWrapper",
    "SafetyFilterWrapper",
    "SafetyMonitor",
    "SafetyMonitorVector",
    "parse_condition",
    "parse_conditions",
    "power",
    "require_readable",
    "spec_of",
]
