"""Paths side by side in vector envs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge, Exponentials
from safe_envs.agents.evaluation.targets import Env
from safe_envs.agents.jobs import blas_threads
from safe_envs.agents.policies.base import Policy
from safe_envs.agents.rare_events.heights import Heights
from safe_envs.agents.rare_events.records import Records
from safe_envs.dynamics.codegen import stacked
from safe_envs.envs.simulation import Simulation
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.env_wrappers.safety_filter_vector import readable

MakeTiltedEnv = Callable[[np.ndarray], Env]
"""Makes a filtered `TiltedNoiseEnv` with drifts of given lengths."""

_FEWEST_ENVS = 64


class NumpyPaths:
    """Simulates paths in vector envs.

    Args:
        problem: what they simulate.
        make: makes them.
        policy: anything with Stable-Baselines3's `predict`, without memory.
        num_envs: the most paths side by side, which changes nothing but the time it takes.
        continuous: whether to look at h between control instants too.

    Attributes:
        steps: control periods of an episode.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        make: MakeTiltedEnv,
        policy: Any,
        num_envs: int,
        continuous: bool = False,
    ) -> None:
        self.steps = problem.steps
        self._make, self._policy, self._num_envs = make, policy, num_envs
        self._bridge = BrownianBridge(problem) if continuous else None
        self._envs: dict[tuple[int, float], Any] = {}
        self._simulation = Simulation(problem, "arrays")

    def starts(self, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `safe_envs.agents.rare_events.particles.PathPlayer`."""
        found = []
        for first in range(0, len(keys), self._num_envs):
            some = keys[first : first + self._num_envs]
            env = self._env(len(some), 0.0)
            _, info = env.reset(seed=_filled(some, env.num_envs).tolist())
            world: Any = readable(env)
            found.append((world.state[: len(some)], info["barrier"][: len(some)]))
        states, barriers = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return states, barriers

    def play(
        self,
        paths: np.ndarray,
        keys: np.ndarray,
        heights: Heights,
        records: Records,
        length: float,
    ) -> np.ndarray:
        """See `safe_envs.agents.rare_events.particles.PathPlayer`."""
        ends = np.empty(len(paths), dtype=np.int64)
        # Paths that have equally far to go share a batch, which takes as long as the longest of
        # them.
        order = np.argsort(records.last(paths)[1], kind="stable")
        with blas_threads.limited():
            for first in range(0, len(paths), self._num_envs):
                some = order[first : first + self._num_envs]
                env = self._env(len(some), length)
                batch = _Batch(env, paths[some], keys[paths[some]], records)
                batch.begin(self._policy, self._bridge, first)
                ends[some] = batch.play(self._policy, heights, self._simulation)
        return ends

    def _env(self, count: int, length: float) -> Any:
        """Return an env with at least so many episodes side by side."""
        size = self._num_envs
        while size // 2 >= max(count, _FEWEST_ENVS):
            size //= 2
        if (size, length) not in self._envs:
            env = self._envs[size, length] = self._make(np.full(size, length))
            env.reset(seed=0)
        return self._envs[size, length]


class _Batch:
    """Paths in the first rows of an env, which go on from their last records.

    Args:
        env: of them and of rows that do not count.
        paths: their numbers, shape (B,).
        keys: of them.
        records: of all paths.
    """

    def __init__(self, env: Any, paths: np.ndarray, keys: np.ndarray, records: Records) -> None:
        self._env, self._paths, self._records = env, paths, records
        self._world: Any = readable(env)
        self._lowest, self._time, self._over, states, integrals = records.last(paths)
        rows = env.num_envs
        self._seeds, self._begun = _filled(keys, rows).tolist(), _filled(self._time, rows)
        snapshot = env.snapshot()
        snapshot["state"], snapshot["steps"] = _filled(states, rows), self._begun
        snapshot["girsanov_integrals"] = _filled(integrals, rows)
        snapshot["ended"][:] = False
        env.restore(snapshot, seed=self._seeds)

    def begin(self, policy: Any, bridge: BrownianBridge | None, first: int) -> None:
        """Begin the streams of a policy and of the bridges.

        Args:
            policy: who acts.
            bridge: gives the minimum h between control instants, if it is to be looked at.
            first: row of the first path, if all were in one batch.
        """
        if isinstance(policy, Policy):
            rows = range(first, first + self._env.num_envs)
            policy.resume(rows, self._seeds, self._begun.tolist())
        self._bridge = bridge
        if bridge is not None:
            self._barriers = bridge.barriers(self._world.components)
            self._draws = Exponentials(self._seeds, bridge.draws, self._begun.tolist())

    def play(self, policy: Any, heights: Heights, simulation: Simulation) -> np.ndarray:
        """Simulate the paths until they end or violate; return when.

        Args:
            policy: who acts.
            heights: of all paths.
            simulation: of the problem, which gives the first observation.
        """
        count, world, lowest, time = len(self._paths), self._world, self._lowest, self._time
        x = world.components
        rest, _ = center_and_half_width(world.problem)
        with np.errstate(all="ignore"):
            features = simulation.measure(x, rest, self._begun * world.problem.dt)[0]
        observation = stacked(features, len(x[0])).astype(np.float32)
        ends = time.copy()
        alive = (lowest > 0.0) & ~self._over
        while alive.any():
            x = world.components
            observation, _, terminated, truncated, info = self._env.step(_act(policy, observation))
            time += 1
            ends[alive] = time[alive]
            weights = heights.weight(np.minimum(time, len(heights.weights) - 1), self._paths)
            height = heights.relative(self._looked_at(x, info["barrier"])[:count]) * weights
            over = (terminated | truncated)[:count]
            fell = np.flatnonzero(alive & (height < lowest))
            if fell.size:
                lowest[fell] = height[fell]
                self._records.add(
                    self._paths[fell],
                    height[fell],
                    time[fell],
                    over[fell],
                    np.stack([component[fell] for component in world.components], axis=-1),
                    world.girsanov_integrals[fell],
                )
            alive &= (lowest > 0.0) & ~over
        return ends

    def _looked_at(self, x: Any, after: np.ndarray) -> np.ndarray:
        """Return the smallest values of the barriers in a period that began at the states x."""
        if self._bridge is None:
            return after
        before, self._barriers = self._barriers, after
        return self._bridge.sample_minimum(x, before, after, self._draws.next())


def _act(policy: Any, observation: np.ndarray) -> np.ndarray:
    actions, memory = policy.predict(
        observation, None, np.zeros(len(observation), dtype=bool), deterministic=True
    )
    if memory is not None:
        raise ConfigurationError(
            "the policy has a memory, which splitting cannot take up again; estimate with plain"
            " episodes"
        )
    return actions


def _filled(values: np.ndarray, rows: int) -> np.ndarray:
    """Return values with the first of them once more for each further row."""
    return np.concatenate([values, np.repeat(values[:1], rows - len(values), axis=0)])
