"""Two filters on the same episodes, pair by pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.statistics import (
    mcnemar_p,
    paired_difference_interval,
    repeated_interval,
)

Comparison = dict[str, Any]
Table = tuple[int, int, int, int]


class SafetyBits:
    """A bit for each episode, in the order and the portions in which they come."""

    def __init__(self) -> None:
        self._bits = bytearray()
        self._count = 0

    def add(self, values: np.ndarray) -> None:
        """Keep the flags, shape (B,)."""
        self._bits += np.packbits(values).tobytes()
        self._count += len(values)

    def table(self, other: SafetyBits) -> Table:
        """Count episodes with the flag of both, of this only, of the other only, of neither.

        Args:
            other: of the same episodes, added in the same portions.
        """
        mine, others = np.frombuffer(self._bits, np.uint8), np.frombuffer(other._bits, np.uint8)
        # A portion is filled up with zeros to whole bytes: they are no flag of either.
        both, first, second = (
            int(np.bitwise_count(bits).sum())
            for bits in (mine & others, mine & ~others, others & ~mine)
        )
        return both, first, second, self._count - both - first - second


def compare_all(flags: Mapping[str, Sequence[SafetyBits]], confidence: float) -> list[Comparison]:
    """Compare every two filters by which of the same episodes were safe: each one with those before
    it.

    A p value is of its pair alone: it is not adjusted for the number of pairs.

    Args:
        flags: which episodes were safe, by filter: once, or with each of several identifications.
        confidence: of the interval of the difference of their rates.
    """
    return [
        _compare(second, first, _tables(flags[second], flags[first]), confidence)
        for first, second in combinations(flags, 2)
    ]


def _tables(first: Sequence[SafetyBits], second: Sequence[SafetyBits]) -> list[Table]:
    """Counts with each identification; what has only one goes with all of the other's."""
    count = max(len(first), len(second))
    return [first[r % len(first)].table(second[r % len(second)]) for r in range(count)]


def _compare(first: str, second: str, tables: Sequence[Table], confidence: float) -> Comparison:
    both, only_first, only_second, neither = (sum(counts) for counts in zip(*tables, strict=True))
    repeats = len(tables)
    low, high = paired_difference_interval(
        both / repeats, only_first / repeats, only_second / repeats, neither / repeats, confidence
    )
    if repeats > 1:
        differences = [(table[1] - table[2]) / sum(table) for table in tables]
        low, high = repeated_interval(differences, (low, high), confidence, (-1.0, 1.0))
    return {
        "first": first,
        "second": second,
        "both": both,
        "only_first": only_first,
        "only_second": only_second,
        "neither": neither,
        "difference": (only_first - only_second) / (both + only_first + only_second + neither),
        "ci_low": low,
        "ci_high": high,
        # Repeats on the same episodes are no independent pairs.
        "mcnemar_p": mcnemar_p(only_first, only_second) if repeats == 1 else None,
    }
