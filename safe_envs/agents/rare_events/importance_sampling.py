"""Importance sampling of rare violations: noise that drifts towards smaller h, and weights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge, smallest
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.jobs import blas_threads
from safe_envs.agents.policies.base import Policy
from safe_envs.agents.rare_events.particles import MakeTiltedEnv
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.lie import gradient
from safe_envs.envs.noise import NoiseStreams
from safe_envs.envs.simulation import steps_until
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.env_wrappers.safety_filter_vector import readable

_STRONGEST = 64.0
"""The strongest drift that is thought of, in standard deviations of the noise over an episode."""


class TiltedNoiseEnv(SafeVectorEnv):
    """`SafeVectorEnv` with dW - c e dt in place of dW.

    Here e = sigma' grad h/|sigma' grad h| is the direction in which h rises fastest.

    Of several barriers the smallest counts. Where no noise reaches it, e = 0. The e of a control
    period is that of its beginning.

    Args:
        problem: what to simulate.
        lengths: c of each env, in 1/sqrt(s), shape (num_envs,); 0 for the noise as it is.

    Attributes:
        girsanov_integrals: of each episode the integrals of e'dW, where W is what drives the
            system, and of e'e dt; shape (num_envs, 2). They give the density of the noise so far
            over that with a drift: see `log_ratio`.
    """

    def __init__(self, problem: SafetyProblem, lengths: np.ndarray) -> None:
        super().__init__(problem, len(lengths))
        plant = problem.plant
        diffusion = plant.numeric(plant.diffusion)
        live = plant.noise_channels
        rows = [
            plant.numeric(gradient(plant, barrier.expression)) * diffusion
            for barrier in problem.barriers
        ]
        self._slopes = compile_function(
            plant.states, [row[0, j] for row in rows for j in live], "arrays"
        )
        self._barriers = compile_function(
            plant.states,
            [plant.numeric(barrier.expression) for barrier in problem.barriers],
            "arrays",
        )
        self._shape = (len(rows), len(live), len(lengths))
        self._lengths = lengths
        self.girsanov_integrals = np.zeros((len(lengths), 2))
        batch: Any = self._batch
        batch.noise = _TiltedStreams(self, steps_until(problem, None))

    def tilt_direction(self) -> np.ndarray:
        """Return the direction e of the coming period, shape (noise channels, num_envs)."""
        slopes = stacked(self._slopes(*self.components), self.num_envs).T.reshape(self._shape)
        if len(slopes) == 1:
            steepest = slopes[0]
        else:
            barriers = stacked(self._barriers(*self.components), self.num_envs)
            steepest = slopes[barriers.argmin(axis=1), :, np.arange(self.num_envs)].T
        steepness = np.sqrt((steepest * steepest).sum(axis=0))
        return np.where(steepness > 0.0, steepest / np.where(steepness > 0.0, steepness, 1.0), 0.0)

    def tilted(self, draws: np.ndarray) -> np.ndarray:
        """Return the draws of a period with the drift in them, substep by substep.

        Adds to `girsanov_integrals`.
        """
        if not draws.size:
            return draws
        root = math.sqrt(self.problem.dt / self.problem.substeps)
        direction = np.tile(self.tilt_direction(), (self.problem.substeps, 1))
        moved = draws - self._lengths * root * direction
        self.girsanov_integrals[:, 0] += root * (direction * moved).sum(axis=0)
        self.girsanov_integrals[:, 1] += root**2 * (direction * direction).sum(axis=0)
        return moved

    def snapshot(self) -> dict[str, np.ndarray]:
        """See `SafeVectorEnv.snapshot`."""
        return {**super().snapshot(), "girsanov_integrals": self.girsanov_integrals.copy()}

    def restore(
        self, snapshot: Mapping[str, np.ndarray], seed: int | Sequence[int | None] | None = None
    ) -> None:
        """See `SafeVectorEnv.restore`."""
        super().restore(snapshot, seed)
        self.girsanov_integrals = np.array(snapshot["girsanov_integrals"])


class _TiltedStreams(NoiseStreams):
    """The draws of an env with its drift."""

    def __init__(self, env: TiltedNoiseEnv, periods: int) -> None:
        problem = env.problem
        channels = len(problem.plant.noise_channels) * problem.substeps
        super().__init__(env._streams, channels, periods)
        self._env = env

    def begin(self, envs: np.ndarray) -> None:
        """See `NoiseStreams.begin`."""
        super().begin(envs)
        self._env.girsanov_integrals[envs] = 0.0

    def next(self, stepping: np.ndarray | None) -> np.ndarray:
        """See `NoiseStreams.next`."""
        # A state that overflows is found by the env, whose message is better than a warning.
        with np.errstate(all="ignore"):
            return self._env.tilted(super().next(stepping))


def log_ratio(girsanov_integrals: np.ndarray, lengths: Any) -> np.ndarray:
    """Return the log density of episodes' noise as it is over that with a drift.

    By Girsanov it is c int e'dW + c^2/2 int e'e dt.

    Args:
        girsanov_integrals: of the episodes, as in `TiltedNoiseEnv`, shape (..., 2).
        lengths: c of each, or one for all.
    """
    return lengths * girsanov_integrals[..., 0] + 0.5 * lengths**2 * girsanov_integrals[..., 1]


def optimal_tilt(
    girsanov_integrals: np.ndarray, shares: np.ndarray, horizon: float
) -> tuple[float, float]:
    """Return the drift whose weights differ least, judged by episodes that violate.

    It does not matter how these were found.

    With the weight w of an episode the second moment under the drift is E[w; violation] without it.
    So episodes that the drift would hardly ever show, since they violate on another way, count with
    their large weights.

    Args:
        girsanov_integrals: of episodes that violate, as in `TiltedNoiseEnv`, shape (B, 2).
        shares: of the probability for which each stands, shape (B,).
        horizon: of an episode, in s.

    Returns:
        The length c in 1/sqrt(s), and the deviation of the estimate of one episode with it,
        relative to the probability.

    Source: S. Asmussen and P. Glynn, Stochastic Simulation, Springer 2007, Ch. V and VI.
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import logsumexp

    probability = math.fsum(shares)

    def log_second_moment(length: float) -> float:
        found: Any = logsumexp(log_ratio(girsanov_integrals, length), b=shares / probability)
        return float(found) - math.log(probability)

    # A sum of exponentials of convex functions: there is one minimum.
    found: Any = minimize_scalar(
        log_second_moment, bounds=(0.0, _STRONGEST / math.sqrt(horizon)), method="bounded"
    )
    return float(found.x), math.sqrt(max(math.exp(min(found.fun, 700.0)) - 1.0, 0.0))


@dataclass(frozen=True)
class ImportanceSampling:
    """How to estimate the probability that h comes down to 0, from episodes that are pushed there.

    Attributes:
        make: the env.
        policy: anything with Stable-Baselines3's `predict`, without memory.
        seed: of all randomness.
        num_envs: the most episodes side by side.
        bridge: gives the minimum h between control instants too. Between given ends a bridge
            does not depend on a drift.

    Source: S. Asmussen and P. Glynn, Stochastic Simulation, Springer 2007, Ch. V and VI.
    """

    make: MakeTiltedEnv
    policy: Any
    seed: int
    num_envs: int
    bridge: BrownianBridge | None = None

    def estimate(
        self, length: float, episodes: int, repetitions: int, progress: Progress | None = None
    ) -> tuple[np.ndarray, int]:
        """Estimate the probability.

        Args:
            length: of the drift, in 1/sqrt(s).
            episodes: of a repetition.
            repetitions: R.
            progress: called with the part that is done.

        Returns:
            Unbiased estimates, shape (R,), and the control periods that were simulated.
        """
        count = episodes * repetitions
        weights, steps = np.zeros(count), 0
        for first in range(0, count, self.num_envs):
            some = slice(first, min(first + self.num_envs, count))
            weights[some], taken = self._weights(np.full(some.stop - first, length), (1, 3, first))
            steps += taken
            if progress:
                progress(some.stop / count)
        return weights.reshape(repetitions, episodes).mean(axis=1), steps

    def _weights(self, lengths: np.ndarray, spawn_key: tuple[int, ...]) -> tuple[np.ndarray, int]:
        """Return each episode's density ratio up to its violation, and the control periods.

        The ratio is 0 without a violation.
        """
        seed = np.random.SeedSequence(self.seed, spawn_key=spawn_key)
        env = self.make(lengths)
        world: Any = readable(env)
        generator = np.random.default_rng(seed.spawn(1)[0])
        observation, info = env.reset(seed=seed.generate_state(len(lengths), np.uint64).tolist())
        if isinstance(self.policy, Policy):
            self.policy.begin(range(len(lengths)), int(generator.integers(2**63)))
        hit = smallest(info["barrier"]) <= 0.0
        alive, weights, steps = ~hit, hit.astype(np.float64), 0
        with blas_threads.limited():
            while alive.any():
                x, before = world.components, info["barrier"]
                actions, _ = self.policy.predict(
                    observation, None, np.zeros(len(lengths), dtype=bool), deterministic=True
                )
                observation, _, terminated, truncated, info = env.step(actions)
                steps += int(np.count_nonzero(alive))
                after = info["barrier"]
                lowest = after
                if self.bridge is not None:
                    lowest = self.bridge.sample_minimum(
                        x, before, after, generator.standard_exponential(after.shape)
                    )
                hit = alive & (smallest(lowest) <= 0.0)
                weights[hit] = np.exp(log_ratio(world.girsanov_integrals[hit], lengths[hit]))
                alive &= ~hit & ~(terminated | truncated)
        return weights, steps
