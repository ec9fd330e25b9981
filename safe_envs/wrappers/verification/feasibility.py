"""Where conditions can be met, and what their promises rest on: found by sampling the safe set, and
by searching it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from safe_envs.errors import require_whole
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions import Condition, spec_of
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.safe_set import Region
from safe_envs.wrappers.verification.safe_set_analysis import (
    SAMPLES,
    SafeSetAnalysis,
    supremum,
    where_inside,
    without_control,
    worst,
)
from safe_envs.wrappers.verification.search import largest

SMALL = 0.01
"""Below this part of its typical size a leading term counts as small."""

_BEYOND = 10.0
_BEYOND_LOG2 = 12


@dataclass(frozen=True)
class Part:
    """What was found of C, or of the intersection of the C_j.

    Attributes:
        points: how many of its points were drawn.
        share: part of the workspace that it is; of C for the intersection.
        infeasible: part of it where no action in the box meets all conditions.
        shortfall: by how much the worst condition is missed where that is most, 0 if all can be met
            everywhere; in the units of b_(r-1) per s.
        worst: the state where that is, shape (n,); where the conditions are nearest to it if they
            can be met.
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
        leading: smallest size of the leading term L_g b_(r-1) over C: half of what the box lets it
            contribute to the condition.
        leading_at: the state where that is, shape (n,).
        typical: its median over C.
        small: part of C where it is below `SMALL` of that.
        small_infeasible: part of these points where no action in the box meets all conditions.
        supremum: of h over C within the workspace, infinite where it grows with the ranges that
            were chosen for states without any.
        growth: how sure it is that it is infinite, in words; empty where it is not.
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
    growth: str
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
        survey: what the bounds rest on.
        barriers: for each barrier.
        safe: C, where all barriers are positive.
        kept: the intersection of the C_j, where all chains are positive: the set that the
            conditions keep. None if it is empty.
        beyond: whether C reaches beyond the workspace.
        undefined: part of C where a condition has no finite value.
    """

    survey: SafeSetAnalysis
    barriers: tuple[BarrierFindings, ...]
    safe: Part
    kept: Part | None
    beyond: bool
    undefined: float

    @property
    def formulas(self) -> Formulas:
        """The chains and conditions, compiled."""
        return self.survey.formulas

    @property
    def region(self) -> Region:
        """Where was looked."""
        return self.survey.region

    @property
    def drawn(self) -> int:
        """Number of states that were drawn."""
        return self.survey.safe.drawn


def verify(
    problem: SafetyProblem,
    conditions: Sequence[Condition],
    knowledge: str = "model",
    samples: int = SAMPLES,
    seed: int = 0,
) -> Verification:
    """Sample C, and search it for the worst: where the leading terms vanish, and where no action
    meets the conditions.

    Args:
        problem: whose barriers, box, ranges and system are taken.
        conditions: one for each barrier.
        knowledge: what they know, "model" or "plant".
        samples: number of states in C at which the drawing ends.
        seed: of all randomness.

    Raises:
        ConfigurationError: an argument is out of its range, or no state of C was found.
        RelativeDegreeError: a condition does not suit a barrier.
    """
    require_whole("samples", samples, 1)
    require_whole("seed", seed, 0)
    formulas = Formulas(problem, conditions, knowledge)
    survey = SafeSetAnalysis(formulas, samples, seed)
    kept = None if survey.kept is None else _kept_part(survey, survey.kept)
    safe = _safe_part(survey, kept)
    found = tuple(_barrier(i, survey) for i in range(len(formulas.stages)))
    wide = survey.region.scaled(_BEYOND).draw(_BEYOND_LOG2, survey.rng(6))
    outside = ((wide < survey.region.low) | (wide > survey.region.high)).any(axis=1)
    beyond = bool((formulas.barrier_level(wide[outside]) >= 0.0).any())
    return Verification(
        survey, found, safe, kept, beyond, len(survey.undefined) / len(survey.safe.points)
    )


def _kept_part(survey: SafeSetAnalysis, kept: np.ndarray) -> Part:
    points = survey.safe.points
    share = float((survey.formulas.kept_level(points) >= 0.0).mean())
    return Part(len(kept), share, _infeasible(survey.formulas, kept), *survey.missed)


def _safe_part(survey: SafeSetAnalysis, kept: Part | None) -> Part:
    """C: what was found of the intersection holds for it where that is all of it, but for what each
    is a part of."""
    formulas, points = survey.formulas, survey.safe.points
    if kept is not None and kept.share == 1.0:
        return replace(kept, share=survey.safe.share)
    shortfall, state = worst(
        formulas,
        formulas.barrier_level,
        survey.with_starts(points, formulas.barrier_level),
        survey.rng(4),
    )
    return Part(len(points), survey.safe.share, _infeasible(formulas, points), shortfall, state)


def _barrier(i: int, survey: SafeSetAnalysis) -> BarrierFindings:
    formulas, region, safe, rng = (
        survey.formulas,
        survey.region,
        survey.safe.points,
        survey.rng(100 + i),
    )
    stages, level = formulas.stages[i], formulas.barrier_level
    size = formulas.leading(safe)[:, i]
    typical = float(np.nanmedian(size))
    negated, leading_at = largest(
        lambda x: where_inside(level, x, lambda y: -formulas.leading(y)[:, i]), safe, region, rng
    )
    small = safe[size < SMALL * typical]
    _, deepest = largest(
        lambda x: where_inside(level, x, lambda y: formulas.chain(y)[:, stages.start]),
        safe,
        region,
        rng,
    )
    deepest = without_control(formulas, i, deepest)
    suprema = survey.suprema[stages]
    highest = (
        suprema[0]
        if formulas.first_order
        else supremum(
            stages.start, formulas, formulas.barriers, survey.with_starts(safe, level), rng
        )
    )
    return BarrierFindings(
        name=formulas.problem.barriers[i].name,
        condition=spec_of(formulas.conditions[i]),
        degree=stages.stop - stages.start,
        leading=max(-negated, 0.0),
        leading_at=leading_at,
        typical=typical,
        small=len(small) / len(safe),
        small_infeasible=_infeasible(formulas, small),
        supremum=highest,
        growth=survey.how_infinite(stages.start) if np.isinf(highest) else "",
        deepest=deepest,
        deepest_h=float(formulas.chain(deepest[None])[0, stages.start]),
        deepest_shortfall=max(float(formulas.own(deepest[None])[0, i]), 0.0),
        suprema=suprema,
    )


def _infeasible(formulas: Formulas, points: np.ndarray) -> float:
    """Part of the points where a condition is missed; 0 of none."""
    return float((formulas.missed(points) > 0.0).mean()) if len(points) else 0.0
