"""Where conditions can be met, and what the input can do, found by sampling and searching."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from safe_envs.errors import require_whole
from safe_envs.filters.conditions.base import Condition
from safe_envs.filters.conditions.certified import Certified
from safe_envs.filters.conditions.text import spec_of
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.analysis import SAMPLES, SafeSetAnalysis, infeasible_part
from safe_envs.proofs.guarantees import (
    CertificateGuarantee,
    ChainGuarantee,
    Extremum,
    certificate_guarantee,
)
from safe_envs.proofs.safe_set import (
    Formulas,
    Region,
    largest,
    max_shortfall,
    supremum,
    where_inside,
    without_control,
)

SMALL = 0.01
"""Below this part of its typical size a control authority counts as small."""


@dataclass(frozen=True)
class SetFeasibility:
    """The feasibility of the conditions in a set: in C, or in the intersection of the C_j.

    Attributes:
        points: number of its points that were drawn.
        share: part of the workspace that it is; of C for the intersection.
        infeasible: part of its points where no action within the input bounds meets all conditions.
        shortfall: by how much the worst condition is violated at the worst state that a search met,
            0 if all can be met there; in the units of b_(r-1) per s.
        worst: that state, shape (n,); where the conditions are nearest to it if they can be met.
    """

    points: int
    share: float
    infeasible: float
    shortfall: float
    worst: np.ndarray


@dataclass(frozen=True)
class BarrierFindings:
    """The control authority over a barrier, and its suprema, as a search found them.

    Attributes:
        name: of the barrier.
        filter: text of its condition.
        degree: r.
        control_authority: smallest one that was met in C: half of the range of L_g b_(r-1) u over
            the input bounds.
        control_authority_at: the state where that is, shape (n,).
        typical: its median over C.
        small: part of C where it is below `SMALL` of that.
        small_infeasible: part of these points where no action meets all conditions.
        supremum: largest h that was met in C within the workspace, infinite where it grows with
            the ranges that were chosen for states without any.
        growth: how sure it is that it is infinite, in words; empty where it is not.
        deepest: the state where that is, or nearly, shape (n,).
        deepest_h: h there.
        deepest_shortfall: by how much its condition is violated there at best.
        suprema: likewise c_j of the b_j over the intersection, shape (r,); NaN if that is empty.
    """

    name: str
    filter: str
    degree: int
    control_authority: float
    control_authority_at: np.ndarray
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
        """Whether the control authority is 0 somewhere in C, to rounding."""
        return self.control_authority <= 1e-6 * self.typical


@dataclass(frozen=True)
class Verification:
    """The result of `verify`. Suprema are of a sample and a local search: estimates from below.

    Attributes:
        analysis: of the safe set.
        barriers: for each barrier.
        safe_set: C, where all barriers are positive.
        invariant_set: the intersection of the C_j, where all chains are positive, which the
            conditions make invariant. None if it is empty.
        beyond: whether C reaches beyond the workspace.
        undefined: part of C where a condition has no finite value.
    """

    analysis: SafeSetAnalysis
    barriers: tuple[BarrierFindings, ...]
    safe_set: SetFeasibility
    invariant_set: SetFeasibility | None
    beyond: bool
    undefined: float

    @property
    def formulas(self) -> Formulas:
        """The chains and conditions, compiled."""
        return self.analysis.formulas

    @property
    def problem(self) -> SafetyProblem:
        """The problem that was looked at."""
        return self.formulas.problem

    @property
    def region(self) -> Region:
        """The states that were searched."""
        return self.analysis.region

    @property
    def part(self) -> SetFeasibility:
        """The feasibility in the set that becomes invariant; in C if there is none."""
        return self.invariant_set or self.safe_set

    @cached_property
    def guarantee(self) -> ChainGuarantee | CertificateGuarantee:
        """The bounds of the conditions, with what the judge proves of them."""
        if any(isinstance(c, Certified) for c in self.formulas.conditions):
            return certificate_guarantee(self.formulas.problem, self.formulas.conditions)
        return ChainGuarantee(self.formulas, self.analysis)

    def suprema(self, i: int) -> tuple[Extremum, ...]:
        """Return the suprema c_j of a barrier's chain over the intersection of the C_j.

        Args:
            i: index of the barrier.
        """
        if isinstance(self.guarantee, ChainGuarantee):
            return self.guarantee.suprema[self.formulas.stages[i]]
        return tuple(map(Extremum, self.barriers[i].suprema.tolist()))

    def supremum(self, i: int) -> Extremum:
        """Return the supremum of a barrier over C within the workspace.

        Args:
            i: index of the barrier.
        """
        first_order = self.formulas.first_order
        return self.suprema(i)[0] if first_order else Extremum(self.barriers[i].supremum)

    def shortfall(self, part: SetFeasibility) -> Extremum:
        """Return the largest shortfall in a set.

        Args:
            part: `safe_set` or `invariant_set`, of which the judge knows the latter.
        """
        judged = part is self.invariant_set or self.formulas.first_order
        if judged and isinstance(self.guarantee, ChainGuarantee):
            return self.guarantee.shortfall
        return Extremum(part.shortfall)


def verify(
    problem: SafetyProblem,
    filters: Sequence[Condition],
    knowledge: str = "model",
    samples: int = SAMPLES,
    seed: int = 0,
) -> Verification:
    """Sample C, and search it for states without control authority or a feasible action.

    Args:
        problem: whose barriers, input bounds, ranges and system are taken.
        filters: one for each barrier.
        knowledge: what they know, "model" or "plant".
        samples: number of states in C at which the drawing ends.
        seed: of all randomness.

    Returns:
        What was found in C and in the invariant set.

    Raises:
        ConfigurationError: an argument is out of its range, or no state of C was found.
        RelativeDegreeError: a condition does not suit a barrier.
    """
    require_whole("samples", samples, 1)
    require_whole("seed", seed, 0)
    require_direct(problem, "proofs of a filter")
    formulas = Formulas(problem, filters, knowledge)
    analysis = SafeSetAnalysis(formulas, samples, seed)
    points = analysis.invariant_set
    share = float((formulas.invariant_level(analysis.safe.points) >= 0.0).mean())
    invariant = (
        points
        if points is None
        else SetFeasibility(len(points), share, analysis.infeasible, *analysis.max_shortfall)
    )
    safe = _safe_part(analysis, invariant)
    found = tuple(_barrier(i, analysis) for i in range(len(formulas.stages)))
    wide = analysis.region.beyond(analysis.rng(6))
    beyond = bool((formulas.barrier_level(wide) >= 0.0).any())
    return Verification(
        analysis,
        found,
        safe,
        invariant,
        beyond,
        len(analysis.undefined) / len(analysis.safe.points),
    )


def _safe_part(analysis: SafeSetAnalysis, invariant: SetFeasibility | None) -> SetFeasibility:
    """Return the part for C, which is that of the invariant set where this is all of C."""
    formulas, points = analysis.formulas, analysis.safe.points
    if invariant is not None and invariant.share == 1.0:
        return replace(invariant, share=analysis.safe.share)
    shortfall, state = max_shortfall(
        formulas,
        formulas.barrier_level,
        analysis.with_starts(points, formulas.barrier_level),
        analysis.rng(4),
    )
    return SetFeasibility(
        len(points), analysis.safe.share, infeasible_part(formulas, points), shortfall, state
    )


def _barrier(i: int, analysis: SafeSetAnalysis) -> BarrierFindings:
    formulas, region, safe, rng = (
        analysis.formulas,
        analysis.region,
        analysis.safe.points,
        analysis.rng(100 + i),
    )
    stages, level = formulas.stages[i], formulas.barrier_level
    size = formulas.control_authority(safe)[:, i]
    typical = float(np.nanmedian(size))
    negated, weakest = largest(
        lambda x: where_inside(level, x, lambda y: -formulas.control_authority(y)[:, i]),
        safe,
        region,
        rng,
    )
    small = safe[size < SMALL * typical]
    _, deepest = largest(
        lambda x: where_inside(level, x, lambda y: formulas.chain(y)[:, stages.start]),
        safe,
        region,
        rng,
    )
    deepest = without_control(formulas, i, deepest)
    suprema = analysis.suprema[stages]
    highest = (
        suprema[0]
        if formulas.first_order
        else supremum(
            stages.start, formulas, formulas.barriers, analysis.with_starts(safe, level), rng
        )
    )
    return BarrierFindings(
        name=formulas.problem.barriers[i].name,
        filter=spec_of(formulas.conditions[i]),
        degree=stages.stop - stages.start,
        control_authority=max(-negated, 0.0),
        control_authority_at=weakest,
        typical=typical,
        small=len(small) / len(safe),
        small_infeasible=infeasible_part(formulas, small),
        supremum=highest,
        growth=analysis.how_infinite(stages.start) if np.isinf(highest) else "",
        deepest=deepest,
        deepest_h=float(formulas.chain(deepest[None])[0, stages.start]),
        deepest_shortfall=max(float(formulas.own_shortfall(deepest[None])[0, i]), 0.0),
        suprema=suprema,
    )
