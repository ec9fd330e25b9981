"""The bound that is estimated for conditions, quickly: for the table of an evaluation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions import Condition
from safe_envs.wrappers.verification import bounds
from safe_envs.wrappers.verification.assumptions import (
    amount,
    failures,
    mismatch,
    no_bound,
    unbounded,
    unverified_assumptions,
)
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.guarantee import Stages, assembled, outlasting
from safe_envs.wrappers.verification.observed import above_suprema, below_slack
from safe_envs.wrappers.verification.safe_set_analysis import SafeSetAnalysis


@dataclass(frozen=True)
class EstimatedBound:
    """The largest bound of conditions, with the suprema and the shortfall that a search found: an
    estimate.

    Attributes:
        note: why there is none; None if there is one.
        remark: why it is weaker than what the condition promises where it can be met everywhere;
            may be empty.
    """

    note: str | None
    remark: str
    _formulas: Formulas
    _stages: Stages | None

    def at(self, starts: np.ndarray, horizon: float) -> np.ndarray:
        """The bound on P(safe up to a horizon in s) at each start; states (B, n) in, values (B,)
        out; 0 where there is none."""
        b, stages = self._formulas.chain(np.asarray(starts, dtype=np.float64)), self._stages
        if stages is None:
            return np.zeros(len(b))
        if not self._formulas.certain:
            return bounds.union_bound(b, stages.suprema, horizon, stages.rates, stages.shortfalls)
        if any(stages.shortfalls):
            return outlasting(stages, b, horizon)
        return (b > 0.0).all(axis=1).astype(float)

    def contradiction(
        self, reached: np.ndarray, missed: np.ndarray, actions: np.ndarray, slack: np.ndarray
    ) -> str:
        """What states say against the numbers that the bound rests on; "" if nothing, or if there
        is no bound.

        Args:
            reached: states that were reached, starts among them, shape (B, n).
            missed: states where the filter missed its conditions, shape (E, n).
            actions: what it executed there, shape (E, m).
            slack: by how much it says to have missed, shape (E,); the actions themselves say how
                much of it a sampling margin is.
        """
        if self._stages is None:
            return ""
        high = above_suprema(self._formulas, self._stages.suprema, reached)
        return high or below_slack(self._formulas, max(self._stages.shortfalls), missed, actions)


def estimated_bound(
    problem: SafetyProblem, conditions: Sequence[Condition], knowledge: str = "model"
) -> EstimatedBound:
    """The bound that is estimated for conditions: deterministic, and without a look at more than
    that needs.

    The suprema and the shortfall are those of `verify` with its defaults.

    Args:
        problem: as for `verify`.
        conditions: as for `verify`.
        knowledge: as for `verify`.

    Raises:
        ConfigurationError: see `verify`; likewise RelativeDegreeError.
    """
    formulas = Formulas(problem, conditions, knowledge)
    # What needs no search comes first.
    note = no_bound(formulas) or mismatch(formulas)
    return (
        EstimatedBound(note, "", formulas, None) if note else from_survey(SafeSetAnalysis(formulas))
    )


def from_survey(survey: SafeSetAnalysis) -> EstimatedBound:
    """The bound that is estimated by what a survey found."""
    formulas = survey.formulas
    note = no_bound(formulas) or _note(survey)
    if note:
        return EstimatedBound(note, "", formulas, None)
    shortfall, _ = survey.missed
    # Where every path is kept, no supremum matters.
    suprema = np.ones(formulas.stages[-1].stop) if formulas.certain else survey.suprema
    found = assembled(formulas, suprema, shortfall)
    remark = f"no action meets the condition somewhere, {amount(shortfall)}" if shortfall else ""
    if formulas.certain and shortfall and (formulas.noisy or any(map(math.isnan, found.rates))):
        return EstimatedBound(remark, "", formulas, None)
    return EstimatedBound(None, remark, formulas, found)


def _note(survey: SafeSetAnalysis) -> str:
    """Why there is no bound, the first of several reasons; may be empty."""
    if survey.kept is None:
        return "the sets C_j have no state in common"
    against = [*failures(survey), unbounded(survey), *unverified_assumptions(survey)]
    return next(filter(None, against), "")
