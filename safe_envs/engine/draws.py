"""Random numbers of episodes, as kernels: see `safe_envs.dynamics.noise` for the streams."""

from __future__ import annotations

from math import log, sqrt

import numpy as np

from safe_envs.dynamics.noise import EPISODE, START
from safe_envs.dynamics.normal_kernel import (
    CENTRAL,
    HALF_STEP,
    NEAR_END,
    near_tail,
    normal_center,
    normal_tail,
    standard_normal,
)
from safe_envs.engine.plain_natives import philox_block, uniform_of, vector_view
from safe_envs.engine.slots import State, no_state, start_margin, start_state

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


def fill_normal_run(
    out: np.ndarray, first: int, episode: int, purpose: int, k0: int, k1: int
) -> None:
    """Write consecutive standard normals of a stream: those of `fill_normals`, to the bit.

    The central function takes all of them, and the tails, gathered before, are put in their places.

    Args:
        out: receives them in its first third; the others are scratch.
        first: word of the stream to begin with, a multiple of 4.
        episode: number of the episode since the env was seeded.
        purpose: of the stream.
        k0: first word of the key.
        k1: second word.
    """
    count = len(out) // 3
    fill_uniforms(vector_view(out, 0, count), first, episode, purpose, k0, k1)
    end = count
    for i in range(count):
        q = (out[i] - 0.5) + HALF_STEP
        out[end] = q
        out[count + end] = i
        end += 1 if abs(q) > CENTRAL else 0
    for i in range(count):
        out[i] = normal_center((out[i] - 0.5) + HALF_STEP)
    for j in range(count, end):
        q = out[j]
        root = sqrt(-log(0.5 - abs(q)))
        if root > NEAR_END:
            out[int(out[count + j])] = normal_tail(q)
        out[j] = 0.0 if root > NEAR_END else root if q > 0.0 else -root
    for j in range(count, end):
        found = near_tail(abs(out[j]))
        out[j] = found if out[j] > 0.0 else -found if out[j] < 0.0 else 0.0
    for j in range(count, end):
        if out[j] != 0.0:
            out[int(out[count + j])] = out[j]
