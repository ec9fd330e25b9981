"""The chain of a filter that is verified: bound for held input <= measured rate <= attainable.

All of it is of the env's own steps. The bound for continuous control is another claim, and stands
next to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.attainable import AttainableSafety, contradicted
from safe_envs.agents.evaluation.bound_check import MeasuredSafety
from safe_envs.agents.evaluation.contradiction import judged
from safe_envs.agents.evaluation.filtered_policy import FilteredPolicy
from safe_envs.agents.evaluation.held_input import HeldAverager, held_bound_of
from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.agents.evaluation.yardstick import against_attainable
from safe_envs.wrappers import spec_of
from safe_envs.wrappers.conditions.filter_settings import FilterSettings
from safe_envs.wrappers.verification.results import HOLDING, Bound


@dataclass(frozen=True)
class SafetyChain:
    """The bounds of a filter, its measured rate, and what any policy can attain.

    Attributes:
        bounds: for held input and for continuous control.
        rate: measured from the problem's start, up to its horizon; None where it was not.
        ci_low: lower end of the 95 % interval of the rate.
        ci_high: upper end.
        best: attainable safety, if it was asked for.
    """

    bounds: BoundSummary
    rate: float | None
    ci_low: float | None
    ci_high: float | None
    best: AttainableSafety | None

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON-able data."""
        found = asdict(self.bounds)
        shown = {name: value for name, value in found.items() if name in _SHOWN}
        rate = {"safety_rate": self.rate, "ci_low": self.ci_low, "ci_high": self.ci_high}
        return shown | rate | {"best": self.best and self.best.as_dict()}


_SHOWN = (
    *("withheld", "held_bound", "held_word", "held_note", "held_error"),
    *("continuous_bound", "continuous_word", "continuous_note", "continuous_error"),
)


def safety_chain(
    filtered: FilteredPolicy,
    starts: np.ndarray,
    bounds: Sequence[Bound],
    measurements: Sequence[MeasuredSafety],
    best: AttainableSafety | None = None,
) -> SafetyChain:
    """Return the chain of conditions, without what contradicts another part of it.

    Args:
        filtered: the conditions, and the policy that was simulated.
        starts: over which the bounds are averaged, shape (B, n).
        bounds: for continuous control, as far as they are not contradicted.
        measurements: of the problem's start first; none without a simulation.
        best: attainable safety, if it was asked for.
    """
    problem = filtered.problem
    assert not isinstance(filtered.parts, FilterSettings)
    name = spec_of(filtered.parts)
    averager = HeldAverager(held_bound_of(filtered))
    averager.add(starts)
    first = measurements[0] if measurements else None
    visited = first.visited if first and first.visited else [VisitedStates.nothing(problem)]
    summary = _of_continuous(bounds)
    for each in visited:
        summary = averager.put_in(summary, each)
        if summary.withheld:
            break
    rates = None, None, None
    if first is not None:
        h = first.horizons[0]
        rates = h.rate, h.ci_low, h.ci_high
        # The bounds for continuous control were judged before, with all measurements.
        held = judged(replace(summary, continuous_bound=None), *first.ends(h))
        summary = replace(held, continuous_bound=summary.continuous_bound)
        episodes = 1 if first.repeats else first.episodes
        best = best and contradicted(best, [(name, round(h.rate * episodes), episodes)])
    if best is not None:
        best, summary = against_attainable(best, best.upper, name, summary)
    return SafetyChain(summary, *rates, best)


def _of_continuous(bounds: Sequence[Bound]) -> BoundSummary:
    """Return the largest bound that is proved, or else the largest one that is estimated."""
    for word in HOLDING:
        found = [b for b in bounds if b.status == word and b.value]
        if found:
            largest = max(found, key=lambda b: b.value or 0.0)
            return BoundSummary(
                continuous_bound=largest.value,
                continuous_word="proved" if word == "proved" else "estimated",
                continuous_note=largest.reason,
                continuous_error=largest.error,
            )
    against = next((b for b in bounds if b.status == "withheld"), bounds[-1])
    word = "withheld" if against.status == "withheld" else "none"
    note = against.reason or "it is 0 at these starts up to this horizon"
    return BoundSummary(continuous_word=word, continuous_note=note)
