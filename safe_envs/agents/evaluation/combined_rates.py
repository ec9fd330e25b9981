"""Intervals of sums of rates, each with a weight, of the same trials."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from safe_envs.agents.evaluation.safe_flags import SafeFlags
from safe_envs.agents.evaluation.statistics import rate_interval


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
