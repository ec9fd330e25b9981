from __future__ import annotations

from benchmarks.vec_envs import speeds


def test_speeds_are_of_both():
    measured = speeds("StochasticDubins-v0", num_envs=2, filter="scbf", steps=3, rounds=1)
    assert set(measured) == {"SB3VecEnv", "DummyVecEnv"}
    assert min(measured.values()) > 0.0
