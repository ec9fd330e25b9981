"""Random numbers of episodes, as kernels: see `safe_envs.dynamics.philox` for the streams."""

from __future__ import annotations

import numpy as np

from safe_envs.compiled.plain_natives import philox_block, uniform_of
from safe_envs.compiled.slots import State, no_state, start_margin, start_state
from safe_envs.dynamics.normal_kernel import standard_normal
from safe_envs.dynamics.philox import EPISODE, START

MOST_TRIES = 10_000
"""Starts that are drawn until one meets the condition of its distribution."""


def fill_uniforms(
    out: np.ndarray, first: int, episode: int, purpose: int, k0: int, k1: int
) -> None:
    """Write consecutive uniforms of a stream.

    Args:
        out: receives them.
        first: word of the stream to begin with, a multiple of 4.
        episode: number of the episode since the env was seeded.
        purpose: of the stream.
        k0: first word of the key.
        k1: second word.
    """
    count = len(out)
    for i in range(0, count, 4):
        w0, w1, w2, w3 = philox_block((first + i) // 4 + 1, episode, purpose, 0, k0, k1)
        out[i] = uniform_of(w0)
        if i + 1 < count:
            out[i + 1] = uniform_of(w1)
        if i + 2 < count:
            out[i + 2] = uniform_of(w2)
        if i + 3 < count:
            out[i + 3] = uniform_of(w3)


def fill_normals(out: np.ndarray, first: int, episode: int, purpose: int, k0: int, k1: int) -> None:
    """Write consecutive standard normals of a stream.

    Args:
        out: receives them.
        first: word of the stream to begin with, a multiple of 4.
        episode: number of the episode since the env was seeded.
        purpose: of the stream.
        k0: first word of the key.
        k1: second word.
    """
    fill_uniforms(out, first, episode, purpose, k0, k1)
    for i in range(len(out)):
        out[i] = standard_normal(out[i])


def episode_key(episode: int, k0: int, k1: int) -> int:
    """Return the seed of an episode of an evaluation, which is the first word of its key.

    Args:
        episode: number of the episode.
        k0: first word of the key of the evaluation's seed.
        k1: second word.
    """
    return philox_block(episode + 1, 0, EPISODE, 0, k0, k1)[0]


def uniform_at(place: int, episode: int, purpose: int, k0: int, k1: int) -> float:
    """Return the uniform of one word of a stream.

    Args:
        place: of the word, from 0.
        episode: number of the episode since the env was seeded.
        purpose: of the stream.
        k0: first word of the key.
        k1: second word.
    """
    return uniform_of(philox_block(place // 4 + 1, episode, purpose, 0, k0, k1)[place % 4])


def draw_start(k0: int, k1: int, episode: int, uniforms: np.ndarray, data: np.ndarray) -> State:
    """Return the start state of an episode; NaN where none was allowed in 10,000 tries.

    Args:
        k0: first word of the key of the env.
        k1: second word.
        episode: its number since the env was seeded.
        uniforms: scratch array, with an entry for each uniform of the distribution.
        data: numbers of the program.
    """
    for t in range(MOST_TRIES):
        for j in range(len(uniforms)):
            uniforms[j] = uniform_at(t * len(uniforms) + j, episode, START, k0, k1)
        x = start_state(uniforms, data)
        if start_margin(x, data) > 0.0:
            return x
    return no_state(data)


def store_row(row: np.ndarray, values: tuple[float, ...]) -> None:
    """Write numbers to an array.

    Args:
        row: receives them.
        values: as many numbers.
    """
    for i in range(len(values)):
        row[i] = values[i]
