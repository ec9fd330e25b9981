"""The states of a batch of envs, moved and read by NumPy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Components, filled, finite, settled, stacked
from safe_envs.envs.episode import Actuators, Episodes
from safe_envs.envs.info import VectorStep
from safe_envs.envs.noise import NoiseStreams
from safe_envs.envs.sensor import BatchSensor
from safe_envs.envs.simulation import Simulation, require_sound
from safe_envs.envs.spaces import BatchActions, observation_box
from safe_envs.envs.starts import EpisodeStreams, StartingPoints
from safe_envs.problem.problem import SafetyProblem


class ArrayBatch:
    """The states of a batch of envs, with the interface of `CompiledBatch`.

    Attributes:
        components: of the states, () before the first episode.
        sent: components of the physical inputs that the last step was given.
        executed: components of those that were executed in it; see `SafeEnv`.
        actuators: between the two; None where they are the same.
        noise: that drives the states.
        sensor: what measures the states; None where the observation is of the true ones.

    Args:
        problem: what to simulate.
        streams: of the envs.
        episodes: of the envs; counted here.
        limit: control periods until an episode is truncated.
    """

    def __init__(
        self, problem: SafetyProblem, streams: EpisodeStreams, episodes: Episodes, limit: int
    ) -> None:
        self.components: Components = ()
        self.sent: Sequence[Any] = ()
        self.executed: Sequence[Any] = ()
        self.actuators = None if problem.direct else Actuators(problem, streams.num_envs)
        self._problem, self._streams, self._episodes, self._limit = (
            problem,
            streams,
            episodes,
            limit,
        )
        self._shape = (streams.num_envs,)
        self._bounds = observation_box(problem.unmeasured)
        self._simulation = Simulation(problem, "arrays")
        self._actions = BatchActions(problem, streams.num_envs)
        self.noise = NoiseStreams(streams, self._simulation.integrator.channels, limit)
        measured = problem.measurement
        self.sensor = measured and BatchSensor(problem, measured, streams, limit)
        observed = {f.expression for f in problem.features}
        self._unobserved = [i for i, s in enumerate(problem.plant.states) if s not in observed]

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return what a batch remembers besides states and counters, in arrays."""
        parts = [part for part in (self.actuators, self.sensor) if part is not None]
        return {name: value for part in parts for name, value in part.snapshot().items()}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Take it from a snapshot."""
        for part in (self.actuators, self.sensor):
            if part is not None:
                part.restore(snapshot)

    def place(self, states: np.ndarray, seeded: Sequence[int]) -> None:
        """Put the envs into states, where their episodes are.

        Args:
            states: shape (num_envs, n).
            seeded: indices of the envs whose noise goes to the step of their episode.
        """
        self.components = tuple(np.array(states, dtype=float).T.copy())
        self.noise.seek(seeded, self._episodes.steps[seeded])
        if self.sensor is not None:
            # The sample of the present instant has been taken.
            self.sensor.noise.seek(seeded, self._episodes.steps[seeded] + 1)

    def begin(self, envs: np.ndarray, points: StartingPoints | None = None) -> VectorStep:
        """Begin the next episode of some envs, and read all states.

        Args:
            envs: which, bool (num_envs,).
            points: where; None for draws from the problem's distribution.

        Returns:
            What is read off the states.
        """
        self._restart(np.flatnonzero(envs), points)
        with np.errstate(all="ignore"):
            return self._read(tuple(self._actions.center), counted=envs)

    def step(self, actions: Any, due: np.ndarray | None) -> VectorStep:
        """Hold actions in [-1, 1]; see `step_physical`.

        Args:
            actions: shape (num_envs, m).
            due: see there.

        Returns:
            What is read off the states.

        Raises:
            InvalidInputError: See `BatchActions.physical`.
        """
        return self._hold(self._actions.physical(actions), due)

    def step_physical(self, u: Sequence[Any], due: np.ndarray | None) -> VectorStep:
        """Hold inputs for one control period.

        Args:
            u: components of the physical inputs.
            due: the envs that begin an episode instead, bool (num_envs,); None for none.

        Returns:
            What is read off the states.

        Raises:
            NumericalError: A state is not finite any more.
        """
        # The caller may write to theirs again.
        return self._hold([np.array(component, dtype=float) for component in u], due)

    def _hold(self, u: Sequence[Any], due: np.ndarray | None) -> VectorStep:
        self.sent = u
        if self.actuators is not None:
            u = self.actuators.execute(u)
        self.executed = u
        draws = self.noise.next(None if due is None else ~due)
        # A state that overflows is found by `_read`, which says so better than a warning.
        with np.errstate(all="ignore"):
            self.components = self._simulation.integrator.step(self.components, u, draws)
            self._episodes.steps += 1
            if due is not None:
                self._restart(np.flatnonzero(due))
            observation, reward, terminated, truncated, info = self._read(u)
        if due is not None:
            reward = np.where(due, 0.0, reward)
        return observation, reward, terminated, truncated, info

    def _restart(self, envs: np.ndarray, points: StartingPoints | None = None) -> None:
        """Put some envs, given by their indices, at the start of an episode."""
        begun = self._streams.begin_episodes(envs)
        self.noise.begin(envs)
        if points is None:
            start, steps = self._simulation.starts.draw_batch(self._streams.reader, *begun), 0
        else:
            start, steps = points.states[envs].T.copy(), points.steps[envs]
            self.noise.seek(envs, steps)
        if (envs.size,) == self._shape:
            self.components = tuple(start)
        else:
            self.components = tuple([x.copy() for x in self.components])
            for x, fresh in zip(self.components, start, strict=True):
                x[envs] = fresh
        self._episodes.restart(envs, steps)
        if self.actuators is not None:
            self.actuators.restart(envs)
        if self.sensor is not None:
            self.sensor.begin(envs, steps)

    def _read(self, u: Sequence[Any], counted: np.ndarray | None = None) -> VectorStep:
        """Read the states; `counted` are the envs whose states are new (None: all)."""
        self.components = x = settled(self.components, self._shape)
        time = self._episodes.steps * self._problem.dt if self._simulation.timed else 0.0
        features, barriers, reward, outside, goal = self._simulation.measure(x, u, time)
        rows = np.empty((len(features), *self._shape), dtype=np.float32)
        for row, feature in zip(rows, features, strict=True):
            row[:] = feature
        observation = rows.T
        barrier = stacked(barriers, *self._shape)
        h = barriers[0] if len(barriers) == 1 else barrier.min(axis=1)
        info = self._episodes.count(barrier, h, counted)
        if self.actuators is not None:
            info |= self.actuators.report()
        terminated = filled(outside > 0.0, self._shape)
        reward = filled(reward, self._shape).copy()
        sound = finite(rows) and finite(reward)
        for i in self._unobserved:
            sound = sound and finite(x[i])
        if np.count_nonzero(terminated):
            envs = np.flatnonzero(terminated)
            observation[envs] = np.clip(observation[envs], self._bounds.low, self._bounds.high)
        if not sound:
            require_sound(x, observation, reward, self._problem)
        if self.sensor is not None:
            observation = self.sensor.observe(x, counted)
            info |= self.sensor.report(x)
        if self._problem.goal is not None:
            terminated = terminated | (goal >= 0.0)
        return observation, reward, terminated, self._episodes.steps >= self._limit, info
