"""Condition classes by name: built-in ones, those of installed packages, those of users' files."""

from __future__ import annotations

import inspect
from typing import Any

from safe_envs import plugins
from safe_envs.errors import ConfigurationError, shortened
from safe_envs.filters.conditions.base import Condition
from safe_envs.filters.conditions.bayesian import BayesianSCBF
from safe_envs.filters.conditions.cbf import CBF, ECBF, HOCBF, RCBF, SCBF, SRCBF, SZCBF
from safe_envs.filters.conditions.certified import Certified
from safe_envs.filters.conditions.learned import DDSCBF, LearnedCondition, LearnedHOCBF
from safe_envs.filters.conditions.names import BY_THEMSELVES, condition_names, unknown_filter
from safe_envs.plugins import load_object, place_of

CONDITIONS: dict[str, type[Condition]] = {
    c.name: c for c in (CBF, ECBF, HOCBF, RCBF, SRCBF, SZCBF, SCBF)
}
"""Conditions that need nothing but a model of the system."""

LEARNED: dict[str, type[LearnedCondition]] = {
    c.name: c for c in (LearnedHOCBF, DDSCBF, BayesianSCBF)
}
"""Conditions that need a learned model."""

_BUILT_IN: dict[str, type[Condition]] = {
    **CONDITIONS,
    **LEARNED,
    Certified.name: Certified,
}


def condition_class(name: str) -> type[Condition]:
    """Return the class of a condition; a user's file is run for it.

    Args:
        name: one of `condition_names`, or FILE.py:NAME or MODULE:NAME.

    Raises:
        ConfigurationError: There is none of that name, or it is no concrete `Condition`.
    """
    if name in _BUILT_IN:
        return _BUILT_IN[name]
    if ":" in name:
        return _checked(name, load_object(name))
    if name in BY_THEMSELVES:
        raise ConfigurationError(
            f'{name} is no condition but a filter by itself: give it alone, without "+", to'
            " SafetyFilterWrapper, SafetyFilterVectorWrapper or an evaluation, like"
            f" {BY_THEMSELVES[name]}. Whatever else takes conditions needs one, such as scbf or"
            " hocbf"
        )
    if name not in condition_names():
        raise unknown_filter(name)
    return _checked(name, plugins.load_plugin(plugins.CONDITIONS, name))


def name_of(condition: type[Condition]) -> str:
    """Return the name from which `condition_class` finds a class."""
    if _BUILT_IN.get(condition.name) is condition:
        return condition.name
    return plugins.name_of(plugins.CONDITIONS, condition) or place_of(condition)


def _checked(name: str, found: Any) -> type[Condition]:
    if not (inspect.isclass(found) and issubclass(found, Condition)):
        kind = "a class" if inspect.isclass(found) else f"a {type(found).__name__}"
        raise ConfigurationError(
            f"filter {shortened(name)} is {kind}, no subclass of safe_envs.wrappers.Condition"
        )
    missing = ", ".join(sorted(found.__abstractmethods__))
    if missing:
        raise ConfigurationError(f"filter {shortened(name)} does not define {missing}")
    if inspect.get_annotations(found) and "__dataclass_fields__" not in found.__dict__:
        raise ConfigurationError(
            f"filter {shortened(name)} states its parameters without @dataclass(frozen=True); put"
            " that before its class"
        )
    return found
