"""The randomness of learning, and what may be given for a whole number."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.filters.learning.checks import Purpose, random_stream, require_room

_SEED = 7


def first_draws(rng):
    return tuple(rng.integers(2**63, size=4).tolist())


def test_no_two_uses_of_a_seed_share_their_randomness():
    """Among them those that NumPy makes the same: a seed, the same with a 0 behind it, and the
    children of either."""
    found = {"plain": np.random.default_rng(_SEED)}
    found |= {
        f"child {i}": np.random.default_rng(child)
        for i, child in enumerate(np.random.SeedSequence(_SEED).spawn(3))
    }
    found |= {f"small {i}": np.random.default_rng([_SEED, i]) for i in range(1, 10)}
    for purpose in Purpose:
        found[purpose.name] = random_stream(_SEED, purpose)
        found |= {
            f"{purpose.name} {i}": child
            for i, child in enumerate(random_stream(_SEED, purpose).spawn(2))
        }
    draws = {name: first_draws(rng) for name, rng in found.items()}
    for one, other in itertools.combinations(draws, 2):
        assert draws[one] != draws[other], (one, other)
    assert first_draws(random_stream(np.int64(_SEED), Purpose.DATA)) == draws["DATA"]


def test_whole_numbers_of_numpy_are_whole_numbers():
    for value in (5, np.int64(5), np.uint8(5)):
        require_whole("points", value, 1)
    for value in (True, np.True_, 5.0, np.float64(5.0), np.int64(0), "5", None):
        with pytest.raises(ConfigurationError, match="points = "):
            require_whole("points", value, 1)


def test_what_does_not_fit_into_memory_is_refused():
    require_room(1e8, "data", "points")
    with pytest.raises(
        ConfigurationError, match=r"data take 8 GB; at most 2 GB are allowed: lower points"
    ):
        require_room(1e9, "data", "points")
