"""Results of episodes, and rows with the statistics of filters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

import numpy as np

from safe_envs.agents.evaluation.statistics import Curve, exact_interval, share
from safe_envs.envs.info import Info
from safe_envs.filters.estimation.consistency import Consistency, consistency_of


@dataclass(frozen=True)
class EstimationResults:
    """Sums over the control instants of each episode, arrays of shape (E,).

    All instants count while an episode runs, also those after a violation: given that none
    happened, an honest belief would not be what it is.

    Attributes:
        instants: how many there are.
        nees: normalized estimation errors squared.
        nees_dof: their degrees of freedom.
        nis: normalized innovations squared.
        nis_dof: their degrees of freedom, the values that were received.
        lost: values that were lost.
        outside: whether a belief barrier was negative at some instant.
    """

    instants: np.ndarray
    nees: np.ndarray
    nees_dof: np.ndarray
    nis: np.ndarray
    nis_dof: np.ndarray
    lost: np.ndarray
    outside: np.ndarray

    def part(self, where: slice) -> EstimationResults:
        """Return the sums of some of the episodes."""
        return EstimationResults(*(getattr(self, field.name)[where] for field in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[EstimationResults]) -> EstimationResults:
        """Return the episodes of all parts, one part after the other."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class EstimationCounts:
    """Sums of episodes that run side by side.

    Args:
        size: number of envs.
        info: at their start.
    """

    def __init__(self, size: int, info: Info) -> None:
        self._sums = {
            name: np.zeros(size) for name in ("instants", "nees", "nees_dof", "nis", "nis_dof")
        }
        self._lost, self._outside = np.zeros(size), np.zeros(size, dtype=bool)
        self.add(info, np.ones(size, dtype=bool))

    def add(self, info: Info, alive: np.ndarray) -> None:
        """Count the instant that envs have reached.

        Args:
            info: of the envs.
            alive: the episodes that reached it, bool (size,).
        """
        for name, sums in self._sums.items():
            sums += np.where(alive, 1.0 if name == "instants" else info[name], 0.0)
        np.copyto(self._lost, info["lost"], where=alive)
        if "belief_barrier" in info:
            self._outside |= alive & (info["belief_barrier"].min(axis=1) < 0.0)

    def results(self, count: int) -> EstimationResults:
        """Return the sums of the first `count` episodes."""
        found: dict[str, Any] = {name: sums[:count] for name, sums in self._sums.items()}
        return EstimationResults(**found, lost=self._lost[:count], outside=self._outside[:count])


@dataclass(frozen=True)
class EstimationSummary:
    """How good the estimates under a filter were.

    Attributes:
        nees: mean normalized estimation error squared; None for a single episode.
        nis: mean normalized innovation squared; likewise.
        lost_rate: share of the measured values that were lost.
        outside_rate: share of the episodes in which a belief barrier was negative at some instant;
            None without belief conditions.
        outside_low: lower end of its interval.
        outside_high: upper end.
        delta: probability that the conditions allow errors of the estimate beyond their margin.
        bound_word: "proved" where P(unsafe) <= P(outside) + delta is, "designed" elsewhere.
        bound_note: why it is not proved.
    """

    nees: Consistency | None
    nis: Consistency | None
    lost_rate: float | None
    outside_rate: float | None = None
    outside_low: float | None = None
    outside_high: float | None = None
    delta: float | None = None
    bound_word: str = "designed"
    bound_note: str | None = None

    @property
    def unsafe_at_most(self) -> float | None:
        """Upper end of the share of episodes outside, and delta; None without belief conditions."""
        if self.outside_high is None or self.delta is None:
            return None
        return min(1.0, self.outside_high + self.delta)


def summary_of(
    found: EstimationResults, confidence: float, delta: float | None, why_not_proved: str | None
) -> EstimationSummary:
    """Return the summary of episodes.

    Args:
        found: of each episode.
        confidence: of the intervals.
        delta: of the belief conditions; None without any.
        why_not_proved: why their bound is not proved; None where it is.
    """
    instants = found.instants
    received, lost = float(found.nis_dof.sum()), float(found.lost.sum())
    common = (
        consistency_of(found.nees, found.nees_dof, instants, confidence),
        consistency_of(found.nis, found.nis_dof, instants, confidence),
        share(lost, received + lost),
    )
    if delta is None:
        return EstimationSummary(*common)
    outside, episodes = int(found.outside.sum()), len(instants)
    low, high = exact_interval(outside, episodes, confidence)
    word = "designed" if why_not_proved else "proved"
    return EstimationSummary(*common, outside / episodes, low, high, delta, word, why_not_proved)


HeldWord = Literal["proved", "certified", "computed", "withheld", "none"]
"""What a bound for the env's own steps is worth: the judge proved it; it is of a table that was
checked by outward-rounded arithmetic; it is of a table of floating-point numbers; episodes or a
table contradict it; or there is none."""

ContinuousWord = Literal["proved", "estimated", "withheld", "none"]
"""What a bound for continuous control is worth: the judge proved all hypotheses and numbers; it
left one undecided, which a search did not find to fail; episodes contradict it; or there is
none."""


RowKind = Literal["filter", "unfiltered"]
"""What a row is of: a filter, or the env without one."""


@dataclass(frozen=True)
class EpisodeResults:
    """What became of each episode, in their order: arrays of shape (E,).

    Attributes:
        returns: sum of the rewards of the whole episode.
        min_h: minimum h of the whole episode.
        first_violation: control instant of the first h <= 0; -1 where there is none.
        length: control periods until the episode ended.
        interventions: periods in which the filter changed the action, up to a first violation.
        infeasible: those of them in which no action met all conditions.
        effort: mean |u|^2 of the periods up to a first violation; NaN where there is none.
    """

    returns: np.ndarray
    min_h: np.ndarray
    first_violation: np.ndarray
    length: np.ndarray
    interventions: np.ndarray
    infeasible: np.ndarray
    effort: np.ndarray

    @property
    def safe(self) -> np.ndarray:
        """Whether each episode is safe."""
        return self.first_violation < 0

    @property
    def counted(self) -> np.ndarray:
        """Periods up to a first violation, those in which conditions mean something."""
        return np.where(self.safe, self.length, self.first_violation)

    def columns(self, name: str, repeat: int, first: int, dt: float) -> dict[str, np.ndarray]:
        """Return the results as columns, of which the first three say whose they are.

        Args:
            name: of the filter.
            repeat: number of the identification.
            first: number of the first of these episodes.
            dt: control period in s.

        Returns:
            What `Evaluation.episode_columns` tells, shape (E,) each.
        """
        count = len(self.length)
        return {
            "filter": np.full(count, name),
            "identification": np.full(count, repeat),
            "episode": np.arange(first, first + count),
            "safe": self.safe,
            "return": self.returns,
            "min_h": self.min_h,
            "first_violation": np.where(self.safe, np.nan, dt * self.first_violation),
            "length": self.length,
            "interventions": self.interventions,
            "infeasible": self.infeasible,
            "effort": self.effort,
        }

    def part(self, where: slice) -> EpisodeResults:
        """Return the results of some of the episodes."""
        return EpisodeResults(*(getattr(self, field.name)[where] for field in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[EpisodeResults]) -> EpisodeResults:
        """Return the episodes of all parts, one part after the other."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, kw_only=True)
class EpisodeSummary:
    """Statistics of the episodes under a filter.

    Attributes:
        episodes: how many; with several identifications of all of them.
        safe: number of safe ones.
        safety_rate: their share.
        ci_low: lower end of its interval.
        ci_high: upper end.
        min_h_median: median of the minimum h over the first 65,536 episodes, -inf where h has no
            value.
        min_h_p05: 5 % quantile of it.
        violations: number of episodes that are not safe.
        touching: how many of these come no lower than h = 0 to rounding.
        below_rounding: how many, these included, go no lower than a billionth of the largest h of
            their episode, as where a filter rides h = 0.
        worst_below_rounding: how low the lowest of them goes.
        intervention_rate: share of the steps up to a first violation; None if there is no such.
        infeasible_rate: share of these steps.
        effort_mean: mean over episodes of the mean |u|^2 of these steps.
        return_mean: mean return.
        curve: safety rate over time.
    """

    episodes: int
    safe: int
    safety_rate: float
    ci_low: float
    ci_high: float
    min_h_median: float
    min_h_p05: float
    violations: int
    touching: int
    below_rounding: int = 0
    worst_below_rounding: float = 0.0
    intervention_rate: float | None
    infeasible_rate: float | None
    effort_mean: float | None
    return_mean: float
    curve: Curve


@dataclass(frozen=True)
class PosteriorSummary:
    """A bound over the posterior of what was learned, averaged over the starts.

    Attributes:
        probability: the bound; None where there is none.
        note: why there is none, or why it is weak or not proved.
        word: what it is worth, given the posterior.
        delta: probability that the identification does not contain the system; None, as those
            below, where no bound was looked for.
        supremum: c.
        shortfall: m, in 1/s.
        bias: e of the steps, in 1/s.
        searched: which of supremum and shortfall a search found, below their true values.
    """

    probability: float | None
    note: str | None
    word: ContinuousWord = "none"
    delta: float | None = None
    supremum: float | None = None
    shortfall: float | None = None
    bias: float | None = None
    searched: tuple[str, ...] | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON-able data, less what is not there."""
        given = asdict(self)
        head = {name: given.pop(name) for name in ("probability", "note", "word")}
        return head | {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class BoundSummary:
    """The bounds of a filter, averaged over starts, unless the episodes contradict them.

    They are two claims: one is of the env's own steps, where the input is held between control
    instants, and one of conditions that are met at every instant.

    Attributes:
        withheld: how the episodes contradict a bound, which is withheld then.
        outside_rate: share of the starts in the safe set outside the sets C_j, which no bound of
            continuous control covers; None without a filter, and where the sets are not known.
        held_bound: on the probability of being safe in the env's own steps; None where there is
            none.
        held_word: what it is worth.
        held_note: what it is of, or why there is none.
        held_error: its standard error as the mean over all starts; 0 for one start.
        continuous_bound: on the probability of being safe in continuous control; None where there
            is none.
        continuous_word: what it is worth.
        continuous_note: why there is none, or why it is weak or not proved.
        continuous_error: its standard error as the mean over all starts; 0 for one start.
        posterior_bound: that over the posterior; None where the filter is not robust over one.
    """

    withheld: str | None = None
    outside_rate: float | None = None
    held_bound: float | None = None
    held_word: HeldWord = "none"
    held_note: str | None = None
    held_error: float = 0.0
    continuous_bound: float | None = None
    continuous_word: ContinuousWord = "none"
    continuous_note: str | None = None
    continuous_error: float = 0.0
    posterior_bound: PosteriorSummary | None = None


@dataclass(frozen=True)
class LearningSummary:
    """What was learned for a filter.

    Attributes:
        methods: names of the methods.
        repeats: number of identifications.
        transitions: of each identification.
        seeds: of each.
        sha256: of each model.
        files: from which models were read.
        errors: mean held-out errors by name.
        warnings: of the learning.
        remarks: what does not fit the heading of an evaluation.
        rates: safety rate with each identification.
    """

    methods: list[str]
    repeats: int
    transitions: int
    seeds: list[int | None]
    sha256: list[str]
    files: list[str]
    errors: dict[str, float]
    warnings: list[str]
    remarks: list[str]
    rates: list[float]


_HEIGHTS = ("min_h_median", "min_h_p05")


@dataclass(frozen=True, kw_only=True)
class EvaluationRow(BoundSummary, EpisodeSummary):
    """All that an evaluation finds for one filter.

    Attributes:
        filter: its name, "none" without one.
        policy: name of the policy.
        kind: what the row is of.
        learning: what was learned for the filter; None where nothing was.
        estimation: how good the estimates were; None at the true state.
    """

    filter: str
    policy: str
    kind: RowKind
    learning: LearningSummary | None = None
    estimation: EstimationSummary | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the row as JSON-able data; h is null where it has no value."""
        head = {"filter": self.filter, "policy": self.policy, "kind": self.kind}
        bound = self.posterior_bound
        found: dict[str, Any] = head | asdict(self) | {"posterior_bound": bound and bound.as_dict()}
        found |= {name: None for name in _HEIGHTS if not math.isfinite(found[name])}
        if self.estimation is None:
            del found["estimation"]
        if not self.below_rounding:
            del found["below_rounding"], found["worst_below_rounding"]
        return found
