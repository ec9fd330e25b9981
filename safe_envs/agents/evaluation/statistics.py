"""Intervals, tests and sums of the statistics of episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError


def require_confidence(confidence: Any) -> None:
    """Check that a confidence is a number between 0 and 1.

    Raises:
        ConfigurationError: it is not.
    """
    if not isinstance(confidence, int | float) or not 0.0 < confidence < 1.0:
        raise ConfigurationError(
            f"confidence = {confidence!r}; give a number above 0 and below 1, such as 0.95"
        )


def wilson_interval(
    successes: float, trials: float, confidence: float = 0.95
) -> tuple[float, float]:
    """Return Wilson's score interval for the probability of success of independent trials.

    Args:
        successes: how many of the trials succeeded.
        trials: at least 1.
        confidence: of the two-sided interval.

    Returns:
        The ends of the interval.

    Raises:
        ConfigurationError: the counts contradict each other, or the confidence is out of range.
    """
    low, high = _wilson(_counts(successes, trials), trials, _deviations(confidence))
    return float(low), float(high)


def rate_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Wilson's interval, or Clopper and Pearson's where all or no trials succeeded.

    For arguments and errors see `wilson_interval`.
    """
    low, high = rate_band(_counts(successes, trials), trials, confidence)
    return float(low), float(high)


def exact_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Clopper and Pearson's interval for the probability of success.

    Each of its ends is beyond the truth in at most (1 - confidence)/2 of all cases, whatever the
    truth. That of Wilson's interval is in several times as many where the truth is near 0 or 1: so
    claims are held against this one.

    For arguments and errors see `wilson_interval`.
    """
    require_confidence(confidence)
    _counts(successes, trials)
    tail = (1.0 - confidence) / 2.0
    low = 1.0 - exact_upper_end(trials - successes, trials, tail)
    return low, exact_upper_end(successes, trials, tail)


def exact_upper_end(successes: int, trials: int, error: float) -> float:
    """Return Clopper and Pearson's one-sided upper end for the probability of success.

    Args:
        successes: how many of the trials succeeded.
        trials: at least 1.
        error: part of all cases in which the end is below the truth, at most.
    """
    from scipy.special import betaincinv

    if successes == trials:
        return 1.0
    return float(betaincinv(successes + 1, trials - successes, 1.0 - error))


def rate_band(
    successes: np.ndarray, trials: int, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """Return the `rate_interval` of each count of an array.

    Args:
        successes: counts, shape (B,).
        trials: of each.
        confidence: of the intervals.

    Returns:
        The lower and the upper ends, shape (B,) each.
    """
    low, high = _wilson(successes, trials, _deviations(confidence))
    # The tail beyond the end on the one side is p^trials; the other end is 0 or 1.
    exact = ((1.0 - confidence) / 2.0) ** (1.0 / trials)
    return np.where(successes == trials, exact, low), np.where(successes == 0, 1.0 - exact, high)


def paired_difference_interval(
    both: float, only_first: float, only_second: float, neither: float, confidence: float = 0.95
) -> tuple[float, float]:
    """Return Newcombe's interval for the difference p1 - p2 of two rates of the same trials.

    The Wilson intervals of the two rates, squared and added with the outcomes' phi correlation,
    which is corrected for continuity where it is positive, and 0 where it is not defined.

    Source: R. G. Newcombe, Statistics in Medicine 17 (1998) 2635-2650, method 10.

    Args:
        both: trials in which both succeeded; a mean of several counts need not be whole, here and
            below.
        only_first: trials in which only the first succeeded.
        only_second: trials in which only the second succeeded.
        neither: trials in which neither succeeded.
        confidence: of the two-sided interval.

    Raises:
        ConfigurationError: there is no trial or a count is negative, or the confidence is out of
            range.
    """
    trials = both + only_first + only_second + neither
    if min(both, only_first, only_second, neither) < 0:
        raise ConfigurationError(
            f"counts of pairs are {(both, only_first, only_second, neither)}; give whole numbers"
            " from 0"
        )
    first, second = both + only_first, both + only_second
    together = both * neither - only_first * only_second
    if together > 0:
        together = max(together - trials / 2, 0.0)
    margins = first * (trials - first) * second * (trials - second)
    phi = together / math.sqrt(margins) if margins else 0.0
    (low1, high1), (low2, high2) = (
        wilson_interval(first, trials, confidence),
        wilson_interval(second, trials, confidence),
    )
    p1, p2 = first / trials, second / trials
    return p1 - p2 - _third_side(p1 - low1, high2 - p2, phi), p1 - p2 + _third_side(
        high1 - p1, p2 - low2, phi
    )


def repeated_interval(
    values: Sequence[float],
    of_trials: tuple[float, float],
    confidence: float,
    bounds: tuple[float, float],
) -> tuple[float, float]:
    """Return an interval for the mean of a quantity over draws that all trials share.

    Such a draw is an identification.

    All draws see the same trials, so that these do not average out: the distances from the mean to
    the ends of the interval over trials and those of Student's interval over draws are added as
    squares. That is a little wide, since the spread of the draws holds noise of the trials too.

    Args:
        values: one for each draw, at least two.
        of_trials: the interval that the trials alone would give the mean.
        confidence: of both.
        bounds: of what is estimated.

    Raises:
        ConfigurationError: there are fewer than two draws, or the confidence is out of range.
    """
    from scipy.special import stdtrit

    require_confidence(confidence)
    if len(values) < 2:
        raise ConfigurationError(f"{len(values)} draws were given; their spread needs at least 2")
    mean = math.fsum(values) / len(values)
    half = float(
        stdtrit(len(values) - 1, 0.5 + confidence / 2.0)
        * np.std(values, ddof=1)
        / math.sqrt(len(values))
    )
    low, high = of_trials
    return max(mean - math.hypot(mean - low, half), bounds[0]), min(
        mean + math.hypot(high - mean, half), bounds[1]
    )


def log_normal_interval(
    estimates: Sequence[float] | np.ndarray, confidence: float = 0.95
) -> tuple[float, float]:
    """Return an interval for the mean of positive estimates with nearly normal logarithms.

    Cox's interval for the mean of a log-normal variable, exp(+- t sqrt(s^2/R + s^4/(2 (R - 1))))
    with s the deviation of the R logarithms and t the quantile of Student's distribution, laid
    around the mean of the estimates, which is unbiased whatever their distribution. Student's
    interval of the estimates themselves errs to one side: the largest of them are the rarest.

    Args:
        estimates: independent ones, at least two, all above 0.
        confidence: of the two-sided interval.

    Raises:
        ConfigurationError: there are fewer than two estimates, one is not positive, or the
            confidence is out of range.

    Source: X.-H. Zhou and S. Gao, Statistics in Medicine 16 (1997) 783-790.
    """
    from scipy.special import stdtrit

    require_confidence(confidence)
    values = np.asarray(estimates, dtype=np.float64)
    if len(values) < 2 or not (values > 0.0).all():
        raise ConfigurationError(
            f"{len(values)} estimates were given; give at least two, all above 0"
        )
    degrees = len(values) - 1
    variance = float(np.var(np.log(values), ddof=1))
    half = float(stdtrit(degrees, 0.5 + confidence / 2.0)) * math.sqrt(
        variance / len(values) + variance**2 / (2.0 * degrees)
    )
    mean = math.fsum(values) / len(values)
    return mean * math.exp(-half), mean * math.exp(half)


def mcnemar_p(only_first: int, only_second: int) -> float:
    """Return McNemar's exact two-sided p value: were the pairs that differ fair coins?

    Args:
        only_first: pairs in which only the first succeeded.
        only_second: pairs in which only the second succeeded.

    Returns:
        The p value.
    """
    from scipy.special import bdtr

    fewer, differing = min(only_first, only_second), only_first + only_second
    return min(1.0, 2.0 * float(bdtr(fewer, differing, 0.5)))


def _third_side(a: float, b: float, cosine: float) -> float:
    return math.sqrt(max(a * a - 2.0 * cosine * a * b + b * b, 0.0))


def _wilson(successes: np.ndarray, trials: float, z: float) -> tuple[np.ndarray, np.ndarray]:
    return _wilson_low(successes, trials, z), 1.0 - _wilson_low(trials - successes, trials, z)


def _wilson_low(successes: np.ndarray, trials: float, z: float) -> np.ndarray:
    # In this form it is exactly 0 for no success.
    root = np.sqrt(z * z + 4.0 * successes * ((trials - successes) / trials))
    return (2.0 * successes + z * z - z * root) / (2.0 * (trials + z * z))


def _deviations(confidence: float) -> float:
    """Half the width of the two-sided interval of a standard normal variable."""
    from scipy.special import ndtri

    require_confidence(confidence)
    return -float(ndtri((1.0 - confidence) / 2.0))


def _counts(successes: float, trials: float) -> np.ndarray:
    if not 0 <= successes <= trials or trials < 1:
        raise ConfigurationError(
            f"{successes} successes in {trials} trials; give at least one trial, and from 0 to all"
            " successes"
        )
    return np.asarray(successes)


def share(part: float, whole: float) -> float | None:
    """Return part / whole, or None where there is nothing to share.

    Args:
        part: of the whole.
        whole: 0 where there is nothing.
    """
    return part / whole if whole else None
