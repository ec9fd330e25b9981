"""Extrema over a safe set: the suprema of chain functions, and the largest shortfall."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import sympy as sp

from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.safe_set import workspace_of
from safe_envs.wrappers.verification.search import Region, Score, largest, search, towards_zero

_POOL_LOG2 = 15
_GROWTH = 1.01
_BOXES = (1.0, 10.0, 100.0)
_BOX_LOG2 = 12
_CONFLICTS = 128
_REACHES = (1.0, 10.0, 100.0, 1000.0)
_WIDE = 0.3
_NEAR = 1e-6
_RAYS = 64


def supremum(
    j: int,
    formulas: Formulas,
    positive: Sequence[int],
    points: np.ndarray,
    rng: np.random.Generator,
) -> float:
    """Return the supremum of a chain function over the states of the workspace of a set.

    To leave the workspace ends an episode, so that what lies beyond does not matter (see
    `safe_envs.wrappers.verification.bounds`). Ranges that were chosen for states without any are
    widened: the supremum is infinite if it grows with them.

    Args:
        j: index among all chain functions.
        formulas: of the chain.
        positive: indices of those that are positive in the set.
        points: states of the set in the region.
        rng: of all randomness.
    """

    def score(x: np.ndarray) -> np.ndarray:
        b = formulas.chain(x)
        return np.where(b[:, positive].min(axis=1) > 0.0, b[:, j], -np.inf)

    reached, region = -np.inf, formulas.region
    for factor in _BOXES:
        box = region.scaled(factor).within(*workspace_of(formulas.problem))
        more = _pool(points, box, rng) if factor == 1.0 else box.draw(_BOX_LOG2, rng)
        before, (reached, _) = reached, largest(score, np.concatenate([points, more]), box, rng)
        if not region.assumed.any():
            return reached
        if factor > 1.0 and reached <= _GROWTH * before:
            return max(reached, before)
    return np.inf


def unbounded(formulas: Formulas, j: int) -> bool:
    """Return whether a chain function is certainly unbounded where all are positive.

    They are polynomials along a straight line, which goes where the workspace has no end.

    Args:
        formulas: of the chain.
        j: index among all chain functions.
    """
    states, t = formulas.system.states, sp.Dummy("t", real=True)
    chain = [formulas.system.exact(e) for c in formulas.safety_filter.constraints for e in c.chain]
    if not all(e.is_polynomial(*states) for e in chain):
        return False
    for direction in itertools.islice(filter(_endless(formulas), _directions(len(states))), _RAYS):
        line = {
            s: p + int(d) * t
            for s, p, d in zip(states, _origin(formulas.region), direction, strict=True)
        }
        along = [sp.Poly(e.subs(line), t) for e in chain]
        if along[j].degree() > 0 and all(p.LC() > 0 for p in along):
            return True
    return False


def _endless(formulas: Formulas) -> Callable[[Sequence[int]], bool]:
    """Return a function that tells whether the workspace has no end in a direction."""
    ends = np.isinf(workspace_of(formulas.problem))
    return lambda direction: (
        any(direction) and all(ends[int(d > 0), i] for i, d in enumerate(direction) if d)
    )


def _directions(n: int) -> Iterator[Sequence[int]]:
    yield from np.eye(n, dtype=int).tolist()
    yield from (-np.eye(n, dtype=int)).tolist()
    yield from itertools.product((1, -1, 0), repeat=n)


def _origin(region: Region) -> list[sp.Expr]:
    """Return a point of a region that is nowhere special."""
    shares = np.linspace(2.0 / 7.0, 5.0 / 7.0, len(region.low) + 1)[:-1]
    return [sp.Rational(x) for x in (region.low + shares * (region.high - region.low)).tolist()]


def max_shortfall(
    formulas: Formulas,
    level: Score,
    points: np.ndarray,
    rng: np.random.Generator,
    seconds: float = math.inf,
) -> tuple[float, np.ndarray]:
    """Return the largest shortfall of the conditions over {level >= 0}, and the state of it.

    Within wide input bounds the conditions are violated only on the thin set where the control
    authority vanishes, which no sample meets. So the search begins with as much of the bounds as
    matters, and hands its population on to wider ones and, last, onto that set.

    Args:
        formulas: of the conditions.
        level: nonnegative in the set.
        points: of the set, shape (B, n).
        rng: of all randomness.
        seconds: of processor time after which a search ends with what it has.

    Returns:
        The shortfall in the units of b_(r-1) per s, 0 if there is none, and a state (n,).
    """
    tried = (
        np.concatenate([points, _pool(points, formulas.region, rng)]) if formulas.joint else points
    )
    reach, deadline = formulas.reach(points), time.process_time() + seconds
    wider = [reach * k for k in _REACHES if reach * k < _WIDE]
    for part in wider:
        population, _ = search(
            lambda x, part=part: where_inside(level, x, lambda y: formulas.shortfall(y, part)),
            tried,
            formulas.region,
            rng,
            deadline=deadline,
        )
        tried = np.concatenate([population, tried])
    if wider:
        tried = np.concatenate(
            [*_without_control(formulas, tried[: _CONFLICTS * len(wider)]), tried]
        )
    population, values = search(
        lambda x: where_inside(level, x, formulas.shortfall),
        tried,
        formulas.region,
        rng,
        deadline=deadline,
    )
    best = int(values.argmax())
    if formulas.joint or values[best] <= 0.0:
        return max(float(values[best]), 0.0), population[best]
    tried = np.concatenate([population[values > 0.0], points[:_CONFLICTS]])
    slack = formulas.slack(tried).max(axis=1)
    return float(slack.max()), tried[int(slack.argmax())]


def _without_control(formulas: Formulas, x: np.ndarray) -> list[np.ndarray]:
    """Return states (B, n) moved to where there is no control authority, for each condition."""
    return [
        towards_zero(lambda y, i=i: formulas.constraints_at(y)[0][:, i], x, formulas.region)
        for i in range(len(formulas.stages))
    ]


def without_control(formulas: Formulas, i: int, x: np.ndarray) -> np.ndarray:
    """Return a state, or an indistinguishable one where a condition has no control authority.

    Args:
        formulas: of the conditions.
        i: index of the condition.
        x: state, shape (n,).
    """
    moved = towards_zero(lambda y: formulas.constraints_at(y)[0][:, i], x[None], formulas.region)[0]
    near = abs(moved - x) <= _NEAR * (formulas.region.high - formulas.region.low)
    return moved if near.all() and not formulas.constraints_at(moved[None])[0][0, i].any() else x


def _pool(points: np.ndarray, region: Region, rng: np.random.Generator) -> np.ndarray:
    """Draw many more states around those of a set: narrow peaks need a look near them."""
    return region.around(points, 1.2).draw(_POOL_LOG2, rng)


def where_inside(level: Score, x: np.ndarray, score: Score) -> np.ndarray:
    """Return the score where level >= 0, and -inf elsewhere, where it is not evaluated.

    Args:
        level: nonnegative in the set.
        x: states, shape (B, n).
        score: of states in the set.
    """
    values, inside = np.full(len(x), -np.inf), level(x) >= 0.0
    if inside.any():
        values[inside] = score(x[inside])
    return values
