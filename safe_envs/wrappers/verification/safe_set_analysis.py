"""What the bounds of conditions rest on: the set that is kept, the suprema over it, and by how much
the conditions are missed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property

import numpy as np
import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.safe_set import (
    Region,
    Sample,
    draw_starts,
    sample,
    workspace_of,
)
from safe_envs.wrappers.verification.search import Score, largest, search, towards_zero
from safe_envs.wrappers.verification.smoothness import asked_of, roughness

SAMPLES = 8192

_FEW = 64
_POOL_LOG2 = 15
_GROWTH = 1.01
_BOXES = (1.0, 10.0, 100.0)
_BOX_LOG2 = 12
_SHARED_OUT = 128
_REACHES = (1.0, 10.0, 100.0, 1000.0)
_WIDE = 0.3
_TOUCHED = 1e-9
_NEAR, _NEARER = 1e-6, 1e-8
_FALL = 0.03
_BISECTIONS = 64
_RAYS = 64
_STARTS = 64


class SafeSetAnalysis:
    """A sample of C, and what is searched for in it: each thing when it is asked for, the same
    whatever else is.

    Attributes:
        formulas: the chains and conditions, compiled.
        region: where is looked.
        safe: points of C, where all barriers are positive.
        starts: states at which episodes may start, which every search looks at too.
        kept: points of the intersection of the C_j, which the conditions keep; None if it is empty.

    Args:
        formulas: see above.
        samples: number of states in C at which the drawing ends.
        seed: of all randomness.

    Raises:
        ConfigurationError: no state of C was found.
    """

    def __init__(self, formulas: Formulas, samples: int = SAMPLES, seed: int = 0) -> None:
        self.formulas, self.region, self._seed = formulas, formulas.region, seed
        self.safe: Sample = sample("C", formulas.barrier_level, self.region, samples, self.rng(0))
        self.starts = draw_starts(formulas.problem, _STARTS)
        self.kept = self._kept()

    def rng(self, task: int) -> np.random.Generator:
        """The randomness of a task."""
        return np.random.default_rng([self._seed, task])

    def _kept(self) -> np.ndarray | None:
        """Points from those of C or, if they are few, drawn for themselves."""
        level, safe = self.formulas.kept_level, self.safe.points
        points = safe[level(safe) >= 0.0]
        if len(points) >= min(_FEW, len(safe)):
            return points
        try:
            return sample(
                "the intersection of the C_j", level, self.region, len(safe) // 4 + 1, self.rng(1)
            ).points
        except ConfigurationError:
            return None

    @cached_property
    def suprema(self) -> np.ndarray:
        """c_j of every chain function over the intersection; infinite where it grows with the box,
        NaN if that is empty."""
        count = self.formulas.stages[-1].stop
        if self.kept is None:
            return np.full(count, np.nan)
        points = self.with_starts(self.kept, self.formulas.kept_level)
        return np.array(
            [
                supremum(j, self.formulas, range(count), points, self.rng(10 + j))
                for j in range(count)
            ]
        )

    def with_starts(self, points: np.ndarray, level: Score) -> np.ndarray:
        """Points (B, n) of a set {level >= 0} and its starts: what lies in a narrow pocket around
        these is found in any case."""
        return np.concatenate([points, self.starts[level(self.starts) >= 0.0]])

    @cached_property
    def missed(self) -> tuple[float, np.ndarray]:
        """By how much the conditions are missed where that is most in the intersection, and the
        state; of C if that is empty."""
        if self.kept is None:
            level, points = self.formulas.barrier_level, self.safe.points
        else:
            level, points = self.formulas.kept_level, self.kept
        return worst(self.formulas, level, self.with_starts(points, level), self.rng(2))

    @cached_property
    def undefined(self) -> np.ndarray:
        """Those points of C where a condition has no finite value."""
        points = self.with_starts(self.safe.points, self.formulas.barrier_level)
        return points[
            ~(self.formulas.defined(points) & np.isfinite(self.formulas.chain(points)).all(axis=1))
        ]

    @cached_property
    def rough(self) -> str:
        """Which function is not smooth where it has to be, in words; empty if none was found."""
        if self.kept is None:
            return ""
        level = self.formulas.kept_level
        points = self.with_starts(self.kept, level)
        return roughness(
            asked_of(self.formulas),
            self.formulas.system.states,
            level,
            points,
            self.region,
            self.rng(7),
        )

    @cached_property
    def limits(self) -> str:
        """Of which states only a part of the workspace is looked at, in words; those that the
        conditions do not depend on aside."""
        asked = set().union(*(e.free_symbols for e in self.formulas.expressions))
        states = self.formulas.problem.states
        found = [
            f"{states[i].symbol} in [{self.region.low[i]:.4g}, {self.region.high[i]:.4g}]"
            for i in np.flatnonzero(self.region.chosen).tolist()
            if states[i].symbol in asked
        ]
        return f"looked at only for {', '.join(found)}: the workspace is unbounded" if found else ""

    @cached_property
    def runaway(self) -> bool:
        """Whether a condition asks for unbounded control towards the edge, which no box meets: an
        SRCBF with noise there."""
        rows = enumerate(self.formulas.conditions)
        return self.formulas.noisy and any(
            c.almost_sure and self._noise_at_the_edge(i) for i, c in rows
        )

    def _noise_at_the_edge(self, i: int) -> bool:
        """Whether |sigma' grad h|^2 does not fall with h like h: the condition asks for that over
        h.

        The largest one over points with a small h is compared with the largest one over points with
        an even smaller h.
        """
        far, near = (self._largest_spread(i, part) for part in (_NEAR, _NEARER))
        typical = float(np.nanmedian(self.formulas.quadratic_variation_rate(self.safe.points, i)))
        return near > _FALL * far and near > _TOUCHED * _NEARER * typical

    def _largest_spread(self, i: int, part: float) -> float:
        """Largest |sigma' grad h|^2 where h is a part of its size in C, on the ways from points of
        C to points beyond."""
        formulas, rng = self.formulas, self.rng(3)

        def h(x: np.ndarray) -> np.ndarray:
            return formulas.chain(x)[:, formulas.barriers]

        inner = self.safe.points
        outer = self.region.scaled(_BOXES[1]).draw(_BOX_LOG2, rng)
        inner = inner[rng.integers(len(inner), size=len(outer))]
        level = part * float(h(self.safe.points)[:, i].max())
        crossing = (h(inner)[:, i] > level) & (h(outer)[:, i] < level)
        inner, outer = inner[crossing], outer[crossing]
        for _ in range(_BISECTIONS):
            middle = (inner + outer) / 2.0
            above = (h(middle)[:, i] > level)[:, None]
            inner, outer = np.where(above, middle, inner), np.where(above, outer, middle)
        edge = inner[(h(inner) > 0.0).all(axis=1)]
        return float(np.nan_to_num(formulas.quadratic_variation_rate(edge, i)).max(initial=0.0))

    def infinite(self, j: int) -> str:
        """That the supremum of a chain function is infinite, in words: whether it is so or only
        seems so."""
        i = next(i for i, stage in enumerate(self.formulas.stages) if stage.start <= j < stage.stop)
        name, stage = self.formulas.problem.barriers[i].name, j - self.formulas.stages[i].start
        what = f"sup {name}" if stage == 0 else f"sup b_{stage} of {name}"
        return f"{what} {self.how_infinite(j)}"

    def how_infinite(self, j: int) -> str:
        """How sure it is that a supremum is infinite."""
        return (
            "is infinite"
            if unbounded(self.formulas, j)
            else "seems infinite: it grows with the box that is searched"
        )


def supremum(
    j: int,
    formulas: Formulas,
    positive: Sequence[int],
    points: np.ndarray,
    rng: np.random.Generator,
) -> float:
    """Supremum of the j-th chain function over the states of the workspace where others are
    positive.

    To leave the workspace ends an episode, so that what lies beyond does not matter (see
    `safe_envs.wrappers.verification.bounds`). Ranges that were chosen for states without any are
    widened: it is infinite if it grows with them.

    Args:
        j: which of all chain functions.
        formulas: of the chain.
        positive: which of them are positive in the set.
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
        if not region.chosen.any():
            return reached
        if factor > 1.0 and reached <= _GROWTH * before:
            return max(reached, before)
    return np.inf


def unbounded(formulas: Formulas, j: int) -> bool:
    """Whether it is certain that the j-th chain function is unbounded where all are positive:
    polynomials along a straight line.

    The line stays in the workspace: it goes where that has no end.
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
    """Tells of a direction whether the workspace has no end there."""
    ends = np.isinf(workspace_of(formulas.problem))
    return lambda direction: (
        any(direction) and all(ends[int(d > 0), i] for i, d in enumerate(direction) if d)
    )


def _directions(n: int) -> Iterator[Sequence[int]]:
    yield from np.eye(n, dtype=int).tolist()
    yield from (-np.eye(n, dtype=int)).tolist()
    yield from itertools.product((1, -1, 0), repeat=n)


def _origin(region: Region) -> list[sp.Expr]:
    """A point of a region that is nowhere special."""
    shares = np.linspace(2.0 / 7.0, 5.0 / 7.0, len(region.low) + 1)[:-1]
    return [sp.Rational(x) for x in (region.low + shares * (region.high - region.low)).tolist()]


def worst(
    formulas: Formulas, level: Score, points: np.ndarray, rng: np.random.Generator
) -> tuple[float, np.ndarray]:
    """The largest amount by which the conditions are missed over {level >= 0}, 0 if none is, and
    the state where that is.

    Where the box is wide the conditions are missed only on the thin set where the leading term
    vanishes, which no sample meets. So the search begins with as much of the box as matters, and
    hands its population on to wider ones and, last, onto that set.
    """
    tried = (
        np.concatenate([points, _pool(points, formulas.region, rng)]) if formulas.joint else points
    )
    reach = formulas.reach(points)
    wider = [reach * k for k in _REACHES if reach * k < _WIDE]
    for part in wider:
        population, _ = search(
            lambda x, part=part: where_inside(level, x, lambda y: formulas.missed(y, part)),
            tried,
            formulas.region,
            rng,
        )
        tried = np.concatenate([population, tried])
    if wider:
        tried = np.concatenate(
            [*_without_control(formulas, tried[: _SHARED_OUT * len(wider)]), tried]
        )
    population, values = search(
        lambda x: where_inside(level, x, formulas.missed), tried, formulas.region, rng
    )
    best = int(values.argmax())
    if formulas.joint or values[best] <= 0.0:
        return max(float(values[best]), 0.0), population[best]
    tried = np.concatenate([population[values > 0.0], points[:_SHARED_OUT]])
    missed = formulas.slack(tried).max(axis=1)
    return float(missed.max()), tried[int(missed.argmax())]


def _without_control(formulas: Formulas, x: np.ndarray) -> list[np.ndarray]:
    """States moved to where the leading term of a condition vanishes, for each condition."""
    return [
        towards_zero(lambda y, i=i: formulas.rows(y)[0][:, i], x, formulas.region)
        for i in range(len(formulas.stages))
    ]


def without_control(formulas: Formulas, i: int, x: np.ndarray) -> np.ndarray:
    """A state (n,) itself, or one that it cannot be told from where the leading term of a condition
    vanishes."""
    moved = towards_zero(lambda y: formulas.rows(y)[0][:, i], x[None], formulas.region)[0]
    near = abs(moved - x) <= _NEAR * (formulas.region.high - formulas.region.low)
    return moved if near.all() and not formulas.rows(moved[None])[0][0, i].any() else x


def _pool(points: np.ndarray, region: Region, rng: np.random.Generator) -> np.ndarray:
    """Many more states around those of a set: narrow peaks need a look near them."""
    return region.around(points, 1.2).draw(_POOL_LOG2, rng)


def where_inside(level: Score, x: np.ndarray, score: Score) -> np.ndarray:
    """The score where level >= 0, the only states that it is asked for, and -inf elsewhere."""
    values, inside = np.full(len(x), -np.inf), level(x) >= 0.0
    if inside.any():
        values[inside] = score(x[inside])
    return values
