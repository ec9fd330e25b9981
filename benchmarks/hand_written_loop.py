"""A batch of stochastic Dubins vehicles behind their SCBF, written by hand as a kernel.

It is the limit for compiled vector envs: physics, filter, noise, starts, observations, rewards,
counters and restarts, without info, checks, and what Gymnasium asks for. Its numbers are those of
`StochasticDubins-v0`.
"""

from __future__ import annotations

from math import cos, inf, pi, sin, sqrt

import numpy as np

from safe_envs.dynamics.noise import NOISE, START
from safe_envs.dynamics.normal_kernel import standard_normal
from safe_envs.engine.plain_natives import philox_block, uniform_of

SPEED = 2.0
SIGMA = 0.2
RADIUS = 3.0
PERIOD = 0.05
LIMIT = 100
LARGEST_INPUT = 10.0
WORKSPACE = 6.0


def uniform_by_hand(word: int, key: int, episode: int) -> float:
    """Return a uniform of the stream of starts.

    Args:
        word: its place.
        key: of the env.
        episode: number of the episode.
    """
    return uniform_of(philox_block(word // 4 + 1, episode, START, 0, key, 0)[word % 4])


def start_by_hand(key: int, episode: int) -> tuple[float, float, float]:
    """Return a start in the disk from which the barrier rises.

    Args:
        key: of the env.
        episode: number of the episode.
    """
    word = 0
    while True:
        rho = RADIUS * sqrt(uniform_by_hand(word, key, episode))
        phi = 2.0 * pi * uniform_by_hand(word + 1, key, episode)
        theta = 2.0 * pi * uniform_by_hand(word + 2, key, episode)
        word += 3
        if -SIGMA * SIGMA - SPEED * rho * cos(theta - phi) > 0.0:
            return rho * cos(phi), rho * sin(phi), theta


def step_by_hand(  # noqa: PLR0913  (the arrays of a kernel)
    actions: np.ndarray,
    keys: np.ndarray,
    episodes: np.ndarray,
    steps: np.ndarray,
    states: np.ndarray,
    spare: np.ndarray,
    counters: np.ndarray,
    observations: np.ndarray,
    rewards: np.ndarray,
    ended: np.ndarray,
) -> None:
    """Step all vehicles, or begin an episode where one has ended.

    Args:
        actions: in [-1, 1], float32 (num_envs, 1).
        keys: of the envs.
        episodes: their numbers.
        steps: of each episode.
        states: of the vehicles.
        spare: noise of the following step.
        counters: smallest barrier, cost, interventions and infeasible steps of each episode.
        observations: receives the observations.
        rewards: receives the rewards.
        ended: which episodes have ended.
    """
    root = SIGMA * sqrt(PERIOD)
    for i in range(len(steps)):
        k = steps[i]
        if ended[i]:
            episodes[i] += 1
            x, y, theta = start_by_hand(keys[i], episodes[i])
            k = 0
            counters[i, 0] = inf
            for j in range(1, 4):
                counters[i, j] = 0.0
        else:
            x, y, theta = states[i, 0], states[i, 1], states[i, 2]
            if k % 2 == 0:
                w = philox_block(k // 2 + 1, episodes[i], NOISE, 0, keys[i], 0)
                first, second = standard_normal(uniform_of(w[0])), standard_normal(uniform_of(w[1]))
                spare[i, 0] = standard_normal(uniform_of(w[2]))
                spare[i, 1] = standard_normal(uniform_of(w[3]))
            else:
                first, second = spare[i, 0], spare[i, 1]
            c, s = cos(theta), sin(theta)
            nominal = LARGEST_INPUT * min(max(actions[i, 0], -1.0), 1.0)
            # A A h = a u + b: thesis Eq. (4.25).
            a, b = 2.0 * SPEED * (x * s - y * c), -2.0 * SPEED * SPEED
            u = nominal
            if a * u + b < 0.0:
                u = min(max(-b / a, -LARGEST_INPUT), LARGEST_INPUT)
                counters[i, 2] += u != nominal
                counters[i, 3] += abs(a) * LARGEST_INPUT + b < 0.0
            x += SPEED * c * PERIOD + root * first
            y += SPEED * s * PERIOD + root * second
            theta += u * PERIOD
            k += 1
        states[i, 0], states[i, 1], states[i, 2], steps[i] = x, y, theta, k
        h = RADIUS * RADIUS - x * x - y * y
        counters[i, 0] = min(counters[i, 0], h)
        counters[i, 1] += h < 0.0
        c, s, off = cos(theta), sin(theta), x - 1.5
        observations[i, 0], observations[i, 1] = x, y
        observations[i, 2], observations[i, 3] = c, s
        wide = 32.0 / 81.0 * (y * y + off * off) - 2.0
        rewards[i] = (1.0 + 4.0 / 9.0 * (off * s - y * c)) / (2.0 * (wide * wide + 1.0))
        ended[i] = k >= LIMIT or max(abs(x), abs(y)) > WORKSPACE
