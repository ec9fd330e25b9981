"""Kernels for the tests of programs."""

from __future__ import annotations

from math import sqrt

import numpy as np

from safe_envs.engine.plain_natives import philox_block, single, table_view, uniform_of, vector_view
from safe_envs.engine.slots import reward_of

FACTOR = 2.0


def total_reward(values: np.ndarray) -> float:
    """Return a sum over what a generated function makes of each number."""
    total = 0.0
    for i in range(len(values)):
        total += scaled((values[i],))
    return total


def scaled(values: tuple[float, ...]) -> float:
    return FACTOR * reward_of(values)


def read(values: np.ndarray) -> float:
    return reward_of(values)  # pyright: ignore[reportArgumentType]


def root(value: float) -> float:
    return sqrt(value)


def words_of(out: np.ndarray, singles: np.ndarray, key: int) -> None:
    """Write uniforms of Philox blocks, one of them twice, and some numbers in single precision."""
    for i in range(len(out)):
        out[i] = uniform_of(philox_block(i, 2, 3, -1, key, 7)[i % 4])
    part, table = vector_view(out, 1, 3), table_view(out, 8, 2, 3)
    part[2] = table[1, 2]
    for i in range(len(singles)):
        singles[i] = single(singles[i])
