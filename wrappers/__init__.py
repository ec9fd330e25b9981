"""What keeps an env safe: conditions, their QPs, the safety filter and its gym wrappers."""

from wrappers.conditions import CBF, CONDITIONS, ECBF, HOCBF, SCBF, AffineConstraint, Condition, parse_condition
from wrappers.env_wrapper import SafetyFilterWrapper
from wrappers.safety_filter import FilterResult, SafetyFilter
from wrappers.vector_wrapper import SafetyFilterVectorWrapper

__all__ = [
    "CBF",
    "CONDITIONS",
    "ECBF",
    "HOCBF",
    "SCBF",
    "AffineConstraint",
    "Condition",
    "FilterResult",
    "SafetyFilter",
    "SafetyFilterVectorWrapper",
    "SafetyFilterWrapper",
    "parse_condition",
]
