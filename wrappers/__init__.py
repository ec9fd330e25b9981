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
    spec_of,
)
from wrappers.env_wrapper import SafetyFilterWrapper
from wrappers.safety_filter import FilterResult, SafetyFilter
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
    "AffineConstraint",
    "BayesianSCBF",
    "ClassK",
    "Condition",
    "FilterResult",
    "LearnedCondition",
    "LearnedHOCBF",
    "SafetyFilter",
    "SafetyFilterVectorWrapper",
    "SafetyFilterWrapper",
    "parse_condition",
    "parse_conditions",
    "power",
    "spec_of",
]
