"""Where conditions can be met, and what their promises rest on: found by sampling the safe set, and by searching it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.problem import SafetyProblem
from wrappers.conditions import Condition
from wrappers.formulas import Formulas
from wrappers.safe_set import Region, Sample, Score, largest, region_of, sample, search

SMALL = 0.01
"""Below this part of its typical size a leading term counts as small."""

_GROWTH = 1.01
_BOXES = (1.0, 10.0, 100.0)
_BOX_LOG2 = 12
_FEW = 64
_SHARED_OUT = 128


@dataclass(frozen=True)
class Part:
    """What was found of C, or of the intersection of the C_j.

    Attributes:
        points: how many of its points were drawn.
        share: part of the workspace that it is; of C for the intersection.
        infeasible: part of it where no action in the box meets all conditions.
        shortfall: by how much the worst condition is missed where that is most, 0 if all can be met everywhere; in the units
            of b_(r-1) per s.
        worst: the state where that is, shape (n,); where the conditions are nearest to it if they can be met.
    """

    points: int
    share: float
    infeasible: float
    shortfall: float
    worst: np.ndarray


@dataclass(frozen=True)
class BarrierFindings:
    """What was found of a barrier.

    Attributes:
        name: of the barrier.
        condition: its spec.
        degree: r.
        leading: smallest size of the leading term L_g b_(r-1) over C: half of what the box lets it contribute to the condition.
        leading_at: the state where that is, shape (n,).
        typical: its median over C.
        small: part of C where it is below `SMALL` of that.
        small_infeasible: part of these points where no action in the box meets all conditions.
        supremum: of h over C, infinite where it grows with the box that is searched.
        deepest: the state where h is largest in C within the workspace, shape (n,).
        deepest_h: h there.
        deepest_shortfall: by how much its condition is missed there, 0 if it is not.
        suprema: c_j of the b_j over the intersection, shape (r,); NaN if that is empty.
    """

    name: str
    condition: str
    degree: int
    leading: float
    leading_at: np.ndarray
    typical: float
    small: float
    small_infeasible: float
    supremum: float
    deepest: np.ndarray
    deepest_h: float
    deepest_shortfall: float
    suprema: np.ndarray

    @property
    def vanishes(self) -> bool:
        """Whether the leading term is 0 somewhere in C, to rounding."""
        return self.leading <= 1e-6 * self.typical


@dataclass(frozen=True)
class Verification:
    """What `verify` found. All suprema are of a sample and a local search: estimates from below.

    Attributes:
        formulas: the chains and conditions, compiled.
        region: where was looked.
        barriers: for each barrier.
        safe: C, where all barriers are positive.
        kept: the intersection of the C_j, where all chains are positive: the set that the conditions keep. None if it is empty.
        beyond: whether C reaches beyond the workspace.
        drawn: number of states that were drawn.
    """

    formulas: Formulas
    region: Region
    barriers: tuple[BarrierFindings, ...]
    safe: Part
    kept: Part | None
    beyond: bool
    drawn: int


def verify(
    problem: SafetyProblem, conditions: Sequence[Condition], knowledge: str = "model", samples: int = 8192, seed: int = 0
) -> Verification:
    """Sample C, and search it for the worst: where the leading terms vanish, and where no action meets the conditions.

    Args:
        problem: whose barriers, box, ranges and system are taken.
        conditions: one for each barrier.
        knowledge: what they know, "model" or "plant".
        samples: number of states in C at which the drawing ends.
        seed: of all randomness.

    Raises:
        ConfigurationError: an argument is out of its range, or no state of C was found.
        RelativeDegreeError: a condition does not suit a barrier.
        NumericalError: a condition has no finite value at a state in C.
    """
    require_count("samples", samples, 1)
    require_count("seed", seed, 0)
    formulas = Formulas(problem, conditions, knowledge)
    rng = np.random.default_rng(seed)
    region = region_of(problem, formulas.system, formulas.expressions)
    safe = sample("C", formulas.barrier_level, region, samples, rng)
    kept = kept_points(formulas, region, safe, rng)
    part = _part(formulas, formulas.barrier_level, safe.points, safe.share, region, rng)
    in_kept = None if kept is None else _kept_part(formulas, safe, kept, part, region, rng)
    found = tuple(_barrier(i, formulas, region, safe.points, kept, rng) for i in range(len(formulas.stages)))
    wide = region.scaled(_BOXES[1]).draw(_BOX_LOG2, rng)
    beyond = bool((formulas.barrier_level(wide[((wide < region.low) | (wide > region.high)).any(axis=1)]) >= 0.0).any())
    return Verification(formulas, region, found, part, in_kept, beyond, safe.drawn)


def require_count(name: str, value: Any, least: int) -> None:
    """Raise ConfigurationError unless a value is a whole number from `least`."""
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ConfigurationError(f"{name} = {value!r}; give a whole number from {least}")


def kept_points(formulas: Formulas, region: Region, safe: Sample, rng: np.random.Generator) -> np.ndarray | None:
    """Points of the intersection of the C_j, from those of C or, if they are few, drawn for themselves; None if it is empty."""
    points = safe.points[formulas.kept_level(safe.points) >= 0.0]
    if len(points) >= min(_FEW, len(safe.points)):
        return points
    try:
        return sample("the intersection of the C_j", formulas.kept_level, region, len(safe.points) // 4 + 1, rng).points
    except ConfigurationError:
        return None


def supremum(
    j: int, formulas: Formulas, positive: slice | list[int], points: np.ndarray, region: Region, rng: np.random.Generator
) -> float:
    """Supremum of the j-th chain function over the states where others are positive; infinite if it grows with the box that is searched.

    Args:
        j: which of all chain functions.
        formulas: of the chain.
        positive: which of them are positive in the set.
        points: states of the set in the region.
        region: the smallest box.
        rng: of all randomness.
    """

    def score(x: np.ndarray) -> np.ndarray:
        b = formulas.chain(x)
        return np.where(b[:, positive].min(axis=1) > 0.0, b[:, j], -np.inf)

    reached = -np.inf
    for factor in _BOXES:
        box = region.scaled(factor)
        tried = points if factor == 1.0 else np.concatenate([points, box.draw(_BOX_LOG2, rng)])
        before, (reached, _) = reached, largest(score, tried, box, rng)
        if factor > 1.0 and reached <= _GROWTH * before:
            return max(reached, before)
    return np.inf


def worst(formulas: Formulas, level: Score, points: np.ndarray, region: Region, rng: np.random.Generator) -> tuple[float, np.ndarray]:
    """The largest amount by which a condition is missed over {level >= 0}, 0 if none is, and the state where that is."""
    population, values = search(lambda x: _where(level, x, lambda y: formulas.missed(y).max(axis=1)), points, region, rng)
    best = int(values.argmax())
    if len(formulas.stages) == 1 or values[best] <= 0.0:
        return max(float(values[best]), 0.0), population[best]
    tried = np.concatenate([population[values > 0.0], points[:_SHARED_OUT]])
    missed = formulas.slack(tried).max(axis=1)
    return float(missed.max()), tried[int(missed.argmax())]


def _within(level: Score, x: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.where(level(x) >= 0.0, values, -np.inf)


def _where(level: Score, x: np.ndarray, score: Score) -> np.ndarray:
    """The score where level >= 0, the only states that it is asked for, and -inf elsewhere."""
    values, inside = np.full(len(x), -np.inf), level(x) >= 0.0
    if inside.any():
        values[inside] = score(x[inside])
    return values


def _part(formulas: Formulas, level: Score, points: np.ndarray, share: float, region: Region, rng: np.random.Generator) -> Part:
    shortfall, state = worst(formulas, level, points, region, rng)
    return Part(len(points), share, _infeasible(formulas, points), shortfall, state)


def _kept_part(formulas: Formulas, safe: Sample, kept: np.ndarray, part: Part, region: Region, rng: np.random.Generator) -> Part:
    share = float((formulas.kept_level(safe.points) >= 0.0).mean())
    return part if share == 1.0 else _part(formulas, formulas.kept_level, kept, share, region, rng)


def _barrier(
    i: int, formulas: Formulas, region: Region, safe: np.ndarray, kept: np.ndarray | None, rng: np.random.Generator
) -> BarrierFindings:
    stages, level = formulas.stages[i], formulas.barrier_level
    size = formulas.leading(safe)[:, i]
    typical = float(np.median(size))
    negated, leading_at = largest(lambda x: _within(level, x, -formulas.leading(x)[:, i]), safe, region, rng)
    small = safe[size < SMALL * typical]
    deepest_h, deepest = largest(lambda x: _within(level, x, formulas.chain(x)[:, stages.start]), safe, region, rng)
    missed = float(formulas.missed(deepest[None])[0, i])
    chain = range(stages.start, stages.stop)
    suprema = [np.nan if kept is None else supremum(j, formulas, slice(None), kept, region, rng) for j in chain]
    return BarrierFindings(
        name=formulas.problem.barriers[i].name,
        condition=formulas.conditions[i].spec,
        degree=len(chain),
        leading=max(-negated, 0.0),
        leading_at=leading_at,
        typical=typical,
        small=len(small) / len(safe),
        small_infeasible=_infeasible(formulas, small),
        supremum=suprema[0] if formulas.first_order else supremum(stages.start, formulas, formulas.barriers, safe, region, rng),
        deepest=deepest,
        deepest_h=deepest_h,
        deepest_shortfall=max(missed, 0.0),
        suprema=np.array(suprema),
    )


def _infeasible(formulas: Formulas, points: np.ndarray) -> float:
    """Part of the points where a condition is missed; 0 of none."""
    return float((formulas.missed(points) > 0.0).any(axis=1).mean()) if len(points) else 0.0
