"""Conditions: rules that turn a system and a barrier into a constraint on the input.

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
    "AffineConstraint": "safe_envs.wrappers.conditions.constraint",
    "BayesianSCBF": "safe_envs.wrappers.conditions.bayesian",
    "CBF": "safe_envs.wrappers.conditions.cbf",
    "CONDITIONS": "safe_envs.wrappers.conditions.registry",
    "Certified": "safe_envs.wrappers.conditions.certified",
    "ClassK": "safe_envs.wrappers.conditions.class_k",
    "Condition": "safe_envs.wrappers.conditions.base",
    "DDSCBF": "safe_envs.wrappers.conditions.learned",
    "ECBF": "safe_envs.wrappers.conditions.cbf",
    "HOCBF": "safe_envs.wrappers.conditions.cbf",
    "LEARNED": "safe_envs.wrappers.conditions.registry",
    "LearnedCondition": "safe_envs.wrappers.conditions.learned",
    "LearnedHOCBF": "safe_envs.wrappers.conditions.learned",
    "RCBF": "safe_envs.wrappers.conditions.reciprocal",
    "SCBF": "safe_envs.wrappers.conditions.stochastic",
    "SRCBF": "safe_envs.wrappers.conditions.reciprocal",
    "SZCBF": "safe_envs.wrappers.conditions.stochastic",
    "condition_names": "safe_envs.wrappers.conditions.names",
    "parse_condition": "safe_envs.wrappers.conditions.spec_text",
    "parse_conditions": "safe_envs.wrappers.conditions.spec_text",
    "power": "safe_envs.wrappers.conditions.class_k",
    "require_readable": "safe_envs.wrappers.conditions.spec_text",
    "spec_of": "safe_envs.wrappers.conditions.spec_text",
}

__getattr__, __dir__ = lazy_attributes(__name__, _MODULES, globals())
