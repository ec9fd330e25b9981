"""Paths of bare problems, for all tests of rare events."""

from __future__ import annotations

from safe_envs.agents.rare_events.numpy_paths import NumpyPaths, TiltedNoiseEnv


def paths_of(problem, policy, num_envs=4096, continuous=False):
    """Return who simulates the paths of an unfiltered env by NumPy."""
    return NumpyPaths(
        problem, lambda lengths: TiltedNoiseEnv(problem, lengths), policy, num_envs, continuous
    )
