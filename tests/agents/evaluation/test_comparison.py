"""Comparison of filters pair by pair."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.agents.evaluation.statistics import SafeFlags, compare_all, pair_counts


def test_pairs_are_counted():
    rng = np.random.default_rng(0)
    a, b = rng.random(2003) < 0.7, rng.random(2003) < 0.3
    table = pair_counts(SafeFlags.of(a), SafeFlags.of(b))
    assert table == ((a & b).sum(), (a & ~b).sum(), (~a & b).sum(), (~a & ~b).sum())
    assert all(type(count) is int for count in table)
    with pytest.raises(ValueError, match="2003 and 2002 episodes are not the same"):
        pair_counts(SafeFlags.of(a), SafeFlags.of(b[1:]))


def test_each_filter_is_compared_with_those_before_it():
    values = {"a": [1, 1, 0, 0, 1], "b": [1, 0, 0, 1, 1], "c": [1, 1, 1, 1, 1]}
    flags = {name: [SafeFlags.of(np.array(v, dtype=bool))] for name, v in values.items()}
    found = [
        (c.first, c.second, c.only_first, c.only_second, c.difference)
        for c in compare_all(flags, 0.95)
    ]
    assert found == [("b", "a", 1, 1, 0.0), ("c", "a", 2, 0, 0.4), ("c", "b", 2, 0, 0.4)]
    assert compare_all({"a": flags["a"]}, 0.95) == []
