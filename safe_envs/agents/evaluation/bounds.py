"""Bounds for the env's own steps: the input is held, and safety is judged at control instants.

Each is a lower bound on the probability of a safe episode of a policy under a filter, or of every
policy under it: from the table of a promise filter, say. `held_bound_of` chooses among them.

A bound is withheld, and the reason said, where the episodes themselves show that it, or a number it
uses, is wrong: a start or a visited state has a b_j above the supremum c_j, the filter violated a
condition by more than the shortfall m, or the interval of the measured rate lies below the bound.
See `safe_envs.proofs.guarantees.ChainGuarantee.contradiction` for the first two.

The intervals are exact ones: see `safe_envs.agents.evaluation.statistics.exact_interval`. A bound
that is proved is withheld only where an interval of 99.9 % lies below it, which happens by chance
in at most .05 % of all cases.

A bound for the env's own steps and the rates stand in a chain: bound <= rate <= what any policy can
attain. Where the bound is above the last number, one of both is wrong; see `above_attainable`. A
bound for continuous control is of another process, which the episodes come near to where dt is
small: a rate below it contradicts that the two are near, or the bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np

from safe_envs.agents.evaluation.episodes import VisitedStates
from safe_envs.agents.evaluation.resolve import FilterParts
from safe_envs.agents.evaluation.rows import (
    BoundSummary,
    ContinuousWord,
    EvaluationRow,
    PosteriorSummary,
)
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.evaluation.statistics import RunningMean, exact_interval, share
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.errors import ConfigurationError, SafeEnvsError, shown
from safe_envs.filters.conditions.base import Condition, with_parts
from safe_envs.filters.conditions.text import FilterSettings
from safe_envs.problem.actuators import why_not_direct
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.backup_filter import BackupFilter, BackupSettings
from safe_envs.proofs.guarantees import NOTHING, CertificateGuarantee, ChainGuarantee
from safe_envs.proofs.judge import Word
from safe_envs.proofs.posterior import Guarantee, PosteriorGuarantee, guarantee_of
from safe_envs.text import percents_apart
from safe_envs.values.closed_loop import ClosedLoop, ClosedLoopTable, closed_loop_for
from safe_envs.values.promise_filter import (
    ROUNDING,
    PromiseSettings,
    promise_filter_for,
    why_not_of_plant,
    why_not_of_safety,
)


@dataclass(frozen=True)
class FilteredPolicy:
    """A policy under a filter.

    Attributes:
        problem: what is simulated.
        parts: of the filter; no conditions for the unfiltered env.
        knowledge: of the filter, "model" or "plant".
        policy: its name, "nominal" for the problem's own; "" for an object.
        objective: of the filter, "nearest" or "clf".
        closed_loop: whether a table of its closed loop was asked for.
    """

    problem: SafetyProblem
    parts: FilterParts
    knowledge: str
    policy: str
    objective: str = "nearest"
    closed_loop: bool = False


class HeldInputBound:
    """A lower bound on the probability of a safe episode, in the env's own steps.

    Attributes:
        word: what it is worth; see `safe_envs.agents.evaluation.rows.HeldWord`.
        note: what it is of.
        why_none: why there is none at any start; "" where there may be one.
        nowhere: what to say where it is 0 at all starts.
    """

    word: Literal["certified", "computed"]
    note: str
    why_none: str
    nowhere: str

    def at(self, starts: np.ndarray) -> np.ndarray:
        """Return the bound up to the problem's horizon at starts (B, n): values in [0, 1], (B,)."""
        raise NotImplementedError

    def contradiction(self, visited: VisitedStates) -> str:
        """Return how states of episodes contradict it; "" where none could, but their rate.

        Args:
            visited: states of the episodes.
        """
        return ""


COMPUTED_PLANS = "1 where a backup law keeps the start safe; plans are of floating-point numbers"
"""Note on such a bound."""

STATED = "; that {} keep the terminal sets that are stated is assumed, but for samples"
"""What is added to it where terminal sets were not derived."""


class BackupBound(HeldInputBound):
    """The guarantee of a backup filter: no violation from where a law keeps the system safe.

    It holds for every policy and horizon, as `safe_envs.proofs.backup_filter` proves, for
    a plant without noise that is the filter's system.

    Args:
        settings: of the filter.
        problem: what is simulated.
        knowledge: of the filter, "model" or "plant".
    """

    word = "computed"
    nowhere = "no backup law keeps any of the starts safe"

    def __init__(self, settings: BackupSettings, problem: SafetyProblem, knowledge: str) -> None:
        self._filter = BackupFilter.for_problem(problem, settings, knowledge)
        stated = ", ".join(self._filter.stated)
        self.note = COMPUTED_PLANS + (STATED.format(stated) if stated else "")
        self.why_none = self._filter.why_not(problem.plant)

    def at(self, starts: np.ndarray) -> np.ndarray:
        """Return the bound at starts, 0 or 1; see `HeldInputBound.at`."""
        x = tuple(np.ascontiguousarray(starts.T))
        plans = self._filter.plans
        h = np.array([np.broadcast_to(c, len(starts)) for c in plans.barriers(plans.part(x))])
        return (self._filter.domain(x) & (h > 0.0).all(axis=0)).astype(float)


_FORMULAS = ("nominal", "zero")
"""Policies that are formulas of the state."""


class ClosedLoopBound(HeldInputBound):
    """What a table of a closed loop says of a controller, or of every policy under a filter.

    It holds up to the horizon of the problem, as proposition 8 of the page on values proves.

    Args:
        table: of the closed loop; None where there is none.
        note: what it is of, or why there is none.
    """

    word = "certified"
    nowhere = (
        "the table of the closed loop has 0 at these starts: a step moves states by too little for"
        " its cells"
    )

    def __init__(self, table: ClosedLoopTable | None, note: str) -> None:
        self._table = table
        self.note = note
        self.why_none = "" if table is not None else note

    def at(self, starts: np.ndarray) -> np.ndarray:
        """Return the bound at starts; see `HeldInputBound.at`."""
        if self._table is None:
            return np.zeros(len(starts))
        if len(starts) and (starts == starts[0]).all():
            one = self._table.start_bounds(starts[0][:, None])
            return np.repeat(one, len(starts))
        return self._table.start_bounds(tuple(np.ascontiguousarray(starts.T)))


def closed_loop_bound(of: FilteredPolicy) -> ClosedLoopBound | None:
    """Return the bound of a table, which is computed if need be, or why there is none.

    Args:
        of: the policy and the filter, or the policy alone.

    Returns:
        None for a filter that acts by itself, and where no table was asked for.
    """
    if not of.closed_loop or isinstance(of.parts, FilterSettings):
        return None
    try:
        table = closed_loop_for(_loop_of(of))
    except SafeEnvsError as error:
        return ClosedLoopBound(None, str(error))
    cells = " x ".join(map(str, table.grid.shape))
    whose = "of this policy" if of.policy in _FORMULAS else "of every policy under the filter"
    return ClosedLoopBound(table, f"by a table {whose}, {cells} cells")


def compute_closed_loop(
    of: FilteredPolicy, progress: Progress | None = None
) -> ClosedLoopTable | None:
    """Have the table computed that `closed_loop_bound` reads.

    Args:
        of: the policy and the filter, or the policy alone.
        progress: called with the part of the work that is done.

    Returns:
        The table, which is there as long as it is in use, also without a cache; None where there
        is none, as `closed_loop_bound` says.
    """
    table = None
    if not isinstance(of.parts, FilterSettings):
        try:
            table = closed_loop_for(_loop_of(of), progress)
        except SafeEnvsError:
            table = None
    if progress is not None:
        progress(1.0)
    return table


def _loop_of(of: FilteredPolicy) -> ClosedLoop:
    """Return the closed loop of a policy under a filter; raise SafeEnvsError if it is not one."""
    assert not isinstance(of.parts, FilterSettings)
    policy = of.policy if of.policy in _FORMULAS else "any"
    if not of.parts and policy == "any":
        raise ConfigurationError(
            f"the policy {shown(of.policy)} is no formula of the state; without a filter, tables"
            f" are of {' and '.join(_FORMULAS)}"
            if of.policy
            else "the policy is no formula of the state"
        )
    if of.parts and of.objective != "nearest":
        raise ConfigurationError(
            f"objective = {of.objective}: tables are of filters that take the nearest input"
        )
    return ClosedLoop(of.problem, of.parts[0] if of.parts else None, policy, of.knowledge)


COMPUTED_TABLE = "computed: the table is of floating-point numbers"
"""Note on such a bound."""


class PromiseBound(HeldInputBound):
    """The guarantee of a promise filter: p_0 = min(p, one step of look-ahead).

    It holds for every policy, up to the horizon, as `safe_envs.values.promise_filter`
    proves, where the filter's table is of the plant. With a specification it is of the probability
    of meeting that, P(spec), and a bound of being safe where P(safe) >= P(spec): where no episode
    meets the specification that leaves C. Else there is none.

    Args:
        settings: of the filter.
        problem: what is simulated.
        knowledge: of the filter, "model" or "plant".
    """

    word = "computed"
    note = COMPUTED_TABLE
    nowhere = "no start is in the table's safe set"

    def __init__(self, settings: PromiseSettings, problem: SafetyProblem, knowledge: str) -> None:
        self._filter = promise_filter_for(problem, settings, knowledge)
        self.why_none = why_not_of_plant(problem, settings, knowledge) or why_not_of_safety(
            problem, settings
        )

    def at(self, starts: np.ndarray) -> np.ndarray:
        """Return p_0 at starts; see `HeldInputBound.at`."""
        return self._filter.start(tuple(np.ascontiguousarray(starts.T)))

    def contradiction(self, visited: VisitedStates) -> str:
        """Return by how much p_k had to be lowered, which a right table never makes necessary.

        Args:
            visited: states of the episodes; their slack is by how much p_k was lowered.
        """
        lost = float(visited.slack.max(initial=0.0))
        if lost <= ROUNDING:
            return ""
        return f"no input kept p_k in a step, which fell by {lost:.2g}: the table is wrong"


SURE = 0.999
"""Confidence of the intervals that may contradict what is proved, or a table."""

Bounded = TypeVar("Bounded", bound=BoundSummary)

ADVICE = "bounds are of continuous time: try a smaller dt, or --refine"

_ADVICE_PROVED = "an interval misses the truth at times: try more episodes; else report an error"
_ADVICE_COMPUTED = "an interval misses the truth at times: try more episodes, or another table"
_DEVIATIONS = 3.0
_SURE_WORDS = ("proved", "certified")


def by_states(bound: Guarantee, visited: Sequence[VisitedStates]) -> str:
    """Return how the states of episodes contradict the numbers of a bound; "" if they do not.

    Args:
        bound: for continuous control.
        visited: states of the episodes.
    """
    found = (
        bound.contradiction(each.deepest, each.violating, each.actions, each.slack)
        for each in visited
    )
    return next(filter(None, found), "")


def by_rate(bound: float | None, ci_high: float, advice: str = ADVICE) -> str:
    """Return how the interval of a measured rate contradicts a bound; "" if it does not.

    Args:
        bound: on the probability of being safe, None for none.
        ci_high: upper end of the interval.
        advice: what to do.
    """
    if bound is None or ci_high >= bound:
        return ""
    end, least = percents_apart(ci_high, bound)
    return f"the interval of the measured rate ends at {end} %, below {least} %; {advice}"


def upper_ends(safe: int, episodes: int, confidence: float) -> tuple[float, float]:
    """Return the upper ends of exact intervals of a rate, for `end_for`.

    Args:
        safe: number of safe episodes.
        episodes: number of all.
        confidence: of the first interval; that of the second is `SURE`.
    """
    high, sure_high = (exact_interval(safe, episodes, each)[1] for each in (confidence, SURE))
    return high, max(high, sure_high)


def upper_ends_of(row: EvaluationRow, confidence: float) -> tuple[float, float]:
    """Return the `upper_ends` of a row's rate.

    Args:
        row: of an evaluation; over several identifications its own interval is all there is.
        confidence: of the first interval.
    """
    if row.learning is not None and row.learning.repeats > 1:
        return row.ci_high, row.ci_high
    return upper_ends(row.safe, row.episodes, confidence)


def end_for(word: str, ci_high: float, sure_high: float) -> float:
    """Return the end of an interval that a bound may not be above.

    Args:
        word: what the bound is worth.
        ci_high: upper end of the interval of a rate.
        sure_high: that of a wider one, for what is proved.
    """
    return sure_high if word in _SURE_WORDS else ci_high


def judged(row: Bounded, ci_high: float, sure_high: float) -> Bounded:
    """Return a row without the bounds that a measured rate contradicts; `withheld` says why.

    Args:
        row: of an evaluation.
        ci_high: upper end of the interval of the rate.
        sure_high: upper end of a wider one, which a proved bound is held against.
    """
    advice = _ADVICE_COMPUTED if row.held_word == "computed" else _ADVICE_PROVED
    reason = by_rate(row.held_bound, end_for(row.held_word, ci_high, sure_high), advice)
    return continuous_judged(without_held(row, reason) if reason else row, ci_high, sure_high)


def continuous_judged(row: Bounded, ci_high: float, sure_high: float) -> Bounded:
    """Return a row without the bounds of continuous control that a rate contradicts.

    Args:
        row: of an evaluation.
        ci_high: upper end of the interval of a rate, maybe with a smaller control period.
        sure_high: upper end of a wider one, which a proved bound is held against.
    """
    posterior = row.posterior_bound
    end = end_for(row.continuous_word, ci_high, sure_high)
    reason = by_rate(row.continuous_bound, end) or by_rate(
        posterior and posterior.probability, ci_high
    )
    return without_continuous(row, reason) if reason else row


def above_attainable(row: BoundSummary, upper: float | None) -> str:
    """Return how the bound for the env's own steps contradicts what is attainable; "" if not.

    Args:
        row: with the bound, whose mean over some starts may be off by a few of its errors.
        upper: bound from above of what any policy attains, counted as the rates are; None for none.
    """
    if row.held_bound is None or upper is None:
        return ""
    if row.held_bound - _DEVIATIONS * row.held_error <= upper:
        return ""
    most, least = percents_apart(upper, row.held_bound)
    return f"the bound for held input, {least} %, is above what any policy can attain, {most} %"


def without_held(row: Bounded, reason: str) -> Bounded:
    """Return a row without its bound for the env's own steps, and with the reason.

    Args:
        row: with the bound.
        reason: how it is contradicted.
    """
    return replace(
        row,
        withheld=row.withheld or reason,
        held_bound=None,
        held_word="withheld",
        held_note=f"withheld: {reason}",
        held_error=0.0,
    )


def without_continuous(row: Bounded, reason: str) -> Bounded:
    """Return a row without its bounds for continuous control, and with the reason.

    Args:
        row: with bounds.
        reason: how they are contradicted.
    """
    note, posterior = f"withheld: {reason}", row.posterior_bound
    row = replace(row, withheld=row.withheld or reason, continuous_bound=None)
    if posterior is None:
        return replace(row, continuous_word="withheld", continuous_note=note, continuous_error=0.0)
    none = replace(posterior, probability=None, note=note, word="withheld")
    return replace(row, posterior_bound=none)


NO_FILTER = "there is no filter"
_NO_BOUND = "no table of the env's own step is known for it"
_BETWEEN = "it is of control instants, not of the time between them"


def held_bound_of(of: FilteredPolicy) -> HeldInputBound | str:
    """Return the bound of a policy under a filter for the env's own steps, or why there is none.

    Args:
        of: the policy and the filter.
    """
    why_not = why_not_direct(of.problem, "bounds of a filter")
    if why_not:
        return why_not
    closed_loop = closed_loop_bound(of)
    found: list[HeldInputBound] = [] if closed_loop is None else [closed_loop]
    if isinstance(of.parts, PromiseSettings):
        found.append(PromiseBound(of.parts, of.problem, of.knowledge))
    if isinstance(of.parts, BackupSettings):
        found.append(BackupBound(of.parts, of.problem, of.knowledge))
    if not found:
        return _NO_BOUND if of.parts else NO_FILTER
    best = next((bound for bound in found if not bound.why_none), found[0])
    return best.why_none or best


class HeldAverager:
    """Averages the bound of a filter for the env's own steps over the starts of episodes.

    Args:
        bound: of the filter, or why there is none.
    """

    def __init__(self, bound: HeldInputBound | str) -> None:
        self._bound = bound
        self._values = RunningMean()

    def add(self, starts: np.ndarray) -> None:
        """Add the starts of a batch, shape (E, n)."""
        if not isinstance(self._bound, str):
            self._values.add(self._bound.at(starts))

    def put_in(self, summary: BoundSummary, visited: VisitedStates) -> BoundSummary:
        """Return a summary with the mean of the bound, or with why there is none.

        Args:
            summary: of the other bounds.
            visited: states of the episodes; where they contradict the bound, it is withheld.
        """
        bound = self._bound
        if isinstance(bound, str):
            return replace(summary, held_note=bound)
        mean = self._values.mean
        if not mean:
            return replace(summary, held_note=bound.nowhere)
        reason = bound.contradiction(visited)
        if reason:
            return without_held(summary, reason)
        return replace(
            summary,
            held_bound=mean,
            held_word=bound.word,
            held_note=bound.note,
            held_error=self._values.error,
        )


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
    `safe_envs.proofs.posterior`.

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
    """Return a function that finds the states in C but outside the sets C_j of conditions."""
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


OF_TRUE_STATES = "it is of filters at the true state"
"""Why conditions at an estimate have no bound for continuous control."""


class BoundAverager:
    """Averages both bounds of a filter over the starts of episodes.

    Args:
        of: the policy and the filter.
        monitoring: where h is checked, "discrete" or "continuous".
        why_not: why not to look for bounds at all, if so.
    """

    def __init__(
        self, of: FilteredPolicy, monitoring: str = "discrete", why_not: str | None = None
    ) -> None:
        why_not_held = why_not or (_BETWEEN if monitoring == "continuous" else "")
        nothing = why_not_held if of.parts else NO_FILTER
        self._held = HeldAverager(nothing if why_not_held else held_bound_of(of))
        self._continuous: GuaranteeAverager | str
        if isinstance(of.parts, FilterSettings):
            self._continuous = of.parts.only_of_steps
        elif any(c.belief is not None or c.measurement_error for c in of.parts):
            self._continuous = OF_TRUE_STATES
        else:
            self._continuous = GuaranteeAverager(of.parts, of.problem, of.knowledge, why_not)

    def add(self, starts: np.ndarray) -> None:
        """Add the starts of a batch, shape (E, n)."""
        self._held.add(starts)
        if not isinstance(self._continuous, str):
            self._continuous.add(starts)

    def summary(self, visited: VisitedStates) -> BoundSummary:
        """Return the means of the bounds, or why there are none.

        Args:
            visited: states of the episodes; bounds that they contradict are withheld.
        """
        found = (
            BoundSummary(continuous_note=self._continuous)
            if isinstance(self._continuous, str)
            else self._continuous.summary(visited)
        )
        return self._held.put_in(found, visited)
