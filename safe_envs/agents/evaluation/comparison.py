"""Two filters on the same episodes, pair by pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from safe_envs.agents.evaluation.safe_flags import SafeFlags
from safe_envs.agents.evaluation.statistics import (
    mcnemar_p,
    paired_difference_interval,
    repeated_interval,
)

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
