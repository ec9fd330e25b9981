"""The bounds of a filter for continuous control, averaged over starts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.contradiction import by_states, without_continuous
from safe_envs.agents.evaluation.rows import BoundSummary, ContinuousWord, PosteriorSummary
from safe_envs.agents.evaluation.running_sum import RunningMean
from safe_envs.agents.evaluation.statistics import share
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.errors import SafeEnvsError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import Condition
from safe_envs.wrappers.conditions.parts import with_parts
from safe_envs.wrappers.verification.certificate_guarantee import CertificateGuarantee
from safe_envs.wrappers.verification.chain_guarantee import NOTHING, ChainGuarantee
from safe_envs.wrappers.verification.guarantee import Guarantee, guarantee_of
from safe_envs.wrappers.verification.judge import Word
from safe_envs.wrappers.verification.posterior_guarantee import PosteriorGuarantee

SECONDS = 6.0
"""Processor time of the search and of the judge for each filter: what is not decided by then is
undecided."""

_SIZES = ("delta", "supremum", "shortfall", "bias")
"""What a bound over a posterior is made of."""

_OPEN = ("refuted", "undecided")
"""The judge's words for what is not proved, the worst one first."""


class GuaranteeAverager:
    """The bound on P(safe up to the horizon) of conditions, averaged over the starts.

    It is of conditions that are met at every instant.

    For conditions that are robust over a posterior it is a bound of its own; see
    `safe_envs.wrappers.verification.posterior_guarantee`.

    For relative degree r >= 2 a condition keeps the intersection of the sets C_j = {b_j >= 0}, j <
    r, and from a start in C but outside of it, it guarantees nothing. The share of such starts is
    counted too.

    Args:
        conditions: one for each barrier; none for the unfiltered env.
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
        self._of_posterior = any(c.credible_set is not None for c in conditions)
        self._found: Guarantee | None = None
        self._why_none: str | None = why_not if conditions else "there is no filter"
        self._values = RunningMean()
        self._outside = _outside_of(conditions, problem, knowledge)
        self._lost, self._starts = 0, 0
        self._against, self._nothing = "", VisitedStates.nothing(problem)
        if conditions and not why_not:
            self._look(conditions, problem, knowledge)

    def _look(
        self, conditions: Sequence[Condition], problem: SafetyProblem, knowledge: str
    ) -> None:
        try:
            self._found = guarantee_of(problem, conditions, knowledge, SECONDS)
            self._why_none = self._found.note or _refuted(self._found) or None
        except SafeEnvsError as error:
            # The search covers the whole safe set, where the episodes may never be.
            self._why_none = str(error)

    def add(self, starts: np.ndarray) -> None:
        """Add the starts of a batch, shape (E, n)."""
        if self._found is not None and not self._why_none:
            self._values.add(self._found.at(starts, self._horizon))
            self._against = self._against or by_states(
                self._found, [replace(self._nothing, deepest=starts)]
            )
        if self._outside is not None:
            self._lost += int(np.count_nonzero(self._outside(starts)))
            self._starts += len(starts)

    def summary(self, visited: VisitedStates) -> BoundSummary:
        """Return the mean of the bound, or why there is none, and the share of starts outside C_j.

        Args:
            visited: states of the episodes; where they contradict the bound, it is withheld.
        """
        bound, note = self._mean()
        word = "none" if bound is None else self._word
        found = BoundSummary(
            outside_rate=share(self._lost, self._starts),
            continuous_bound=bound,
            continuous_word=word,
            continuous_note=note,
            continuous_error=0.0 if bound is None else self._values.error,
        )
        if self._of_posterior:
            of_posterior = isinstance(self._found, PosteriorGuarantee)
            names = (*_SIZES, "searched") if of_posterior else ()
            sizes = {name: getattr(self._found, name) for name in names}
            found = replace(
                found,
                continuous_bound=None,
                continuous_word="none",
                continuous_error=0.0,
                continuous_note="the condition is learned: see its bound over the posterior",
                posterior_bound=PosteriorSummary(bound, note, word, **sizes),
            )
        reason = (
            ""
            if bound is None or self._found is None
            else self._against or by_states(self._found, [visited])
        )
        return without_continuous(found, reason) if reason else found

    @property
    def _word(self) -> ContinuousWord:
        """What the bound is worth."""
        return "proved" if self._found and self._found.word == "proved" else "estimated"

    def _mean(self) -> tuple[float | None, str | None]:
        if self._found is None or self._why_none:
            return None, self._why_none
        mean, remark = self._values.mean, self._found.remark
        if not mean:
            return None, remark or NOTHING
        return mean, "; ".join(filter(None, [remark, _undecided(self._found)]))


def _judgement(found: Guarantee | CertificateGuarantee) -> tuple[Word, str]:
    """Return what the judge says of all that a bound asks for, and why it is not proved."""
    if isinstance(found, ChainGuarantee):
        return found.proof.word_of(any(found.stages.shortfalls))
    if isinstance(found, CertificateGuarantee):
        open_ = [v for w in _OPEN for _, v in found.statements if v.word == w]
        return (open_[0].word, open_[0].reason) if open_ else ("proved", "")
    # That of a posterior says so in its remark.
    return "proved", ""


def _refuted(found: Guarantee) -> str:
    """Return what the judge refutes of a bound; "" if nothing."""
    if found.note:
        return ""
    word, reason = _judgement(found)
    return reason * (word == "refuted")


def _undecided(found: Guarantee) -> str:
    """Return what the judge leaves undecided of a bound; "" if nothing."""
    word, reason = _judgement(found)
    return f"undecided: {reason}" * (word == "undecided")


def _outside_of(
    conditions: Sequence[Condition], problem: SafetyProblem, knowledge: str
) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return a function that finds the states in C but outside the sets C_j of conditions.

    It maps states (B, n) to booleans (B,); None where the sets are not known.
    """
    corrected = any(c.corrects_model for c in conditions)
    known = problem.plant if knowledge == "plant" and not corrected else problem.model
    if conditions:
        problem, conditions = with_parts(problem, conditions)
    rows = [
        c.constraint(known, barrier)
        for c, barrier in zip(conditions, problem.barriers, strict=bool(conditions))
    ]
    if not rows or any(row.terms is not None or row.alternatives for row in rows):
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


def together(summaries: Sequence[BoundSummary]) -> BoundSummary:
    """Return the bounds of several identifications as one.

    It has the mean of the bounds, with 0 for those that have none, and the worst's note. A bound
    that the episodes of one identification contradict is withheld for all.
    """
    outside = [each.outside_rate for each in summaries if each.outside_rate is not None]
    known = len(outside) == len(summaries)
    first = replace(
        summaries[0], outside_rate=math.fsum(outside) / len(summaries) if known else None
    )
    found = [each.posterior_bound for each in summaries if each.posterior_bound is not None]
    if len(summaries) == 1 or not found:
        return first
    worst = min(
        found,
        key=lambda c: (c.probability or 0.0, -(math.inf if c.shortfall is None else c.shortfall)),
    )
    reason = next((each.withheld for each in summaries if each.withheld), None)
    if all(c.probability is None for c in found):
        return replace(first, withheld=reason, posterior_bound=worst)
    mean: dict[str, Any] = {
        key: math.fsum(getattr(c, key) or 0.0 for c in found) / len(found)
        for key in ("probability", *_SIZES)
        if key == "probability" or all(getattr(c, key) is not None for c in found)
    }
    proved = all(c.word == "proved" for c in found)
    word: ContinuousWord = "proved" if proved else "estimated"
    searched = tuple(dict.fromkeys(name for c in found for name in c.searched or ()))
    summary = PosteriorSummary(note=worst.note, word=word, searched=searched, **mean)
    merged = replace(first, posterior_bound=summary)
    return without_continuous(merged, reason) if reason else merged
