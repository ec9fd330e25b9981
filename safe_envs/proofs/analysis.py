"""The analysis of a safe set: the invariant set in it, the suprema over it, and the shortfall."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.proofs.safe_set import (
    BEYOND,
    BEYOND_LOG2,
    Formulas,
    Score,
    asked_of,
    draw_starts,
    max_shortfall,
    roughness,
    sample,
    supremum,
    unbounded,
)

SAMPLES = 8192

_FEW_STATES = 64
_TOUCHED = 1e-9
_NEAR, _NEARER = 1e-6, 1e-8
_FALL = 0.03
_BISECTIONS = 64
_STARTS = 64


class SafeSetAnalysis:
    """A sample of C, and what is searched for in it.

    Each result is computed on first access, and does not depend on the others.

    Attributes:
        region: the states that are searched.
        safe: points of C, where all barriers are positive.
        starts: states at which episodes may start, which every search looks at too.
        invariant_set: points of the intersection of the C_j, which the conditions make invariant;
            None if it is empty.

    Args:
        formulas: the chains and conditions, compiled.
        samples: number of states in C at which the drawing ends.
        seed: of all randomness.
        seconds: of processor time for the search for the shortfall.

    Raises:
        ConfigurationError: no state of C was found.
    """

    def __init__(
        self,
        formulas: Formulas,
        samples: int = SAMPLES,
        seed: int = 0,
        seconds: float = math.inf,
    ) -> None:
        self.formulas, self.region, self._seed = formulas, formulas.region, seed
        self._seconds = seconds
        self.safe = sample("C", formulas.barrier_level, self.region, samples, self.rng(0))
        self.starts = draw_starts(formulas.problem, _STARTS)
        self.invariant_set = self._invariant_set()

    def rng(self, task: int) -> np.random.Generator:
        """Return the randomness of a task."""
        return np.random.default_rng([self._seed, task])

    def _invariant_set(self) -> np.ndarray | None:
        """Choose points from those of C or, if they are few, draw others."""
        level, safe = self.formulas.invariant_level, self.safe.points
        points = safe[level(safe) >= 0.0]
        if len(points) >= min(_FEW_STATES, len(safe)):
            return points
        try:
            return sample(
                "the intersection of the C_j", level, self.region, len(safe) // 4 + 1, self.rng(1)
            ).points
        except ConfigurationError:
            return None

    @cached_property
    def suprema(self) -> np.ndarray:
        """Suprema c_j of all chain functions over the invariant set.

        They are infinite where they grow with the ranges that are searched, and NaN if it is empty.
        """
        count = self.formulas.stages[-1].stop
        if self.invariant_set is None:
            return np.full(count, np.nan)
        points = self.with_starts(self.invariant_set, self.formulas.invariant_level)
        return np.array(
            [
                supremum(j, self.formulas, range(count), points, self.rng(10 + j))
                for j in range(count)
            ]
        )

    def with_starts(self, points: np.ndarray, level: Score) -> np.ndarray:
        """Add the starts in a set to its points, so that a narrow pocket around them is found.

        Args:
            points: of the set, shape (B, n).
            level: nonnegative in the set.

        Returns:
            States, shape (C, n).
        """
        return np.concatenate([points, self.starts[level(self.starts) >= 0.0]])

    @cached_property
    def max_shortfall(self) -> tuple[float, np.ndarray]:
        """Largest shortfall in the invariant set (in C if that is empty), and its state (n,)."""
        if self.invariant_set is None:
            level, points = self.formulas.barrier_level, self.safe.points
        else:
            level, points = self.formulas.invariant_level, self.invariant_set
        points = self.with_starts(points, level)
        return max_shortfall(self.formulas, level, points, self.rng(2), self._seconds)

    @cached_property
    def infeasible(self) -> float:
        """Part of the invariant set where no action meets all conditions; 0 if it is empty."""
        points = self.invariant_set
        return 0.0 if points is None else infeasible_part(self.formulas, points)

    @cached_property
    def undefined(self) -> np.ndarray:
        """Points of C where a condition has no finite value, shape (B, n)."""
        points = self.with_starts(self.safe.points, self.formulas.barrier_level)
        return points[
            ~(self.formulas.defined(points) & np.isfinite(self.formulas.chain(points)).all(axis=1))
        ]

    @cached_property
    def rough(self) -> str:
        """Which function is not smooth where it has to be, in words; "" if none was found."""
        if self.invariant_set is None:
            return ""
        level = self.formulas.invariant_level
        points = self.with_starts(self.invariant_set, level)
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
        """Of which states that matter only a part of the workspace is searched, in words."""
        asked = set().union(*(e.free_symbols for e in self.formulas.expressions))
        states = self.formulas.problem.states
        found = [
            f"{states[i].symbol} in [{self.region.low[i]:.4g}, {self.region.high[i]:.4g}]"
            for i in np.flatnonzero(self.region.assumed).tolist()
            if states[i].symbol in asked
        ]
        return f"looked at only for {', '.join(found)}: the workspace is unbounded" if found else ""

    @cached_property
    def runaway(self) -> bool:
        """Whether an SRCBF asks for unbounded control towards the edge, since there is noise."""
        rows = enumerate(self.formulas.conditions)
        return self.formulas.noisy and any(
            c.almost_sure and self._noise_at_the_edge(i) for i, c in rows
        )

    def _noise_at_the_edge(self, i: int) -> bool:
        """Return whether |sigma' grad h|^2 does not fall with h like h, by which it is divided."""
        # The largest one over points with a small h is compared with the largest one over points
        # with an even smaller h.
        far, near = (self._largest_variation(i, part) for part in (_NEAR, _NEARER))
        typical = float(np.nanmedian(self.formulas.variation_rates(self.safe.points)[:, i]))
        return near > _FALL * far and near > _TOUCHED * _NEARER * typical

    def _largest_variation(self, i: int, part: float) -> float:
        """Return the largest |sigma' grad h|^2 where h is a part of its size in C."""
        # The states are on the straight lines from points of C to points beyond.
        formulas, rng = self.formulas, self.rng(3)

        def h(x: np.ndarray) -> np.ndarray:
            return formulas.chain(x)[:, formulas.barriers]

        inner = self.safe.points
        outer = self.region.scaled(BEYOND).draw(BEYOND_LOG2, rng)
        inner = inner[rng.integers(len(inner), size=len(outer))]
        level = part * float(h(self.safe.points)[:, i].max())
        crossing = (h(inner)[:, i] > level) & (h(outer)[:, i] < level)
        inner, outer = inner[crossing], outer[crossing]
        for _ in range(_BISECTIONS):
            middle = (inner + outer) / 2.0
            above = (h(middle)[:, i] > level)[:, None]
            inner, outer = np.where(above, middle, inner), np.where(above, outer, middle)
        edge = inner[(h(inner) > 0.0).all(axis=1)]
        return float(np.nan_to_num(formulas.variation_rates(edge)[:, i]).max(initial=0.0))

    def how_infinite(self, j: int) -> str:
        """Say how sure it is that the supremum of the j-th chain function is infinite."""
        return (
            "is infinite"
            if unbounded(self.formulas, j)
            else "seems infinite: it grows with the ranges that are searched"
        )


def infeasible_part(formulas: Formulas, points: np.ndarray) -> float:
    """Return the part of points where no action meets all conditions; 0 of none.

    Args:
        formulas: of the conditions.
        points: states, shape (B, n).
    """
    return float((formulas.shortfall(points) > 0.0).mean()) if len(points) else 0.0
