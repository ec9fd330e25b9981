"""The bounds of a filter, averaged over the starts of the episodes, as far as the episodes do not
contradict them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from safe_envs.agents.evaluation.contradiction import by_states, withheld
from safe_envs.agents.evaluation.rollout import Row
from safe_envs.agents.evaluation.statistics import RunningSum, share
from safe_envs.agents.evaluation.visited_states import Seen
from safe_envs.dynamics.codegen import Components, compile_function, stacked
from safe_envs.errors import SafeEnvsError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import BayesianSCBF, Condition
from safe_envs.wrappers.verification.guarantee import Guarantee, guarantee_of
from safe_envs.wrappers.verification.posterior_guarantee import PosteriorGuarantee

_SIZES = ("delta", "supremum", "shortfall", "bias")
"""What a bound over a posterior is made of."""


class GuaranteeAverager:
    """The estimated bound on P(safe up to the horizon) of conditions, averaged over the starts.

    For conditions that are robust over a posterior it is a bound of its own; see
    `safe_envs.wrappers.verification.posterior_guarantee`.

    For relative degree r >= 2 a condition keeps the intersection of the sets C_j = {b_j >= 0}, j <
    r, and from a start in C but outside of it, it promises nothing. How many starts are there is
    counted too.

    Args:
        conditions: one for each barrier; none of the bare env.
        problem: whose barriers they keep.
        knowledge: of the filter, "model" or "plant".
        why_not: why not to look for a bound at all, if so.
    """

    def __init__(
        self,
        conditions: Sequence[Condition],
        problem: SafetyProblem,
        knowledge: str,
        why_not: str | None = None,
    ) -> None:
        self._horizon = problem.duration
        self._of_posterior = any(
            isinstance(c, BayesianSCBF) and c.simultaneous is not None for c in conditions
        )
        self._found: Guarantee | None = None
        self._why_none: str | None = why_not if conditions else "there is no filter"
        self._total, self._count = RunningSum(), 0
        self._outside = _outside_of(conditions, problem, knowledge)
        self._lost, self._starts = 0, 0
        self._against, self._nothing = "", Seen.nothing(problem)
        if conditions and not why_not:
            self._look(conditions, problem, knowledge)

    def _look(
        self, conditions: Sequence[Condition], problem: SafetyProblem, knowledge: str
    ) -> None:
        try:
            self._found = guarantee_of(problem, conditions, knowledge)
            self._why_none = self._found.note
        except SafeEnvsError as error:
            # The bound looks at the whole safe set, where the episodes may never be.
            self._why_none = str(error)

    def add(self, start: Components, count: int) -> None:
        """Take the starts of a wave."""
        states = np.stack(start, axis=1)[:count]
        if self._found is not None and not self._why_none:
            self._total.add(self._found.at(states, self._horizon))
            self._against = self._against or by_states(
                self._found, [replace(self._nothing, deepest=states)]
            )
            self._count += count
        if self._outside is not None:
            self._lost += int(np.count_nonzero(self._outside(states)))
            self._starts += count

    def row(self, seen: Seen) -> Row:
        """The mean of the bound, None where there is none, and why there is none or why it is weak.

        Beside it the share of the starts with h > 0 that lie outside the sets C_j; None of the bare
        env, and where numbers that are learned stand in the chain.

        Args:
            seen: in the episodes; where it contradicts the bound, that is withheld.
        """
        bound, note = self._mean()
        row: Row = {"withheld": None, "outside_rate": share(self._lost, self._starts)}
        if self._of_posterior:
            found = self._found if isinstance(self._found, PosteriorGuarantee) else None
            sizes = {} if found is None else {name: getattr(found, name) for name in _SIZES}
            row |= {
                "estimated_bound": None,
                "bound_note": "the condition is learned: see its bound over the posterior",
            }
            row |= {"posterior_bound": {"probability": bound, "note": note, **sizes}}
        else:
            row |= {"estimated_bound": bound, "bound_note": note, "posterior_bound": None}
        reason = (
            ""
            if bound is None or self._found is None
            else self._against or by_states(self._found, [seen])
        )
        return withheld(row, reason) if reason else row

    def _mean(self) -> tuple[float | None, str | None]:
        if self._found is None or self._why_none:
            return None, self._why_none
        mean, remark = share(self._total.total, self._count), self._found.remark
        return (
            (mean, remark)
            if mean
            else (None, remark or "it is 0 at these starts up to this horizon")
        )


def _outside_of(
    conditions: Sequence[Condition], problem: SafetyProblem, knowledge: str
) -> Callable[[np.ndarray], np.ndarray] | None:
    """Tells of states (B, n) which of them are in C, and outside the sets C_j that conditions keep;
    None where these are not known."""
    corrected = any(c.corrects_model for c in conditions)
    known = problem.plant if knowledge == "plant" and not corrected else problem.model
    rows = [
        c.constraint(known, barrier)
        for c, barrier in zip(conditions, problem.barriers, strict=bool(conditions))
    ]
    if not rows or any(row.terms is not None for row in rows):
        return None
    later = [b for row in rows for b in row.chain[1:]]
    if not later:
        return lambda x: np.zeros(len(x), dtype=bool)
    expressions = [*(row.chain[0] for row in rows), *later]
    chain = compile_function(known.states, [known.numeric(e) for e in expressions], "arrays")

    def outside(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            values = stacked(chain(*np.ascontiguousarray(x.T)), len(x))
        safe, left = (
            (values[:, : len(rows)] > 0.0).all(axis=1),
            (values[:, len(rows) :] <= 0.0).any(axis=1),
        )
        return np.logical_and(safe, left)

    return outside


def together(rows: Sequence[Row]) -> Row:
    """The rows of several identifications as one: the mean of their bounds, with 0 for those that
    have none, and the worst's note.

    A bound that the episodes of one identification contradict is withheld for all.
    """
    outside = [row["outside_rate"] for row in rows]
    first = {**rows[0], "outside_rate": None if None in outside else math.fsum(outside) / len(rows)}
    found = [row["posterior_bound"] for row in rows]
    if len(rows) == 1 or first["posterior_bound"] is None:
        return first
    worst = min(found, key=lambda c: (c["probability"] or 0.0, -c.get("shortfall", math.inf)))
    reason = next((row["withheld"] for row in rows if row["withheld"]), None)
    if worst["probability"] is None and all(c["probability"] is None for c in found):
        return {**first, "withheld": reason, "posterior_bound": worst}
    mean = {
        key: math.fsum(c[key] or 0.0 for c in found) / len(rows)
        for key in ("probability", *_SIZES)
        if all(key in c for c in found)
    }
    merged = {**first, "posterior_bound": {"note": worst["note"], **mean}}
    return withheld(merged, reason) if reason else merged
