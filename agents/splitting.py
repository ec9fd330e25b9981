"""Probabilities of rare violations, by adaptive multilevel splitting on h."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.bridge import Bridge
from agents.particles import MakeEnv, Particles

KILLED = 0.5
"""Share of a repetition's paths that are killed at a level, at least."""

LEAST = 1e-20
"""Below this splitting is given up: a level may be one that is never reached."""


@dataclass(frozen=True)
class Repetitions:
    """Independent estimates of one probability.

    Attributes:
        estimates: unbiased, shape (R,); those that were given up are 0.
        levels: that each took, shape (R,).
        steps: control periods that were simulated in all.
        first: violations among the paths of the beginning, which are plain episodes.
        paths: how many these are.
        given_up: why each of some was given up, with the level of h.
    """

    estimates: np.ndarray
    levels: np.ndarray
    steps: int
    first: int
    paths: int
    given_up: dict[int, tuple[str, float]]


def split(
    make: MakeEnv,
    policy: Any,
    *,
    particles: int,
    repetitions: int,
    seed: int,
    num_envs: int,
    bridge: Bridge | None = None,
    killed: float = KILLED,
    progress: Callable[[float], None] | None = None,
    power=0.0,
) -> Repetitions:
    """Estimate the probability that h comes down to 0, several times, side by side.

    Each repetition begins with `particles` episodes. A level is the h that a given share of them did not fall below; those are
    killed, all of them where several stand at one level, and replaced: by copies of survivors, chosen at random, up to the first
    instant at which they fell below the level, and from there with noise of their own. With K_i of N killed at level i, the
    probability is the product of the 1 - K_i/N, times the share that violates in the end. That is unbiased, for any share.

    Args:
        make: an env with so many episodes side by side.
        policy: anything with Stable-Baselines3's `predict`, without memory.
        particles: N.
        repetitions: R.
        seed: of all randomness.
        num_envs: the most episodes side by side.
        bridge: looks at h between control instants too.
        killed: share at a level, at least.
        progress: told the part of the way from the first level to 0.

    Raises:
        ConfigurationError: the policy has a memory.

    Source: C.-E. Brehier, M. Gazeau, L. Goudenege, T. Lelievre, M. Rousset, Unbiasedness of some generalized adaptive multilevel
        splitting algorithms, Annals of Applied Probability 26 (2016) 3559-3601.
    """
    paths = Particles(make, policy, particles * repetitions, seed, num_envs, bridge, power)
    paths.begin()
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1, 2)))
    first = int(np.count_nonzero(paths.lowest <= 0.0))
    estimates, levels = np.ones(repetitions), np.zeros(repetitions, dtype=np.int64)
    active, given_up = list(range(repetitions)), {}
    rank = max(1, round(killed * particles))
    highest: float | None = None
    while active:
        killing: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        under_way = []
        for r in active:
            lowest = paths.lowest[r * particles : (r + 1) * particles]
            level = float(np.partition(lowest, particles - rank)[particles - rank])
            if level <= 0.0:
                estimates[r] *= np.count_nonzero(lowest <= 0.0) / particles
                continue
            dead, survivors = np.flatnonzero(lowest >= level), np.flatnonzero(lowest < level)
            estimates[r] *= survivors.size / particles
            if not survivors.size or estimates[r] < LEAST:
                given_up[r] = ("one level" if not survivors.size else "too rare", level)
                estimates[r] = 0.0
                continue
            levels[r] += 1
            under_way.append(r)
            parents = generator.choice(survivors, dead.size)
            killing.append((r * particles + dead, r * particles + parents, np.full(dead.size, level)))
        active = under_way
        if killing:
            replaced, parents, at = (np.concatenate(parts) for parts in zip(*killing, strict=True))
            if progress:
                highest = highest or float(at.max())
                progress(1.0 - float(at.mean()) / highest)
            paths.branch(replaced, parents, at)
    return Repetitions(estimates, levels, paths.steps, first, particles * repetitions, given_up)
