"""Probabilities of rare violations, by importance sampling: noise that drifts towards smaller h, and weights that undo it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from agents.bridge import Bridge
from agents.episodes import Env
from agents.policy import Policy
from safe_envs.calculus import gradient
from safe_envs.codegen import compile_function, stacked
from safe_envs.problem import SafetyProblem
from safe_envs.simulation import NoiseStreams
from safe_envs.vector import SafeVectorEnv
from wrappers.vector_wrapper import readable

STRENGTHS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 11.0, 16.0, 23.0, 32.0)
"""Drifts that are tried, in standard deviations of the noise over an episode."""

_PILOTS = 200
_FEWEST_HITS = 20


class DriftingEnv(SafeVectorEnv):
    """`SafeVectorEnv` with dW + theta dt in place of dW, where theta has a given length and points to where h falls fastest.

    Of several barriers the smallest counts. The drift of a control period is that of its beginning, -c sigma' grad h/|sigma' grad h|.

    Args:
        problem: what to simulate.
        lengths: c of each env, in 1/sqrt(s), shape (num_envs,).

    Attributes:
        log_ratio: for the last period, the logarithm of the density of its noise over the density with the drift, shape (num_envs,).
    """

    def __init__(self, problem: SafetyProblem, lengths: np.ndarray) -> None:
        super().__init__(problem, len(lengths))
        plant = problem.plant
        diffusion = plant.numeric(plant.diffusion)
        live = [j for j in range(diffusion.cols) if any(entry != 0 for entry in diffusion[:, j])]
        rows = [plant.numeric(gradient(plant, barrier.expression)) * diffusion for barrier in problem.barriers]
        self._slopes = compile_function(plant.states, [row[0, j] for row in rows for j in live], "arrays")
        self._barriers = compile_function(plant.states, [plant.numeric(barrier.expression) for barrier in problem.barriers], "arrays")
        self._shape = (len(rows), len(live), len(lengths))
        self._lengths = lengths * math.sqrt(problem.dt / problem.substeps)
        self.log_ratio = np.zeros(len(lengths))
        self._noise = _DriftingStreams(self, self._simulation.integrator.channels)

    def drift(self) -> np.ndarray:
        """What is added to the draws of the coming period, shape (channels, num_envs)."""
        slopes = stacked(self._slopes(*self.components), self.num_envs).T.reshape(self._shape)
        barriers = stacked(self._barriers(*self.components), self.num_envs)
        nearest = slopes[barriers.argmin(axis=1), :, np.arange(self.num_envs)].T
        steepness = np.sqrt((nearest * nearest).sum(axis=0))
        added = np.where(steepness > 0.0, -self._lengths * nearest / np.where(steepness > 0.0, steepness, 1.0), 0.0)
        return np.tile(added, (self.problem.substeps, 1))


class _DriftingStreams(NoiseStreams):
    """The draws of an env with its drift."""

    def __init__(self, env: DriftingEnv, channels: int) -> None:
        super().__init__(env.num_envs, channels)
        self._env = env

    def next(self, rngs: Sequence[np.random.Generator], stepping: np.ndarray | None) -> np.ndarray:
        """See `NoiseStreams.next`; notes the density ratio."""
        # A state that overflows is found by the env, which says so better than a warning.
        with np.errstate(all="ignore"):
            draws, added = super().next(rngs, stepping), self._env.drift()
            self._env.log_ratio = -(draws * added).sum(axis=0) - 0.5 * (added * added).sum(axis=0)
            return draws + added


MakeDrifting = Callable[[np.ndarray], Env]
"""A filtered `DriftingEnv` with drifts of given lengths."""


@dataclass(frozen=True)
class Drifting:
    """How to estimate the probability that h comes down to 0, from episodes that are pushed there.

    Attributes:
        make: the env.
        policy: anything with Stable-Baselines3's `predict`, without memory.
        seed: of all randomness.
        num_envs: the most episodes side by side.
        bridge: looks at h between control instants too. Between given ends a bridge does not depend on a drift.

    Source: S. Asmussen and P. Glynn, Stochastic Simulation, Springer 2007, Ch. V and VI.
    """

    make: MakeDrifting
    policy: Any
    seed: int
    num_envs: int
    bridge: Bridge | None = None

    def choose(self, horizon: float) -> tuple[float | None, int]:
        """Find the length of the drift with the smallest relative deviation, in a few episodes with each.

        Args:
            horizon: of an episode, in s.

        Returns:
            The length in 1/sqrt(s), None if no drift leads to violations, and the control periods that were simulated.
        """
        lengths = np.array(STRENGTHS) / math.sqrt(horizon)
        weights, steps = self._weights(np.repeat(lengths, _PILOTS), (0, 3))
        deviations = [_deviation(part) for part in np.split(weights, len(lengths))]
        best = int(np.argmin(deviations))
        return (float(lengths[best]) if math.isfinite(deviations[best]) else None), steps

    def estimate(self, length: float, episodes: int, repetitions: int) -> tuple[np.ndarray, int]:
        """Estimate the probability.

        Args:
            length: of the drift, in 1/sqrt(s).
            episodes: of a repetition.
            repetitions: R.

        Returns:
            Unbiased estimates, shape (R,), and the control periods that were simulated.
        """
        lengths = np.full(episodes * repetitions, length)
        batches = range(0, len(lengths), self.num_envs)
        parts = [self._weights(lengths[first : first + self.num_envs], (1, 3, first)) for first in batches]
        weights = np.concatenate([weights for weights, _ in parts])
        return weights.reshape(repetitions, episodes).mean(axis=1), sum(steps for _, steps in parts)

    def _weights(self, lengths: np.ndarray, spawn_key: tuple[int, ...]) -> tuple[np.ndarray, int]:
        """Density ratio of each episode's noise up to its violation, 0 without one; and the control periods."""
        seed = np.random.SeedSequence(self.seed, spawn_key=spawn_key)
        env = self.make(lengths)
        world: Any = readable(env)
        generator = np.random.default_rng(seed.spawn(1)[0])
        observation, info = env.reset(seed=seed.generate_state(len(lengths), np.uint64).tolist())
        if isinstance(self.policy, Policy):
            self.policy.begin(range(len(lengths)), int(generator.integers(2**63)))
        hit = info["barrier"].min(axis=1) <= 0.0
        alive, total, steps = ~hit, np.zeros(len(lengths)), 0
        with threadpool_limits(1, "blas"):
            while alive.any():
                x, before = world.components, info["barrier"]
                actions, _ = self.policy.predict(observation, None, np.zeros(len(lengths), dtype=bool), deterministic=True)
                observation, _, terminated, truncated, info = env.step(actions)
                total += np.where(alive, world.log_ratio, 0.0)
                steps += int(np.count_nonzero(alive))
                after = info["barrier"]
                lowest = after.min(axis=1)
                if self.bridge is not None:
                    lowest = self.bridge.lowest(x, before, after, generator.standard_exponential(after.shape))
                hit |= alive & (lowest <= 0.0)
                alive &= ~hit & ~(terminated | truncated)
        return np.where(hit, np.exp(total), 0.0), steps


def _deviation(weights: np.ndarray) -> float:
    """Relative deviation; infinite with so few violations that it means nothing."""
    return float(np.std(weights) / np.mean(weights)) if np.count_nonzero(weights) >= _FEWEST_HITS else math.inf
