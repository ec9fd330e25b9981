"""The one implementation of physics, reward and observation, over floats or arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, Flavour, compile_function
from safe_envs.dynamics.integrators import Integrator
from safe_envs.errors import require_whole
from safe_envs.problem.initial_distribution import StartSampler
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME

_CHUNK = 256


class Simulation:
    """The compiled formulas of a problem, without a state: one object serves any number of envs."""

    def __init__(self, problem: SafetyProblem, flavour: Flavour) -> None:
        self.problem = problem
        self.integrator = Integrator(problem.plant, problem.dt, problem.substeps, flavour)
        self._features = len(problem.features)
        self._barriers = self._features + len(problem.barriers)
        read = (
            *(f.expression for f in problem.features),
            *(b.expression for b in problem.barriers),
            problem.reward,
            problem.outside,
            -1 if problem.goal is None else problem.goal,
        )
        self.timed = TIME in set().union(*(sp.sympify(e).free_symbols for e in read))
        self._measure = compile_function(
            (*problem.plant.states, *problem.plant.inputs, TIME), read, flavour
        )
        self.starts = StartSampler(
            problem.starts[problem.start], problem.model, f"{problem.name!r} ({problem.start})"
        )

    def measure(
        self, x: Components, u: Sequence[Any], time: Any
    ) -> tuple[Components, Components, Any, Any, Any]:
        """Return what can be read off a state.

        Args:
            x: components of the state.
            u: components of the executed input that led to it.
            time: since the start of the episode, in s.

        Returns:
            The features, the barriers, the reward, the distance by which the workspace was left (>
            0 outside), and the goal (>= 0 where it is reached).
        """
        values = self._measure(*x, *u, time)
        f, b = self._features, self._barriers
        return values[:f], values[f:b], values[b], values[b + 1], values[b + 2]


class NoiseStream:
    """Standard normal numbers of one env, drawn ahead in chunks."""

    def __init__(self, channels: int) -> None:
        self._channels = channels
        self.clear()

    def clear(self) -> None:
        """Forget what was drawn ahead, since the generator has a new seed."""
        self._rows: list[list[float]] = []
        self._position = 0

    def next(self, rng: np.random.Generator) -> list[float]:
        """Return the draws of the next control period."""
        if not self._channels:
            return []
        if self._position == len(self._rows):
            self._rows = rng.standard_normal((_CHUNK, self._channels)).tolist()
            self._position = 0
        self._position += 1
        return self._rows[self._position - 1]


class NoiseStreams:
    """Standard normal numbers of a batch: each env keeps its own stream."""

    def __init__(self, num_envs: int, channels: int) -> None:
        self._buffer = np.empty((num_envs, _CHUNK, channels))
        self._rows = self._buffer.reshape(num_envs * _CHUNK, channels)
        self._end = (np.arange(num_envs) + 1) * _CHUNK
        self._row = self._end.copy()
        self._before_refill = 0

    def clear(self, envs: Sequence[int]) -> None:
        """Forget what was drawn ahead for some envs, since their generators have new seeds."""
        self._row[envs] = self._end[envs]
        self._before_refill = 0

    def next(self, rngs: Sequence[np.random.Generator], stepping: np.ndarray | None) -> np.ndarray:
        """Return the draws of the next control period, shape (channels, num_envs).

        Args:
            rngs: generator of each env.
            stepping: the envs whose stream moves on; None for all. The others get draws that are to
                be ignored.
        """
        if not self._buffer.shape[2]:
            return self._rows.T[:0]
        if not self._before_refill:
            self._refill(rngs, stepping)
        self._before_refill -= 1
        draws = self._rows.take(
            self._row if stepping is None else np.where(stepping, self._row, 0), axis=0
        ).T
        self._row += 1 if stepping is None else stepping
        return draws

    def _refill(self, rngs: Sequence[np.random.Generator], stepping: np.ndarray | None) -> None:
        used_up = self._row == self._end
        for i in np.flatnonzero(used_up if stepping is None else used_up & stepping).tolist():
            rngs[i].standard_normal(out=self._buffer[i])
            self._row[i] -= _CHUNK
        self._before_refill = max(int((self._end - self._row).min()), 1)


def steps_until(problem: SafetyProblem, max_episode_steps: int | None) -> int:
    """Return the control periods until an episode is truncated.

    Args:
        problem: whose horizon is the limit.
        max_episode_steps: a lower limit, if any.

    Raises:
        ConfigurationError: the limit is no whole number from 1.
    """
    if max_episode_steps is None:
        return problem.steps
    require_whole("max_episode_steps", max_episode_steps, 1)
    return min(problem.steps, max_episode_steps)
