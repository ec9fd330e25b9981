"""Estimates of rare violations, and what contradicts them."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.statistics import log_normal_interval

_ROUGH = 0.4
"""Standard deviation of the logarithms of repetitions above which their interval is doubted."""


@dataclass(frozen=True)
class RareEstimate:
    """A probability, from independent repetitions.

    Attributes:
        method: by which it was estimated.
        probability: mean of the repetitions.
        ci_low: lower end of its interval.
        ci_high: upper end.
        relative_error: standard error of the mean over the mean.
        estimates: of the repetitions.
    """

    method: str
    probability: float
    ci_low: float
    ci_high: float
    relative_error: float
    estimates: list[float]

    @classmethod
    def of(cls, method: str, estimates: np.ndarray, confidence: float) -> RareEstimate:
        """Make an estimate from those of the repetitions, shape (R,), all above 0.

        Args:
            method: by which they were estimated.
            estimates: of the repetitions.
            confidence: of the interval.
        """
        low, high = skewed_interval(estimates, confidence)
        p = math.fsum(estimates) / len(estimates)
        error = float(np.std(estimates, ddof=1)) / math.sqrt(len(estimates)) / p
        return cls(method, p, low, min(high, 1.0), error, estimates.tolist())

    def __str__(self) -> str:
        return f"{self.probability:.3g} [{self.ci_low:.3g}, {self.ci_high:.3g}]"


@dataclass(frozen=True)
class PlainEpisodes:
    """The episodes with which splitting begins.

    Attributes:
        episodes: how many.
        violations: among them.
        ci_low: lower end of the interval of their share.
        ci_high: upper end.
        outside: how many start where h <= 0.
        kept_length: mean length of those that do not violate, in control periods; None without any.
    """

    episodes: int
    violations: int
    ci_low: float
    ci_high: float
    outside: int = 0
    kept_length: float | None = None


@dataclass(frozen=True, kw_only=True)
class RareRow:
    """What is estimated for one filter.

    Attributes:
        filter: its name.
        policy: name of the policy.
        status: "estimated" or "none".
        reason: why there is no estimate.
        method: as all up to `estimates` see `RareEstimate`; None without one.
        probability: of a violation.
        ci_low: lower end of its interval.
        ci_high: upper end.
        relative_error: of the probability.
        estimates: of the repetitions.
        plain_episodes_needed: for the same relative error without splitting.
        plain_steps_needed: control periods of these.
        doubt: what contradicts the estimate.
        check: that of the pilot, by another method.
        particles: episodes of a repetition.
        levels: mean number of levels.
        steps: control periods that were simulated.
        plain: the episodes at the beginning.
    """

    filter: str
    policy: str
    status: str
    reason: str | None = None
    method: str | None = None
    probability: float | None = None
    ci_low: float | None = None
    ci_high: float | None = None
    relative_error: float | None = None
    estimates: tuple[float, ...] | list[float] = ()
    plain_episodes_needed: float | None = None
    plain_steps_needed: float | None = None
    doubt: str | None = None
    check: RareEstimate | None = None
    particles: int = 0
    levels: float = 0.0
    steps: int = 0
    plain: PlainEpisodes | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the row as JSON-able data."""
        return asdict(self) | {"estimates": list(self.estimates)}


def skewed_interval(estimates: np.ndarray, confidence: float) -> tuple[float, float]:
    """Return an interval for the mean of positive estimates, of which the largest are the rarest.

    It is that for nearly normal logarithms, see
    `safe_envs.agents.evaluation.statistics.log_normal_interval`. Some estimates are more skewed
    than that, on the side on which a probability is taken for too small: the upper end is that of
    Johnson's interval where this is larger, which has the third moment in place of a distribution.

    Args:
        estimates: of the repetitions, shape (R,).
        confidence: of the two-sided interval.

    Source: N. J. Johnson, Modified t tests and confidence intervals for asymmetrical populations,
        Journal of the American Statistical Association 73 (1978) 536-544.
    """
    from scipy.special import stdtrit

    low, high = log_normal_interval(estimates, confidence)
    count, mean = len(estimates), float(np.mean(estimates))
    deviation = float(np.std(estimates, ddof=1))
    spread = float(np.std(estimates))
    skew = float(np.mean((estimates - mean) ** 3)) / spread**3 if spread else 0.0
    t = float(stdtrit(count - 1, 0.5 + confidence / 2.0)) / math.sqrt(count)
    return low, max(high, mean + deviation * (t + skew * (1.0 / (6.0 * count) + t**2 / 3.0)))


def doubt_of(found: RareEstimate, check: RareEstimate | None, plain: PlainEpisodes) -> str | None:
    """Return what contradicts an estimate; None if nothing does.

    Args:
        found: the estimate.
        check: that of the pilot, by another method; None if it is by the same.
        plain: the plain episodes.
    """
    if check is not None and not _overlap(found, check):
        return (
            f"{check.method} says {check.probability:.2g} [{check.ci_low:.2g},"
            f" {check.ci_high:.2g}]: take more particles"
        )
    if not _overlap(found, plain):
        return (
            f"the first episodes are plain ones, and {plain.violations} violations among"
            f" {plain.episodes} contradict it: take more particles"
        )
    spread = float(np.std(np.log(found.estimates), ddof=1))
    if spread > _ROUGH:
        return (
            f"its repetitions differ, with a standard deviation of {spread:.2g} of their"
            " logarithms, so that the interval may miss the probability: take more particles"
        )
    return None


def _overlap(one: RareEstimate, other: RareEstimate | PlainEpisodes) -> bool:
    return one.ci_low <= other.ci_high and other.ci_low <= one.ci_high
