"""Results of episodes that nothing simulated, and of tables that nothing computed."""

from __future__ import annotations

import numpy as np

from safe_envs.agents.evaluation.attainable import AttainableSafety
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


def attainable(lower, upper):
    """Return what a table of no problem in particular says."""
    nothing = {"simulated": None, "contradiction": "", "knowledge": "plant", "leaving": "safe"}
    sizes = {"coordinates": (), "cells": (), "inputs": 1, "steps": 1, "seconds": 0.0, "memory": 0}
    return AttainableSafety(lower=lower, upper=upper, specification="", **nothing, **sizes)
