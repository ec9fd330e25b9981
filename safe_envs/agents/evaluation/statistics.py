"""Intervals, tests and sums of the statistics of episodes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem


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


class SafeFlags:
    """Which of consecutive episodes are safe, in their order.

    It is all that is always kept of a single episode, to count the pairs of two filters: 1.25 MB
    for 10,000,000 episodes.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._rest = np.empty(0, dtype=bool)

    @classmethod
    def of(cls, safe: np.ndarray) -> SafeFlags:
        """Return the flags of an array of booleans, shape (E,)."""
        found = cls()
        found.add(safe)
        return found

    def add(self, safe: np.ndarray) -> None:
        """Add the episodes that follow, shape (B,)."""
        bits = np.concatenate((self._rest, safe))
        whole = len(bits) - len(bits) % 8
        self._bytes += np.packbits(bits[:whole]).tobytes()
        # A view would keep all of the bits.
        self._rest = bits[whole:].copy()

    def __len__(self) -> int:
        return 8 * len(self._bytes) + len(self._rest)

    @property
    def packed(self) -> np.ndarray:
        """The flags as bits of bytes, of which those past the last episode are 0."""
        return np.concatenate(
            (np.frombuffer(bytes(self._bytes), dtype=np.uint8), np.packbits(self._rest))
        )

    @property
    def array(self) -> np.ndarray:
        """The flags as booleans, shape (E,)."""
        return np.unpackbits(self.packed, count=len(self)).astype(bool)


Table = tuple[int, int, int, int]


@dataclass(frozen=True)
class Comparison:
    """Two filters on the same episodes.

    Attributes:
        first: name of the one.
        second: name of the other.
        both: number of episodes that are safe with both.
        only_first: with the first only.
        only_second: with the second only.
        neither: with neither.
        difference: of the safety rates, the first less the second.
        ci_low: lower end of its interval.
        ci_high: upper end.
        mcnemar_p: McNemar's exact p value; None with several identifications, which are no
            independent pairs.
    """

    first: str
    second: str
    both: int
    only_first: int
    only_second: int
    neither: int
    difference: float
    ci_low: float
    ci_high: float
    mcnemar_p: float | None


def pair_counts(first: SafeFlags, second: SafeFlags) -> Table:
    """Count the episodes that are safe with both, the first only, the second only, and neither.

    Args:
        first: which episodes are safe with the one.
        second: which of the same are with the other.

    Returns:
        The four counts.

    Raises:
        ValueError: one has more episodes than the other.
    """
    if len(first) != len(second):
        raise ValueError(f"{len(first)} and {len(second)} episodes are not the same ones")
    a, b = first.packed, second.packed
    both, only_first, only_second = (_ones(each) for each in (a & b, a & ~b, b & ~a))
    return both, only_first, only_second, len(first) - both - only_first - only_second


def _ones(packed: np.ndarray) -> int:
    return int(np.bitwise_count(packed).sum())


def compare_all(safe: Mapping[str, Sequence[SafeFlags]], confidence: float) -> list[Comparison]:
    """Compare each filter with those before it, by which of the same episodes are safe.

    A p value is of its pair alone: it is not adjusted for the number of pairs.

    Args:
        safe: by filter, which episodes are safe: once, or with each of several identifications.
        confidence: of the interval of the difference of the rates.

    Returns:
        A comparison for each pair.
    """
    return [
        _compare(second, first, _tables(safe[second], safe[first]), confidence)
        for first, second in combinations(safe, 2)
    ]


def _tables(first: Sequence[SafeFlags], second: Sequence[SafeFlags]) -> list[Table]:
    """Count with each identification; what has only one is paired with all of the other's."""
    count = max(len(first), len(second))
    return [pair_counts(first[r % len(first)], second[r % len(second)]) for r in range(count)]


def _compare(first: str, second: str, tables: Sequence[Table], confidence: float) -> Comparison:
    both, only_first, only_second, neither = (sum(counts) for counts in zip(*tables, strict=True))
    repeats = len(tables)
    low, high = paired_difference_interval(
        both / repeats, only_first / repeats, only_second / repeats, neither / repeats, confidence
    )
    if repeats > 1:
        differences = [(table[1] - table[2]) / sum(table) for table in tables]
        low, high = repeated_interval(differences, (low, high), confidence, (-1.0, 1.0))
    return Comparison(
        first,
        second,
        both,
        only_first,
        only_second,
        neither,
        difference=(only_first - only_second) / (both + only_first + only_second + neither),
        ci_low=low,
        ci_high=high,
        # Repeats on the same episodes are no independent pairs.
        mcnemar_p=mcnemar_p(only_first, only_second) if repeats == 1 else None,
    )


class RunningSum:
    """Sum of values in the order given, the same to the last bit in any portions."""

    def __init__(self) -> None:
        self.total = 0.0

    @classmethod
    def of(cls, values: np.ndarray) -> float:
        """Return the sum of values, shape (B,), added one after the other."""
        found = cls()
        found.add(values)
        return found.total

    def add(self, values: np.ndarray) -> None:
        """Add values, shape (B,), one after the other."""
        # cumsum is sequential, where sum() would pair the values up by position.
        self.total = float(np.cumsum(np.concatenate(([self.total], values)))[-1])


class RunningMean:
    """Mean of values and its standard error, the same to the last bit in any portions.

    Attributes:
        count: number of values.
    """

    def __init__(self) -> None:
        self.count = 0
        self._sum, self._squares = RunningSum(), RunningSum()

    def add(self, values: np.ndarray) -> None:
        """Add values, shape (B,), one after the other."""
        self._sum.add(values)
        self._squares.add(values**2)
        self.count += len(values)

    @property
    def mean(self) -> float | None:
        """The mean; None without values."""
        return self._sum.total / self.count if self.count else None

    @property
    def error(self) -> float:
        """The standard error of the mean as that over all values there might be; 0 of one value."""
        if self.count < 2 or not self._sum.total:
            return 0.0
        mean = self._sum.total / self.count
        variance = (self._squares.total - self.count * mean**2) / (self.count - 1)
        # What rounding leaves of the variance of equal values is none.
        return math.sqrt(variance / self.count) if variance > 1e-12 * mean**2 else 0.0


_MOST_INTERVALS = 200


@dataclass(frozen=True)
class Curve:
    """A safety rate over time, with its pointwise interval.

    Attributes:
        time: instants in s, at most 201.
        safe: number of episodes without a violation up to each.
        rate: their share.
        ci_low: lower end of its interval.
        ci_high: upper end.
    """

    time: list[float]
    safe: list[int]
    rate: list[float]
    ci_low: list[float]
    ci_high: list[float]


class CurveCounts:
    """Counts episodes that are safe so far, at instants spread over the horizon.

    Args:
        steps: number of control periods of the horizon.
    """

    def __init__(self, steps: int) -> None:
        self._instants = curve_instants(steps)
        self._lost = np.zeros(len(self._instants), dtype=np.int64)
        self._episodes = 0

    def add(self, first_violation: np.ndarray) -> None:
        """Count episodes by the control instant of their first violation, shape (E,).

        It is -1 where there is none.
        """
        reached = np.searchsorted(self._instants, first_violation[first_violation >= 0])
        self._lost += np.bincount(reached, minlength=len(self._instants))
        self._episodes += len(first_violation)

    def curve(self, dt: float, confidence: float) -> Curve:
        """Return the rate of the episodes that are safe so far.

        Args:
            dt: control period in s.
            confidence: of the intervals.
        """
        safe = self._episodes - np.cumsum(self._lost)
        low, high = rate_band(safe, self._episodes, confidence)
        columns = (self._instants * dt, safe, safe / self._episodes, low, high)
        return Curve(*(values.tolist() for values in columns))


def curve_instants(steps: int) -> np.ndarray:
    """Return the control instants of a curve, evenly spaced with both ends: at most 201."""
    return np.append(np.arange(0, steps, -(-steps // _MOST_INTERVALS)), steps)


_EPSILONS = 64 * np.finfo(float).eps
"""What rounding may add up to over an episode, in parts of the terms of h."""


_NEARLY = 1e-6
"""In parts of the largest h: `touches`, which compiles formulas, looks at no violation beyond."""

_SLIGHT = 1e-9
"""What rounding and integration may add up to where a filter rides h = 0, in parts of the largest
h."""


class SlightViolations(NamedTuple):
    """Violations that are no more than rounding.

    Attributes:
        touching: how many only touch h = 0.
        below: how many, these included, go no lower than a billionth of the episode's largest h.
        worst: how low the lowest of them goes.
    """

    touching: int
    below: int
    worst: float

    def joined(self, other: SlightViolations) -> SlightViolations:
        """Return those of both."""
        worst = max(self.worst, other.worst)
        return SlightViolations(self.touching + other.touching, self.below + other.below, worst)


def slight_violations(
    problem: SafetyProblem,
    violating: np.ndarray,
    lowest: np.ndarray,
    largest: np.ndarray,
    x: np.ndarray,
) -> SlightViolations:
    """Return which violations are no more than rounding.

    Args:
        problem: whose barriers they are of.
        violating: which episodes violate, shape (B,).
        lowest: minimum h of each, shape (B,).
        largest: maximum h of each, shape (B,).
        x: the states where the minima were, shape (B, n).

    Returns:
        Their numbers, and the worst of them.
    """
    part = violating & (lowest >= -_NEARLY * largest)
    touching = int(touches(problem, lowest[part], x[part]).sum()) if part.any() else 0
    slight = lowest[violating & (lowest >= -_SLIGHT * largest)]
    return SlightViolations(touching, len(slight), float(-slight.min(initial=0.0)))


def touches(problem: SafetyProblem, lowest: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return which of the minima h <= 0 are 0 to floating-point precision, shape (B,).

    That is so where |h| is at most 64 units of rounding of its terms and of what rounded states
    make of it.

    Args:
        problem: whose barriers they are of.
        lowest: smallest h of each episode, shape (B,).
        x: the states where they were, shape (B, n).
    """
    plant = problem.plant
    compiled, ends = _parts(
        plant.states, tuple(plant.numeric(b.expression) for b in problem.barriers)
    )
    with np.errstate(all="ignore"):
        parts = abs(stacked(compiled(*np.ascontiguousarray(x.T)), len(x)))
    sizes = np.max([parts[:, first:end].sum(axis=1) for first, end in pairwise(ends)], axis=0)
    return (lowest <= 0.0) & (lowest >= -_EPSILONS * sizes)


@lru_cache(maxsize=64)
def _parts(states: tuple[sp.Symbol, ...], barriers: tuple[sp.Expr, ...]) -> tuple[Any, list[int]]:
    """Compile the terms of each barrier, and each state times its slope."""
    parts = [
        [*sp.Add.make_args(h), *(s * slope for s in states if not _jumps(slope := sp.diff(h, s)))]
        for h in barriers
    ]
    ends = np.cumsum([0, *map(len, parts)]).tolist()
    return compile_function(states, [part for each in parts for part in each], "arrays"), ends


def _jumps(slope: Any) -> bool:
    return slope.has(sp.DiracDelta, sp.Derivative, sp.Subs)


_MOST_DIGITS = 9


def percent(rate: float | None) -> str:
    """Return a rate in per cent as text; "-" for None."""
    return "-" if rate is None else f"{_percents(rate)[0]} %"


def percent_in(rate: float, low: float, high: float) -> str:
    """Return a rate with its interval, in per cent, as text.

    Args:
        rate: from 0 to 1.
        low: lower end of its interval.
        high: upper end.
    """
    rate_text, low_text, high_text = _percents(rate, low, high)
    return f"{rate_text} % [{low_text}, {high_text}]"


def points_in(difference: float, low: float, high: float, unit: str = " points") -> str:
    """Return a difference of rates with its interval, in points, as text.

    It has one digit, or as many as tell it from 0 where its interval does.

    Args:
        difference: of two rates from 0 to 1.
        low: lower end of its interval.
        high: upper end.
        unit: after the difference.
    """
    telling = (difference, low, high) if low * high > 0.0 else (max(abs(low), abs(high)),)
    # What rounding has left of 0 is the same.
    nonzero = [100 * each for each in telling if abs(each) > 1e-12]
    digits = next(
        (d for d in range(1, _MOST_DIGITS) if all(round(each, d) for each in nonzero)), _MOST_DIGITS
    )
    # What rounds to 0 has no minus sign.
    first, lower, upper = (round(100 * each, digits) + 0.0 for each in (difference, low, high))
    return f"{first:+.{digits}f}{unit} [{lower:.{digits}f}, {upper:.{digits}f}]"


def rate_of(row: Mapping[str, Any]) -> str:
    """Return the safety rate of a row with its interval, in per cent."""
    return percent_in(row["safety_rate"], row["ci_low"], row["ci_high"])


def _percents(*rates: float) -> list[str]:
    """Return percentages with one digit, or as many as tell each from 0 and from 1."""
    # What rounding has left of 0 and 1 is the same.
    open_ended = [rate for rate in rates if 1e-12 < rate < 1.0 - 1e-12]
    digits = next(
        (
            d
            for d in range(1, _MOST_DIGITS)
            if all(0.0 < round(100 * rate, d) < 100.0 for rate in open_ended)
        ),
        _MOST_DIGITS,
    )
    return [f"{100 * rate:.{digits}f}" for rate in rates]


def combined_rates(
    flags: Sequence[SafeFlags], weights: Sequence[float], confidence: float
) -> tuple[float, float, float]:
    """Return w_1 p_1 + w_2 p_2 + ... of rates of the same trials, with its interval.

    The distances of the rates from the ends of their own intervals are added as vectors, whose
    angles are those of the outcomes' phi correlations, as in
    `safe_envs.agents.evaluation.statistics.paired_difference_interval`, which this is for 1 and -1.

    Args:
        flags: which of the trials succeeded, for each rate.
        weights: of the rates.
        confidence: of the two-sided interval.

    Returns:
        The sum, and the ends of its interval.

    Source: G. Y. Zou, A. Donner, Construction of confidence limits about effect measures: a general
        approach, Statistics in Medicine 27 (2008) 1693-1702.
    """
    trials, w = len(flags[0]), np.asarray(weights)
    packed = [each.packed for each in flags]
    # In bits, since there may be many millions of trials.
    both = np.array([[int(np.bitwise_count(a & b).sum()) for a in packed] for b in packed])
    counts = both.diagonal()
    ends = np.array([rate_interval(int(count), trials, confidence) for count in counts])
    rates = counts / trials
    together = trials * both - np.outer(counts, counts)
    scales = np.sqrt(np.outer(together.diagonal(), together.diagonal()))
    # Few trials that agree do not show that all do.
    apart = np.where(together > 0, np.maximum(together - trials / 2, 0.0), together)
    phi = np.divide(apart, scales, out=np.zeros(scales.shape), where=scales > 0.0)
    np.fill_diagonal(phi, 1.0)
    value = float(w @ rates)
    rises, falls = w * (ends[:, 1] - rates), w * (rates - ends[:, 0])
    below = np.where(w > 0.0, falls, rises)
    above = np.where(w > 0.0, rises, falls)
    low, high = (math.sqrt(max(float(side @ phi @ side), 0.0)) for side in (below, above))
    return value, value - low, value + high
