"""One sub-step of the simulation as expressions, with uncertain parameters left as symbols."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import sympy as sp

from safe_envs.dynamics.declarations import fitting
from safe_envs.dynamics.integrators import euler_maruyama_step, rate
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.number_text import finite_number

_MOST_TERMS = 120
_LARGEST = 600
"""Parts of an expression that is too large to be expanded to see whether it gets shorter."""

Intervals = Mapping[sp.Symbol, tuple[float, float]]


def with_intervals(
    system: ControlAffineSDE, intervals: Mapping[str, tuple[float, float]]
) -> tuple[ControlAffineSDE, Intervals]:
    """Return a system whose uncertain parameters are states that do not move.

    All that is derived from the system leaves their symbols as they are then.

    Args:
        system: the dynamics.
        intervals: (low, high) of parameters, by name.

    Returns:
        The system, with the parameters as further states, and the intervals by their symbols.

    Raises:
        ConfigurationError: a parameter does not exist, an interval is none, or the system has no
            finite value in it.
    """
    by_name = {p.name: p for p in system.parameters}
    found: dict[sp.Symbol, tuple[float, float]] = {}
    for name, given in intervals.items():
        if name not in by_name:
            raise ConfigurationError(
                f"an interval names the parameter {shown(name)}, which the system lacks;"
                f" {nearest(name, by_name)}"
            )
        found[sp.Symbol(name, real=True)] = _ends(system, by_name[name], given)
    if not found:
        return system, {}
    symbols = {by_name[p.name]: p for p in found}
    still = [0] * len(found)
    uncertain = ControlAffineSDE(
        states=(*system.states, *found),
        inputs=system.inputs,
        drift=[*system.drift.xreplace(symbols), *still],
        input_matrix=system.input_matrix.xreplace(symbols).col_join(sp.zeros(len(found), system.m)),
        diffusion=system.diffusion.xreplace(symbols).col_join(
            sp.zeros(len(found), system.diffusion.cols)
        ),
        parameters={p: v for p, v in system.parameters.items() if p not in symbols},
    )
    vanishing = {p: 0 for p, (low, high) in found.items() if low <= 0.0 <= high}
    if (
        uncertain.noisy
        and not replace(uncertain, diffusion=uncertain.diffusion.xreplace(vanishing)).noisy
    ):
        names = ", ".join(p.name for p in vanishing)
        raise ConfigurationError(
            f"the intervals of {names} hold 0, where the noise vanishes and the simulation takes"
            " steps of Runge and Kutta in place of Euler's; begin them above 0"
        )
    return uncertain, found


def _ends(system: ControlAffineSDE, parameter: sp.Symbol, given: Any) -> tuple[float, float]:
    name = parameter.name
    try:
        low, high = given
    except (TypeError, ValueError) as error:
        raise ConfigurationError(
            f"interval of {name} = {shown(given)}; give (low, high)"
        ) from error
    low, high = finite_number(f"low end of {name}", low), finite_number(f"high end of {name}", high)
    if low > high:
        raise ConfigurationError(f"interval of {name} = ({low:g}, {high:g}); its low end is higher")
    for value in (low, high, *[0.0] * (low < 0.0 < high)):
        fitting(parameter, value)
        rate(system.with_parameters(**{name: value}))  # Raises where there is a division by 0.
    return low, high


def sub_step(
    system: ControlAffineSDE, h: float
) -> tuple[tuple[sp.Symbol, ...], tuple[sp.Expr, ...]]:
    """Derive the state after one sub-step, as `Integrator` computes it.

    Args:
        system: the dynamics.
        h: length of the sub-step, in s.

    Returns:
        Symbols of the standard normals that it takes, one for each channel that is not zero, and
        the state after it as expressions of states, inputs and normals.
    """
    if system.noisy:
        draws, moved = euler_maruyama_step(system, h)
        return draws, tuple(map(tidied, moved))
    x, f = list(system.states), list(rate(system))
    half, whole, sixth = (sp.Float(value, 17) for value in (0.5 * h, h, h / 6.0))

    def rate_at(length: sp.Float, slope: Iterable[Any]) -> list[Any]:
        at = {s: s + length * k for s, k in zip(x, slope, strict=True)}
        return [e.xreplace(at) for e in f]

    k1 = f
    k2 = rate_at(half, k1)
    k3 = rate_at(half, k2)
    k4 = rate_at(whole, k3)
    return (), tuple(
        tidied(s + sixth * (b1 + 2 * (b2 + b3) + b4))
        for s, b1, b2, b3, b4 in zip(x, k1, k2, k3, k4, strict=True)
    )


def tidied(expression: Any) -> Any:
    """Return an expression with fewer occurrences of its symbols, if that is easily done.

    The fewer times a symbol occurs, the narrower is what interval arithmetic makes of it. Large
    expressions stay as they are.
    """
    parts = list(itertools.islice(sp.preorder_traversal(expression), _LARGEST))
    if len(parts) == _LARGEST or any(map(_has_many_terms, parts)):
        return expression
    expanded = sp.expand(expression, trig=False, power_base=False, power_exp=False, log=False)
    best: Any = min(expression, expanded, _with_mean_angles(expanded), key=occurrences)
    for symbol in sorted(best.free_symbols, key=sp.default_sort_key):
        best = min(best, _collected(best, symbol), key=occurrences)
    return best


def _has_many_terms(part: Any) -> bool:
    """Return whether a power of a sum, multiplied out, has more terms than a large expression."""
    if not (isinstance(part, sp.Pow) and part.base.is_Add and part.exp.is_Integer):
        return False
    n = int(part.exp)
    return n > 1 and math.comb(len(part.base.args) + n - 1, n) > _MOST_TERMS


def occurrences(expression: Any) -> int:
    """Return how many times symbols occur in an expression."""
    if not expression.args:
        return int(expression.is_Symbol)
    if isinstance(expression, sp.Pow) and expression.exp.is_number:
        return occurrences(expression.base)
    return sum(occurrences(part) for part in expression.args)


def _collected(expression: Any, symbol: sp.Symbol) -> Any:
    """Take a symbol out of the terms of a sum that are linear in it."""
    terms: Sequence[Any] = sp.Add.make_args(expression)
    linear: dict[Any, Any] = {t: t.coeff(symbol, 1) for t in terms}
    factors = [c for t, c in linear.items() if c != 0 and not c.has(symbol) and t == c * symbol]
    if len(factors) < 2:
        return expression
    rest = [t for t, c in linear.items() if not (c != 0 and not c.has(symbol) and t == c * symbol)]
    return sp.Add(*rest, sp.Mul(symbol, sp.Add(*factors)))


def _with_mean_angles(expression: Any) -> Any:
    """Write the sum of two cosines as twice the cosine of the mean times that of half the gap.

    The rates that a step of Runge and Kutta takes of a heading are at its start, middle and end: so
    the heading occurs once.
    """
    turns: dict[Any, list[Any]] = {}
    rest: list[Any] = []
    for term in sp.Add.make_args(expression):
        found = [f for f in sp.Mul.make_args(term) if isinstance(f, sp.sin | sp.cos)]
        if len(found) == 1:
            number, factor = (term / found[0]).as_independent(*term.free_symbols)
            turns.setdefault((found[0].func, number, factor), []).append(found[0].args[0])
        else:
            rest.append(term)
    sums: dict[Any, list[Any]] = {}
    for (function, number, factor), angles in turns.items():
        while len(angles) > 1:
            a, b = angles.pop(), angles.pop()
            mean, half = sp.expand((a + b) / 2), sp.expand((a - b) / 2)
            sums.setdefault((function(mean), factor), []).append(2 * number * sp.cos(half))
        for angle in angles:
            sums.setdefault((function(angle), factor), []).append(number)
    return sp.Add(*rest, *(turn * factor * sp.Add(*s) for (turn, factor), s in sums.items()))
