"""Many standard normals at a time, as a kernel: in loops that compiled code vectorises."""

from __future__ import annotations

from math import log, sqrt

import numpy as np

from safe_envs.compiled.draws import fill_uniforms
from safe_envs.compiled.plain_natives import vector_view
from safe_envs.dynamics.normal_kernel import (
    CENTRAL,
    HALF_STEP,
    NEAR_END,
    near_tail,
    normal_center,
    normal_tail,
)


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
