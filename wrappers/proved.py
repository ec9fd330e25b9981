"""The bound that is proved for conditions, quickly: for the table of an evaluation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from safe_envs.problem import SafetyProblem
from wrappers import bounds
from wrappers.conditions import Condition
from wrappers.formulas import Formulas
from wrappers.promise import Stages, amount, assembled, infinite, mismatch, no_bound, outlasting
from wrappers.safe_set import region_of, sample
from wrappers.verify import kept_points, supremum, worst

_SAMPLES = 2048


@dataclass(frozen=True)
class ProvedBound:
    """The largest proved bound of conditions.

    Attributes:
        note: why there is none; None if there is one.
        remark: why it is weaker than what the condition promises where it can be met everywhere; may be empty.
    """

    note: str | None
    remark: str
    _formulas: Formulas
    _stages: Stages | None

    def at(self, starts: np.ndarray, horizon: float) -> np.ndarray:
        """The bound on P(safe up to a horizon in s) at each start; states (B, n) in, values (B,) out; 0 where there is none."""
        b, stages = self._formulas.chain(np.asarray(starts, dtype=np.float64)), self._stages
        if stages is None:
            return np.zeros(len(b))
        if not self._formulas.certain:
            return bounds.union_bound(b, stages.suprema, horizon, stages.rates, stages.shortfalls)
        if any(stages.shortfalls):
            return outlasting(stages, b, horizon)
        return (b > 0.0).all(axis=1).astype(float)


def proved_bound(problem: SafetyProblem, conditions: Sequence[Condition], knowledge: str = "model") -> ProvedBound:
    """What conditions are proved to promise: quick, deterministic, and without a look at more than that needs.

    The suprema and the shortfall are estimated as in `verify`, from fewer points.

    Args:
        problem: as for `verify`.
        conditions: as for `verify`.
        knowledge: as for `verify`.

    Raises:
        ConfigurationError: see `verify`; likewise RelativeDegreeError and NumericalError.
    """
    formulas = Formulas(problem, conditions, knowledge)
    note = no_bound(formulas) or mismatch(formulas)
    if note:
        return ProvedBound(note, "", formulas, None)
    rng = np.random.default_rng(0)
    region = region_of(problem, formulas.system, formulas.expressions)
    safe = sample("C", formulas.barrier_level, region, _SAMPLES, rng)
    kept = kept_points(formulas, region, safe, rng)
    if kept is None:
        return ProvedBound("the sets C_j have no state in common", "", formulas, None)
    # Where every path is kept, no supremum matters.
    suprema = np.ones(formulas.stages[-1].stop)
    for i, stages in enumerate(() if formulas.certain else formulas.stages):
        for j in range(stages.start, stages.stop):
            suprema[j] = supremum(j, formulas, slice(None), kept, region, rng)
            if np.isinf(suprema[j]):
                return ProvedBound(infinite(problem.barriers[i].name, j - stages.start), "", formulas, None)
    shortfall, _ = worst(formulas, formulas.kept_level, kept, region, rng)
    found = assembled(formulas, suprema, shortfall)
    remark = f"no action meets the condition somewhere, {amount(formulas, shortfall)}" if shortfall else ""
    if formulas.certain and shortfall and (formulas.noisy or any(map(math.isnan, found.rates))):
        return ProvedBound(remark, "", formulas, None)
    return ProvedBound(None, remark, formulas, found)
