"""Conditions: rules that turn a system and a barrier into a constraint on the input."""

from safe_envs.wrappers.conditions.base import Condition
from safe_envs.wrappers.conditions.bayesian import BayesianSCBF
from safe_envs.wrappers.conditions.cbf import CBF, ECBF, HOCBF
from safe_envs.wrappers.conditions.certified import Certified
from safe_envs.wrappers.conditions.class_k import ClassK, power
from safe_envs.wrappers.conditions.constraint import AffineConstraint
from safe_envs.wrappers.conditions.learned import DDSCBF, LearnedCondition, LearnedHOCBF
from safe_envs.wrappers.conditions.reciprocal import RCBF, SRCBF
from safe_envs.wrappers.conditions.registry import CONDITIONS, LEARNED, condition_names
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
