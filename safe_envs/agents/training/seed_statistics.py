"""Statistics over trainings: the interquartile mean and its bootstrap interval over seeds.

The interquartile mean leaves out the int(n/4) smallest and as many of the largest of n values, as
`rliable` does: of five seeds the middle three count, of fewer than four all.

The interval is the percentile interval of the bootstrap, with seeds drawn with replacement within
each env (the stratum). For one env of up to `_MOST_EXACT` seeds the distribution is enumerated: the
n^n draws are (2 n - 1 over n) multisets of multinomial weight, 126 for five seeds. For more it is
sampled. Such an interval of few seeds is too short; see `docs/guides/leaderboard.md` for how often
it holds.

Source: R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville, M. G. Bellemare, Deep reinforcement
learning at the edge of the statistical precipice, NeurIPS 2021, section 4 and appendix A.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement

import numpy as np

from safe_envs.agents.evaluation.statistics import require_confidence
from safe_envs.errors import ConfigurationError

_MOST_EXACT = 8
"""Seeds of one env up to which all draws are enumerated: 6435 multisets."""

_RESAMPLES = 20_000
_HOLDS = {2: 50, 3: 75, 4: 88, 5: 91}
"""In how many per cent of the cases the 95 % interval of so many normal values holds their mean."""

_CUT = 4
"""The part of the values that is left out at each end is one in so many."""


def caution(seeds: int) -> str:
    """Return what intervals over few seeds are worth, as a sentence; "" for many.

    Args:
        seeds: their number.
    """
    if seeds == 1:
        return "One seed tells nothing of others: its interval has no length."
    if seeds not in _HOLDS:
        return ""
    return (
        f"Where trainings scatter normally, the interval over {seeds} seeds holds the true value in"
        f" {_HOLDS[seeds]} % of the cases, not in 95 %; where all seeds agree it has no length."
    )


@dataclass(frozen=True)
class SeedEstimate:
    """An interquartile mean with its interval over seeds.

    Attributes:
        value: the interquartile mean.
        low: lower end of the interval.
        high: upper end.
        seeds: number of values.
    """

    value: float
    low: float
    high: float
    seeds: int


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of the values between the quartiles; see the module.

    Args:
        values: shape (..., n), in any order.

    Returns:
        Shape (...).
    """
    count = values.shape[-1]
    cut = count // _CUT
    return np.sort(values, axis=-1)[..., cut : count - cut].mean(axis=-1)


def over_seeds(
    strata: Sequence[Sequence[float]], confidence: float = 0.95, seed: int = 0
) -> SeedEstimate:
    """Return the interquartile mean of all values, with its stratified bootstrap interval.

    Args:
        strata: values of the seeds of each env, at least one.
        confidence: of the two-sided interval.
        seed: of the draws, where they are not enumerated.

    Raises:
        ConfigurationError: there is no value, one is not finite, or the confidence is out of range.
    """
    require_confidence(confidence)
    found = [np.asarray(each, dtype=np.float64) for each in strata]
    if not found or not all(each.size and np.isfinite(each).all() for each in found):
        raise ConfigurationError(
            f"the values of the seeds are {[each.tolist() for each in found]}; give at least one"
            " number for each env, none of them infinite"
        )
    exact = len(found) == 1 and found[0].size <= _MOST_EXACT
    means, weights = _enumerated(found[0]) if exact else _sampled(found, seed)
    tail = (1.0 - confidence) / 2.0
    joined = np.concatenate(found)
    return SeedEstimate(
        value=float(interquartile_mean(joined)),
        low=_quantile(means, weights, tail),
        high=-_quantile(-means, weights, tail),
        seeds=joined.size,
    )


def _enumerated(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the statistic of every multiset of draws, and in how many ways each is drawn."""
    chosen, ways = _multisets(values.size)
    return interquartile_mean(values[chosen]), ways


@cache
def _multisets(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the multisets of `count` of as many places, shape (M, count), and their draws."""
    chosen = np.array(list(combinations_with_replacement(range(count), count)))
    times = (chosen[:, None, :] == np.arange(count)[:, None]).sum(axis=-1)
    factorials = np.array([math.factorial(k) for k in range(count + 1)])
    return chosen, factorials[count] // factorials[times].prod(axis=-1)


def _sampled(strata: Sequence[np.ndarray], seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    drawn = [each[rng.integers(each.size, size=(_RESAMPLES, each.size))] for each in strata]
    return interquartile_mean(np.concatenate(drawn, axis=-1)), np.ones(_RESAMPLES, dtype=np.int64)


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """Return the smallest value up to which at least a share of the weights lies."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    # A share that is met but for rounding is met.
    place = int(np.searchsorted(below, share * below[-1] * (1.0 - 1e-12)))
    return float(values[order][place])
