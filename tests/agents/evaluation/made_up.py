"""Results of episodes that nothing simulated."""

from __future__ import annotations

import numpy as np

from safe_envs.agents.evaluation.rows import EpisodeResults

STEPS = 100
"""Control periods of the longest episode."""


def made_up(count, seed=0):
    """Return results of episodes of which a few violate, some of these at their start.

    Args:
        count: number of episodes.
        seed: of what they are.
    """
    rng = np.random.default_rng(seed)
    length = rng.integers(1, STEPS + 1, count).astype(np.int32)
    first = np.where(rng.random(count) < 0.2, rng.integers(0, length), -1).astype(np.int32)
    counted = np.where(first < 0, length, first)
    effort = np.where(counted > 0, rng.random(count) * 10.0 ** rng.integers(-9, 9, count), np.nan)
    return EpisodeResults(
        returns=rng.standard_normal(count) * 10.0 ** rng.integers(-9, 9, count),
        min_h=rng.standard_normal(count),
        first_violation=first,
        length=length,
        interventions=rng.integers(0, counted + 1).astype(np.int32),
        infeasible=rng.integers(0, counted + 1).astype(np.int32),
        effort=effort,
    )
