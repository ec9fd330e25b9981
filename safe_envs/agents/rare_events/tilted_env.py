"""Envs whose noise drifts towards smaller h."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.agents.rare_events.path_noise import PathNoise
from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.dynamics.lie import gradient
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.envs.world_source import noise_channels
from safe_envs.problem.problem import SafetyProblem


class TiltedNoiseEnv(SafeVectorEnv):
    """`SafeVectorEnv` with dW - c e dt in place of dW.

    Here e = sigma' grad h/|sigma' grad h| is the direction in which h rises fastest.

    An env plays one episode after it was seeded; later ones have no noise.

    Of several barriers the smallest counts. Where no noise reaches it, e = 0. The e of a control
    period is that of its beginning.

    Args:
        problem: what to simulate.
        lengths: c of each env, in 1/sqrt(s), shape (num_envs,); 0 for the noise as it is.

    Attributes:
        girsanov_integrals: of each episode the integrals of e'dW, where W is what drives the
            system, and of e'e dt; shape (num_envs, 2). They give the density of the noise so far
            over that with a drift: see
            `safe_envs.agents.rare_events.importance_sampling.log_ratio`.
    """

    def __init__(self, problem: SafetyProblem, lengths: np.ndarray) -> None:
        super().__init__(problem, len(lengths))
        plant = problem.plant
        self._slopes = compile_function(plant.states, barrier_slopes(problem), "arrays")
        self._barriers = BarrierFunction(
            plant.states,
            [plant.numeric(barrier.expression) for barrier in problem.barriers],
            "arrays",
        )
        self._shape = (len(problem.barriers), len(plant.noise_channels), len(lengths))
        self._lengths = lengths
        self.girsanov_integrals = np.zeros((len(lengths), 2))
        batch: Any = self._batch
        batch.noise = _TiltedNoise(self)

    def tilt_direction(self) -> np.ndarray:
        """Return the direction e of the coming period, shape (noise channels, num_envs)."""
        slopes = stacked(self._slopes(*self.components), self.num_envs).T.reshape(self._shape)
        if len(slopes) == 1:
            steepest = slopes[0]
        else:
            barriers = stacked(self._barriers(*self.components), self.num_envs)
            steepest = slopes[barriers.argmin(axis=1), :, np.arange(self.num_envs)].T
        steepness = np.sqrt(_sum_of_products(steepest, steepest))
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
        self.girsanov_integrals[:, 0] += root * _sum_of_products(direction, moved)
        self.girsanov_integrals[:, 1] += root * root * _sum_of_products(direction, direction)
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


def barrier_slopes(problem: SafetyProblem) -> list[sp.Expr]:
    """Return sigma' grad h of each barrier, entry by entry for the channels with noise."""
    plant = problem.plant
    diffusion = plant.numeric(plant.diffusion)
    rows = [
        plant.numeric(gradient(plant, barrier.expression)) * diffusion
        for barrier in problem.barriers
    ]
    return [row[0, j] for row in rows for j in plant.noise_channels]


class _TiltedNoise(PathNoise):
    """The draws of an env with its drift."""

    def __init__(self, env: TiltedNoiseEnv) -> None:
        problem = env.problem
        super().__init__(env._streams, noise_channels(problem), problem.steps)
        self._env = env

    def begin(self, envs: np.ndarray) -> None:
        """See `PathNoise.begin`."""
        super().begin(envs)
        self._env.girsanov_integrals[envs] = 0.0

    def next(self, stepping: np.ndarray | None) -> np.ndarray:
        """See `PathNoise.next`."""
        # A state that overflows is found by the env, whose message is better than a warning.
        with np.errstate(all="ignore"):
            return self._env.tilted(super().next(stepping))


def _sum_of_products(one: np.ndarray, other: np.ndarray) -> Any:
    """Return the sums along the first axis, one term after the other for any number of envs."""
    total = one[0] * other[0]
    for a, b in zip(one[1:], other[1:], strict=True):
        total = total + a * b
    return total
