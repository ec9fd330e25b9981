"""Comparison of filters pair by pair, whatever the portions in which the episodes come."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.agents.evaluation.comparison import SafetyBits, compare_all


def flags_of(values, portion):
    flags = SafetyBits()
    for k in range(0, len(values), portion):
        flags.add(values[k : k + portion])
    return flags


@pytest.mark.parametrize("portion", [1, 3, 8, 64, 1000, 5000])
def test_pairs_are_counted(portion):
    rng = np.random.default_rng(0)
    a, b = rng.random(2003) < 0.7, rng.random(2003) < 0.3
    table = flags_of(a, portion).table(flags_of(b, portion))
    assert table == ((a & b).sum(), (a & ~b).sum(), (~a & b).sum(), (~a & ~b).sum())
    assert all(type(count) is int for count in table)


def test_flags_take_little_room():
    flags = flags_of(np.ones(200_000, dtype=bool), 1000)
    assert len(flags._bits) == 25_000


def test_each_filter_is_compared_with_those_before_it():
    values = {"a": [1, 1, 0, 0, 1], "b": [1, 0, 0, 1, 1], "c": [1, 1, 1, 1, 1]}
    flags = {name: [flags_of(np.array(v, dtype=bool), 2)] for name, v in values.items()}
    found = [
        (c["first"], c["second"], c["only_first"], c["only_second"], c["difference"])
        for c in compare_all(flags, 0.95)
    ]
    assert found == [("b", "a", 1, 1, 0.0), ("c", "a", 2, 0, 0.4), ("c", "b", 2, 0, 0.4)]
    assert compare_all({"a": flags["a"]}, 0.95) == []
