"""Barriers at states where they have no value: there they are -inf, and the state is unsafe."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, Flavour, compile_function, finite

NO_VALUE = (ArithmeticError, ValueError, TypeError)
"""Raised by formulas in plain floats: on overflow, outside a domain, comparing complex roots."""

_EVERYWHERE = (
    *(sp.Add, sp.Mul, sp.Abs, sp.sign, sp.Min, sp.Max, sp.exp, sp.sin, sp.cos, sp.atan, sp.atan2),
    *(sp.sinh, sp.cosh, sp.tanh, sp.asinh),
)
"""Functions that have a value wherever their arguments have one, but for overflow."""


def defined(values: Sequence[Any]) -> Components:
    """Return the values of barriers at one state, -inf where one is no finite number.

    Args:
        values: floats.
    """
    if math.isfinite(sum(values)):
        return tuple(values)
    return tuple([h if math.isfinite(h) else -math.inf for h in values])


def defined_arrays(values: Sequence[Any]) -> Components:
    """Return the values of barriers at a batch, as `defined` does.

    Args:
        values: arrays (B,), or numbers.
    """
    return tuple(
        [h if finite(np.asarray(h)) else np.where(np.isfinite(h), h, -np.inf) for h in values]
    )


class BarrierFunction:
    """Barriers compiled for floats or arrays, with `defined` values.

    Args:
        arguments: symbols, in the order in which the function takes them.
        expressions: the barriers.
        flavour: "floats" or "arrays".
    """

    def __init__(
        self, arguments: Sequence[sp.Symbol], expressions: Sequence[Any], flavour: Flavour
    ) -> None:
        self._source = tuple(arguments), tuple(expressions)
        self._quick = compile_function(arguments, expressions, flavour)
        self._floats = flavour == "floats"

    def __call__(self, *x: Any) -> Components:
        """Return a number of each barrier, or an array (B,)."""
        if not self._floats:
            with np.errstate(all="ignore"):
                return defined_arrays(self._quick(*x))
        try:
            return defined(self._quick(*x))
        except NO_VALUE:
            return defined(careful_floats(*self._source, x))


def careful_floats(
    arguments: Sequence[sp.Symbol], expressions: Sequence[Any], x: Sequence[float]
) -> list[float]:
    """Return expressions at one state, NaN or infinite where plain floats raise.

    Args:
        arguments: symbols, in the order of `x`.
        expressions: of them.
        x: their values.
    """
    values = compile_function(arguments, expressions, "arrays")
    with np.errstate(all="ignore"):
        return [float(np.ravel(v)[0]) for v in values(*[np.array([c]) for c in x])]


def may_lack_value(expression: Any) -> bool:
    """Return whether a barrier may have no value at some state, but for overflow.

    False is certain.

    Args:
        expression: the barrier, of real symbols.
    """
    if not expression.args:
        return False
    if isinstance(expression, sp.Pow):
        base, power = expression.args
        real = power.is_number and (power.is_integer or base.is_nonnegative)
        finite_too = power.is_nonnegative or base.is_positive
        return not (real and finite_too) or may_lack_value(base)
    return not isinstance(expression, _EVERYWHERE) or any(map(may_lack_value, expression.args))
