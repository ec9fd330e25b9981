"""Estimates of rare violations, and what contradicts them."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.statistics import exact_interval, log_normal_interval
from safe_envs.agents.rare_events.splitting import LEAST, Repetitions
from safe_envs.problem.problem import SafetyProblem

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
    def of(
        cls, method: str, estimates: np.ndarray, confidence: float, skew: float = 0.0
    ) -> RareEstimate:
        """Make an estimate from those of the repetitions, shape (R,), all above 0.

        Args:
            method: by which they were estimated.
            estimates: of the repetitions.
            confidence: of the interval.
            skew: see `skewed_interval`.
        """
        low, high = skewed_interval(estimates, confidence, skew)
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


def skewness(estimates: np.ndarray) -> float:
    """Return the third moment about the mean of estimates, in units of their deviation."""
    deviation = float(np.std(estimates))
    return (
        float(np.mean((estimates - np.mean(estimates)) ** 3)) / deviation**3 if deviation else 0.0
    )


def skewed_interval(
    estimates: np.ndarray, confidence: float, skew: float = 0.0
) -> tuple[float, float]:
    """Return an interval for the mean of positive estimates, of which the largest are the rarest.

    It is that for nearly normal logarithms, see
    `safe_envs.agents.evaluation.statistics.log_normal_interval`. Some estimates are more skewed
    than that, on the side on which a probability is taken for too small: the upper end is that of
    Johnson's interval where this is larger, which has the third moment in place of a distribution.

    Args:
        estimates: of the repetitions, shape (R,).
        confidence: of the two-sided interval.
        skew: of other estimates of the same. It counts where it is larger: a few estimates seldom
            hold the large ones that make the moment what it is.

    Source: N. J. Johnson, Modified t tests and confidence intervals for asymmetrical populations,
        Journal of the American Statistical Association 73 (1978) 536-544.
    """
    from scipy.special import stdtrit

    low, high = log_normal_interval(estimates, confidence)
    count, mean = len(estimates), float(np.mean(estimates))
    deviation, skew = float(np.std(estimates, ddof=1)), max(skew, skewness(estimates))
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


def plain_episodes(found: Repetitions, confidence: float) -> PlainEpisodes:
    """Return the episodes with which repetitions begin.

    Args:
        found: the repetitions.
        confidence: of the interval of the violations among them.
    """
    paths, count = found.paths, found.paths.lowest.size
    low, high = exact_interval(found.first, count, confidence)
    return PlainEpisodes(count, found.first, low, high, paths.outside, paths.kept_length)


def why_none(
    found: Repetitions, particles: int, problem: SafetyProblem, plain: PlainEpisodes
) -> str:
    """Return why repetitions have no estimate.

    Args:
        found: the repetitions, of which some were given up.
        particles: of each.
        problem: that was simulated.
        plain: the episodes with which they begin.
    """
    repetitions = len(found.estimates)
    h = "h" if len(problem.barriers) == 1 else "h/h(start)"
    if found.stuck:
        reason = (
            f"in {len(found.stuck)} of {repetitions} repetitions all {particles} particles stood at"
            f" one level and none came below {h} = {min(found.stuck):.3g}. There h may be flat,"
            " jump or never fall, or those that come lower are too few: more particles or a"
            " smaller dt may help"
        )
    else:
        reason = (
            f"in {len(found.endless)} of {repetitions} repetitions the probability to come below"
            f" {h} = {min(found.endless):.3g} is less than {LEAST:g} already; h = 0 may never be"
            " reached"
        )
    if not plain.violations:
        return reason
    seen = f"{plain.violations} of the {plain.episodes} plain episodes at its beginning violated"
    return f"{reason}. But {seen}, which says [{plain.ci_low:.3g}, {plain.ci_high:.3g}]"
