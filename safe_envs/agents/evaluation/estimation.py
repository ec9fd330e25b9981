"""What became of the estimates in episodes, and whether an estimator is as certain as it may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.statistics import exact_interval, share
from safe_envs.envs.info import Info
from safe_envs.wrappers.estimation.consistency import Consistency, consistency_of


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
