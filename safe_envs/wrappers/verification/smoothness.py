"""Where functions are not smooth, by their parts: poles, and roots whose radicand reaches 0."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.tables import tabulated
from safe_envs.errors import shortened
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.search import Region, Score, largest

_TOUCHED = 1e-6
"""Part of its typical size at which a function counts as one that reaches 0."""

_LONGEST = 60
"""Number of characters of a part that a message shows."""


class Edge(NamedTuple):
    """A part of an expression that is not smooth where another expression is 0.

    Attributes:
        part: of the expression.
        base: which must not reach 0.
        pole: whether the part has no finite value there, and not only no second derivative.
    """

    part: sp.Expr
    base: sp.Expr
    pole: bool


def edges(expression: Any) -> Iterator[Edge]:
    """Yield the parts of an expression that are smooth only inside their domains, each once."""
    part: Any
    for part in dict.fromkeys(sp.preorder_traversal(expression)):
        arguments: tuple[Any, ...] = part.args
        match part:
            case sp.Pow() if part.base.free_symbols and not (part.exp.is_Integer and part.exp >= 0):
                yield Edge(part, part.base, not part.exp.is_nonnegative)
            case sp.log():
                yield Edge(part, arguments[0], True)
            case sp.tan() | sp.sec():
                yield Edge(part, sp.cos(arguments[0]), True)
            case sp.cot() | sp.csc():
                yield Edge(part, sp.sin(arguments[0]), True)
            case sp.asin() | sp.acos() | sp.atanh():
                yield Edge(part, 1 - arguments[0] ** 2, isinstance(part, sp.atanh))
            case sp.acosh():
                yield Edge(part, arguments[0] - 1, False)
            case sp.atan2():
                # It jumps where y = 0 and x <= 0.
                y, x = arguments
                yield Edge(part, sp.sqrt(x**2 + y**2) + x, True)


class Asked(NamedTuple):
    """What has to be smooth.

    Attributes:
        name: of the function.
        expression: of the states, with numbers for all parameters.
        only_poles: whether a second derivative does not matter, but a finite value does.
    """

    name: str
    expression: sp.Expr
    only_poles: bool


def asked_of(formulas: Formulas) -> list[Asked]:
    """Return the functions that the bounds require to be smooth.

    They are the chains, which without noise need no derivative; the constraints need values.
    """
    numeric, found = formulas.system.numeric, []
    constraints, barriers = formulas.safety_filter.constraints, formulas.problem.barriers
    for barrier, stage, row in zip(barriers, formulas.stages, constraints, strict=True):
        chain = zip(formulas.names[stage], row.chain, strict=True)
        found += [Asked(name, numeric(function), not formulas.noisy) for name, function in chain]
        entries = (*row.coefficient, row.offset)
        found += [Asked(f"the condition on {barrier.name}", numeric(e), True) for e in entries]
    return found


def roughness(
    asked: Sequence[Asked],
    states: Sequence[sp.Symbol],
    level: Score,
    points: np.ndarray,
    region: Region,
    rng: np.random.Generator,
) -> str:
    """Say which function is not smooth somewhere in a set, and where; "" if none was found.

    Ito's formula asks for two continuous derivatives, and without noise paths may not pass a pole.
    A function with a kink by its name is found by `safe_envs.dynamics.lie.has_kinks`.

    Args:
        asked: what has to be smooth.
        states: symbols.
        level: nonnegative in the set.
        points: of the set, shape (B, n).
        region: where to look.
        rng: of the search.

    Returns:
        A text.
    """
    for name, expression, only_poles in asked:
        for edge in edges(expression):
            if only_poles and not edge.pole:
                continue
            state = _reaches_zero(edge.base, states, level, points, region, rng)
            if state is not None:
                at = ", ".join(
                    f"{s} = {value + 0.0:.4g}"
                    for s, value in zip(states, state.tolist(), strict=True)
                )
                what = (
                    "has a pole"
                    if edge.pole
                    else "is not twice differentiable, which Ito's formula asks for,"
                )
                return f"{name} {what} near {at}, by {shortened(edge.part, _LONGEST)}"
    return ""


def _reaches_zero(
    base: sp.Expr,
    states: Sequence[sp.Symbol],
    level: Score,
    points: np.ndarray,
    region: Region,
    rng: np.random.Generator,
) -> np.ndarray | None:
    """Return a state (n,) of the set where a function is 0 to rounding; None if none is found."""
    values = tabulated(states, [base])

    def size(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return abs(values(x)[:, 0])

    def score(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.where(level(x) >= 0.0, -size(x), -np.inf)

    sizes = size(points)
    sizes = sizes[np.isfinite(sizes)]
    least, state = largest(score, points, region, rng)
    return state if sizes.size and -least <= _TOUCHED * float(np.median(sizes)) else None
