"""Flags of episodes, one bit each."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.agents.evaluation.statistics import SafeFlags


@pytest.mark.parametrize("portion", [1, 7, 8, 9, 64, 1000])
def test_flags_are_those_that_were_added_in_any_portions(portion):
    safe = np.random.default_rng(0).random(203) < 0.6
    flags = SafeFlags()
    for k in range(0, len(safe), portion):
        flags.add(safe[k : k + portion])
        flags.add(safe[:0])
    assert len(flags) == 203
    assert flags.array.dtype == bool
    np.testing.assert_array_equal(flags.array, safe)
    np.testing.assert_array_equal(flags.packed, np.packbits(safe))


def test_flags_are_a_bit_each():
    flags = SafeFlags.of(np.ones(8000, dtype=bool))
    assert flags.packed.nbytes == 1000
    assert len(SafeFlags()) == len(SafeFlags().array) == 0
