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

_NEXT = 1e-8
"""Part of the range of a state within which a search does not tell a function that reaches 0."""

NOT_ESTABLISHED = "it is not established that "
"""How the text begins of a function that comes near 0 and may stay away from it."""

_LONGEST = 60
"""Number of characters of a part that a message shows."""


_TWICE = "twice differentiable, which Ito's formula asks for,"


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

    Where it comes near that only, the text begins with `NOT_ESTABLISHED`.

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
    doubt = ""
    for name, expression, only_poles in asked:
        for edge in edges(expression):
            if (only_poles and not edge.pole) or edge.base.is_nonzero:
                continue
            state, reached = _nearest_zero(edge.base, states, level, points, region, rng)
            if state is None:
                continue
            values = zip(states, state.tolist(), strict=True)
            at = ", ".join(f"{s} = {value + 0.0:.4g}" for s, value in values)
            place = f"near {at}, by {shortened(edge.part, _LONGEST)}"
            if reached:
                return f"{name} {'has a pole' if edge.pole else f'is not {_TWICE}'} {place}"
            denied = "has no pole" if edge.pole else f"is {_TWICE}"
            doubt = doubt or f"{NOT_ESTABLISHED}{name} {denied} {place}"
    return doubt


def _nearest_zero(
    base: sp.Expr,
    states: Sequence[sp.Symbol],
    level: Score,
    points: np.ndarray,
    region: Region,
    rng: np.random.Generator,
) -> tuple[np.ndarray | None, bool]:
    """Return a state (n,) of the set where a function is next to 0, and whether it reaches 0 there.

    None if no such state is found.
    """
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
    if not (sizes.size and -least <= _TOUCHED * float(np.median(sizes))):
        return None, False
    steps = np.diag(_NEXT * (region.high - region.low))
    with np.errstate(all="ignore"):
        here, *around = values(np.concatenate([state[None], state + steps, state - steps]))[:, 0]
    return state, bool(abs(here) <= np.nan_to_num(np.abs(np.array(around) - here)).max())
