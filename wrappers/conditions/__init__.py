"""The conditions, and how they are written as text: `hocbf:p=2,8`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

from safe_envs.errors import ConfigurationError, nearest
from wrappers.conditions.base import AffineConstraint, Condition
from wrappers.conditions.cbf import CBF, ECBF, HOCBF
from wrappers.conditions.stochastic import SCBF

CONDITIONS: dict[str, type[Condition]] = {c.name: c for c in (CBF, ECBF, HOCBF, SCBF)}

__all__ = ["CBF", "CONDITIONS", "ECBF", "HOCBF", "SCBF", "AffineConstraint", "Condition", "parse_condition"]


def parse_condition(text: str, gains: Sequence[float]) -> Condition:
    """Read a condition from its name, or its name and parameters: `scbf`, `hocbf:p=2,8`, `ecbf:k=16,10`.

    Args:
        text: name, and parameters as `key=value` with commas between the entries of a tuple.
        gains: rates p_1..p_r that set the parameters where the text names none.

    Raises:
        ConfigurationError: the name or a parameter is unknown, or a value is not allowed.
    """
    name, *settings = text.split(":")
    if name not in CONDITIONS:
        raise ConfigurationError(f"unknown filter {name!r}; {nearest(name, CONDITIONS)}")
    condition = CONDITIONS[name]
    if not settings:
        return condition.for_gains(gains)
    allowed = {f.name: f for f in fields(condition)}  # pyright: ignore[reportArgumentType]
    parameters = {}
    for setting in settings:
        key, _, value = setting.partition("=")
        if key not in allowed:
            raise ConfigurationError(f"filter {name} has no parameter {key!r}; {nearest(key, allowed)}")
        try:
            numbers = tuple(float(v) for v in value.split(","))
        except ValueError as error:
            raise ConfigurationError(f"filter {text!r}: {key} = {value!r} is no number or list of numbers") from error
        parameters[key] = numbers if isinstance(allowed[key].default, tuple) else _single(text, key, numbers)
    return condition(**parameters)


def _single(text: str, key: str, numbers: Sequence[float]) -> float:
    if len(numbers) != 1:
        raise ConfigurationError(f"filter {text!r}: {key} takes one number; {len(numbers)} were given")
    return numbers[0]
