"""What keeps an env safe: conditions, their QPs, the safety filter and its gym wrappers."""

from wrappers.conditions import (
    CBF,
    CONDITIONS,
    ECBF,
    HOCBF,
    RCBF,
    SCBF,
    SRCBF,
    SZCBF,
    AffineConstraint,
    ClassK,
    Condition,
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
    "ECBF",
    "HOCBF",
    "RCBF",
    "SCBF",
    "SRCBF",
    "SZCBF",
    "AffineConstraint",
    "ClassK",
    "Condition",
    "FilterResult",
    "SafetyFilter",
    "SafetyFilterVectorWrapper",
    "SafetyFilterWrapper",
    "parse_condition",
    "parse_conditions",
    "power",
    "spec_of",
]
