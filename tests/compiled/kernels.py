"""Kernels for the tests of programs."""

from __future__ import annotations

from math import sqrt

import numpy as np

from safe_envs.compiled.plain_natives import philox_block, single, uniform_of
from safe_envs.compiled.slots import reward_of

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
    """Write uniforms of Philox blocks, and some numbers in single precision."""
    for i in range(len(out)):
        out[i] = uniform_of(philox_block(i, 2, 3, -1, key, 7)[i % 4])
    for i in range(len(singles)):
        singles[i] = single(singles[i])
