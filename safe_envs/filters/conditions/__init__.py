"""Conditions: rules that turn a system and a barrier into a constraint on the input.

What is named here is imported when it is first used.
"""

from typing import TYPE_CHECKING

from safe_envs.lazy_attributes import lazy_attributes

if TYPE_CHECKING:
    from safe_envs.filters.conditions.base import AffineConstraint, Condition
    from safe_envs.filters.conditions.bayesian import BayesianSCBF
    from safe_envs.filters.conditions.cbf import CBF, ECBF, HOCBF, RCBF, SCBF, SRCBF, SZCBF
    from safe_envs.filters.conditions.certified import Certified
    from safe_envs.filters.conditions.class_k import ClassK, power
    from safe_envs.filters.conditions.learned import DDSCBF, LearnedCondition, LearnedHOCBF
    from safe_envs.filters.conditions.names import condition_names
    from safe_envs.filters.conditions.registry import CONDITIONS, LEARNED
    from safe_envs.filters.conditions.text import (
        parse_condition,
        parse_conditions,
        require_readable,
        spec_of,
    )

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
    "Certified",
    "ClassK",
    "Condition",
    "LearnedCondition",
    "LearnedHOCBF",
    "condition_names",
    "parse_condition",
    "parse_conditions",
    "power",
    "require_readable",
    "spec_of",
]

_MODULES = {
    "AffineConstraint": "safe_envs.filters.conditions.base",
    "BayesianSCBF": "safe_envs.filters.conditions.bayesian",
    "CBF": "safe_envs.filters.conditions.cbf",
    "CONDITIONS": "safe_envs.filters.conditions.registry",
    "Certified": "safe_envs.filters.conditions.certified",
    "ClassK": "safe_envs.filters.conditions.class_k",
    "Condition": "safe_envs.filters.conditions.base",
    "DDSCBF": "safe_envs.filters.conditions.learned",
    "ECBF": "safe_envs.filters.conditions.cbf",
    "HOCBF": "safe_envs.filters.conditions.cbf",
    "LEARNED": "safe_envs.filters.conditions.registry",
    "LearnedCondition": "safe_envs.filters.conditions.learned",
    "LearnedHOCBF": "safe_envs.filters.conditions.learned",
    "RCBF": "safe_envs.filters.conditions.cbf",
    "SCBF": "safe_envs.filters.conditions.cbf",
    "SRCBF": "safe_envs.filters.conditions.cbf",
    "SZCBF": "safe_envs.filters.conditions.cbf",
    "condition_names": "safe_envs.filters.conditions.names",
    "parse_condition": "safe_envs.filters.conditions.text",
    "parse_conditions": "safe_envs.filters.conditions.text",
    "power": "safe_envs.filters.conditions.class_k",
    "require_readable": "safe_envs.filters.conditions.text",
    "spec_of": "safe_envs.filters.conditions.text",
}

__getattr__, __dir__ = lazy_attributes(__name__, _MODULES, globals())
