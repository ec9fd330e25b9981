"""The conditions, and how they are written as text: `hocbf:p=2,8`, or `hocbf:p=2,8+cbf:alpha=1` for two barriers."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from safe_envs.errors import ConfigurationError, nearest
from safe_envs.problem import SafetyProblem
from wrappers.conditions.base import AffineConstraint, Condition
from wrappers.conditions.cbf import CBF, ECBF, HOCBF
from wrappers.conditions.class_k import ClassK, power
from wrappers.conditions.reciprocal import RCBF, SRCBF
from wrappers.conditions.stochastic import SCBF, SZCBF

CONDITIONS: dict[str, type[Condition]] = {c.name: c for c in (CBF, ECBF, HOCBF, RCBF, SRCBF, SZCBF, SCBF)}

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
    "parse_condition",
    "parse_conditions",
    "power",
    "spec_of",
]

# A class-K function or a complex pole may hold a "+" too.
_BETWEEN = re.compile(rf"\+(?=(?:{'|'.join(CONDITIONS)})(?:[:+]|$))")


def parse_conditions(text: str, problem: SafetyProblem) -> tuple[Condition, ...]:
    """Read a condition for every barrier of a problem: one text for all of them, or one for each with "+" between.

    Raises:
        ConfigurationError: as `parse_condition`, or there are neither one nor as many texts as barriers.
    """
    texts = _BETWEEN.split(text)
    count = len(problem.barriers)
    if len(texts) not in (1, count):
        allowed = "one" if count == 1 else f"one for all {count} barriers, or one for each"
        raise ConfigurationError(f"filter {text!r} has {len(texts)} conditions; {problem.name} takes {allowed}")
    texts = texts * count if len(texts) == 1 else texts
    return tuple(parse_condition(part, problem.gains_of(i)) for i, part in enumerate(texts))


def spec_of(conditions: Sequence[Condition]) -> str:
    """The text from which `parse_conditions` makes the same conditions."""
    specs = [condition.spec for condition in conditions]
    return specs[0] if len(set(specs)) == 1 else "+".join(specs)


def parse_condition(text: str, gains: Sequence[float]) -> Condition:
    """Read a condition from its name, or its name and parameters: `scbf`, `hocbf:p=2,8`, `cbf:alpha=2*s**3`.

    Args:
        text: name, and parameters as `key=value` with commas between the entries of a tuple.
        gains: rates p_1..p_r that set the parameters where the text names none of them.

    Raises:
        ConfigurationError: the name or a parameter is unknown or comes twice, or a value is not allowed.
    """
    name, *settings = text.split(":")
    if name not in CONDITIONS:
        raise ConfigurationError(f"unknown filter {name!r}; {nearest(name, CONDITIONS)}")
    condition = CONDITIONS[name]
    allowed = inspect.signature(condition).parameters
    given: dict[str, Any] = {}
    for setting in settings:
        key, _, value = setting.partition("=")
        if key not in allowed or key in given:
            reason = f"{text!r} names {key!r} twice" if key in given else f"{name} has no parameter {key!r}; {nearest(key, allowed)}"
            raise ConfigurationError(f"filter {reason}")
        given[key] = _value(text, key, value, isinstance(allowed[key].default, float | str))
    if set(given) <= {"sampling_margin"}:
        return replace(condition.for_gains(gains), **given)
    return condition(**given)


def _value(text: str, key: str, value: str, single: bool) -> Any:
    entries = tuple(_entry(entry) for entry in value.split(","))
    if single and len(entries) != 1:
        raise ConfigurationError(f"filter {text!r}: {key} takes one value; {len(entries)} were given")
    return entries[0] if single else entries


def _entry(text: str) -> Any:
    """A number, where it is one; the condition says what else it takes."""
    for kind in (float, complex):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
