"""A problem as a Gymnasium env."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.arrays import real_array
from safe_envs.dynamics.noise import Key, StreamReader, key_of
from safe_envs.envs.episode import Actuators, Episode
from safe_envs.envs.info import Info
from safe_envs.envs.noise import NoiseStream
from safe_envs.envs.sensor import Sample, Sensor
from safe_envs.envs.simulation import LARGEST, Simulation, require_sound, steps_until
from safe_envs.envs.spaces import action_box, center_and_half_width, observation_box
from safe_envs.envs.spec import OwnSpec
from safe_envs.envs.starts import RequestedStart, ResetOptions
from safe_envs.errors import IndependentCopies, InvalidInputError, NumericalError, flag
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.viewer import RENDER_MODES, frames_a_second, open_viewer

_UNKNOWN = -1
"""Gymnasium's seed of a generator that was set."""


class SafeEnv(  # pyright: ignore[reportIncompatibleVariableOverride]
    OwnSpec, IndependentCopies, gym.Env[np.ndarray, np.ndarray]
):
    """Any `SafetyProblem` as a Gymnasium env.

    Actions are in [-1, 1] for every input and are scaled to the input bounds; what lies beyond is
    clipped. Actions may be given in double precision. The observation holds the problem's features
    as float32, `state` the exact state. The keys of `info` are those of `safe_envs.envs.info`.

    The episode is terminated when the goal is reached or the state leaves the workspace, and
    truncated after `horizon`. A violation does not end it, unless that is asked for.

    Attributes:
        sent: the physical input that the last step was given.
        executed: the physical input that the plant executed in it; the same, but for a problem with
            a delay or a slew limit.
        viewer: what is drawn, and its caption; None without a render mode.

    Args:
        problem: what to simulate.
        max_episode_steps: truncate after so many control periods, if that is before the horizon.
        render_mode: "rgb_array" for pictures by `render()`, "human" for a window that every step is
            drawn to, or None.
        terminate_on_violation: whether the first step to an unsafe state terminates the episode.

    Raises:
        ConfigurationError: an argument is out of range.
    """

    # The frame rate of an env is that of its own control period.
    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": [*RENDER_MODES],
        "render_fps": 20,
    }

    def __init__(
        self,
        problem: SafetyProblem,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        terminate_on_violation: bool = False,
    ) -> None:
        self.viewer = open_viewer(problem, render_mode)
        self.metadata = {**self.metadata, "render_fps": frames_a_second(problem)}
        self.problem = problem
        self.observation_space = observation_box(problem)
        self._bounds = observation_box(problem.unmeasured)
        self.action_space = action_box(problem)
        self.render_mode = render_mode
        self._simulation = Simulation(problem, "floats")
        self._scales = list(zip(*center_and_half_width(problem), strict=True))
        self._action_shape = (len(problem.inputs),)
        self._limit = steps_until(problem, max_episode_steps)
        self._ends_on_violation = flag("terminate_on_violation", terminate_on_violation)
        self._noise = NoiseStream(self._simulation.integrator.channels, self._limit)
        self._reader = StreamReader()
        self._key: Key | None = None
        self._number = 0
        self.sent = self.executed = ()
        self._actuators = None if problem.direct else Actuators(problem)
        measured = problem.measurement
        self._sensor = measured and Sensor(problem, measured, self._limit)
        self._x: tuple[float, ...] | None = None
        self._episode = Episode()
        self._reset_options = ResetOptions(problem, self._limit)

    @property
    def episode(self) -> Episode:
        """Counters of the episode."""
        return self._episode

    @property
    def components(self) -> tuple[float, ...]:
        """The exact state, as plain floats in the order of the problem's states."""
        if self._x is None:
            raise gym.error.ResetNeeded("the env has no state yet: call reset() first")
        return self._x

    @property
    def measured(self) -> Sample | None:
        """What has arrived from the sensor; None where the observation is of the true state."""
        return None if self._sensor is None else Sample(*map(tuple, self._sensor.sample))

    @property
    def state(self) -> np.ndarray:
        """The exact state, shape (n,), in the units of the problem's states.

        It can be set within an episode, as a whole: the array is read-only. Its clock, its noise,
        its counters and the inputs that are under way go on, and nothing is counted before the next
        step. A filter with a memory forgets what it kept, and keeps from there on what it can keep
        from the new state.

        Raises:
            InvalidInputError: the state has another shape, is not finite, or outside the workspace.
            ResetNeeded: there is no episode yet.
        """
        found = np.array(self.components)
        found.flags.writeable = False
        return found

    @state.setter
    def state(self, given: Any) -> None:
        # Without an episode there is none to put a state into.
        _ = self.components
        self._x = tuple(self._reset_options.states(given)[0].tolist())
        self._episode.placements += 1
        self._show_start()

    def physical_action(self, action: Any) -> list[float]:
        """Map an action in [-1, 1] to the input bounds; what lies beyond is clipped.

        Raises:
            InvalidInputError: the action has another shape than (m,), or does not hold finite real
                numbers.
        """
        given = (
            action
            if type(action) is np.ndarray and action.dtype.char in "fd"
            else real_array("action", action)
        )
        if given.shape != self._action_shape:
            raise InvalidInputError(
                f"action has shape {given.shape}; the env takes {self._action_shape}"
            )
        physical = []
        for a, (c, w) in zip(given.tolist(), self._scales, strict=True):
            if not -math.inf < a < math.inf:
                raise InvalidInputError(
                    f"action {given.tolist()} is not finite; give numbers in [-1, 1]"
                )
            physical.append(c + w if a > 1.0 else c - w if a < -1.0 else c + w * a)
        return physical

    def normalized_action(self, physical: Sequence[float]) -> np.ndarray:
        """Invert `physical_action`: return an action in double precision."""
        return np.array([(u - c) / w for u, (c, w) in zip(physical, self._scales, strict=True)])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start an episode, by default with a draw from the problem's initial distribution.

        A given state or time changes nothing else: the noise of a control period is the one that it
        has in any episode of this seed and number.

        Args:
            seed: of starts and noise, of which every episode since the seed has its own; None goes
                on to the next one. `np_random` is seeded too, but nothing is drawn from it, unless
                it was set: then every episode takes a key of its own from it.
            options: "state", the start state (n,), or "start", the name of one of the problem's
                start distributions; and "t", the time in s that has passed, in whole control
                periods. A state may be unsafe, but not outside the workspace.

        Returns:
            The observation, float32 (k,), and the info.

        Raises:
            ConfigurationError: an option is unknown, or does not go with another.
            InvalidInputError: a state or a time is not allowed.
        """
        requested = None if options is None else self._reset_options.read(options)
        super().reset(seed=seed)
        self._begin_episode(seed is not None, requested)
        observation, _, _, info = self._observe([c for c, _ in self._scales])
        self._show_start()
        return observation, info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Hold an action for one control period.

        Raises:
            InvalidInputError: see `physical_action`.
            NumericalError: the state is not finite any more.
        """
        return self.step_physical(self.physical_action(action))

    def step_physical(self, u: Sequence[float]) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Step with a physical input inside its bounds, as a filter returns it."""
        self.sent = u = tuple(u)
        if self._actuators is not None:
            u = self._actuators.execute(u)
        self.executed = u
        try:
            self._x = self._simulation.integrator.step(self.components, u, self._noise.next())
            self._episode.steps += 1
            observation, reward, terminated, info = self._observe(u)
        except (OverflowError, ZeroDivisionError, ValueError) as error:
            raise NumericalError(
                f"the simulation of {self.problem.name!r} broke down at {self._x}: {error}"
            ) from error
        if self.viewer is not None:
            self.viewer.advance([self._x], [self._episode.steps * self.problem.dt], [u])
        return observation, reward, terminated, self._episode.steps >= self._limit, info

    def render(self) -> Any:
        """Draw the state, with the trail of the episode and what a filter decided.

        Returns:
            uint8 (height, width, 3) in the mode "rgb_array"; None in "human", which has a window.

        Raises:
            gymnasium.error.DependencyNotInstalled: pygame is missing.
            ResetNeeded: there is no state yet.
            ConfigurationError: there is no display for a window.
        """
        if self.viewer is None:
            gym.logger.warn(
                "render() draws nothing without a render mode; make the env with"
                ' render_mode="rgb_array" or "human"'
            )
            return None
        _ = self.components
        return self.viewer.render()

    def close(self) -> None:
        """Close the window of the mode "human"."""
        if self.viewer is not None:
            self.viewer.close()

    def _begin_episode(self, seeded: bool, requested: RequestedStart | None) -> None:
        """Go to the streams of the next episode, and to its start."""
        if self.np_random_seed == _UNKNOWN:
            low, high = self.np_random.integers(2**64, size=2, dtype=np.uint64).tolist()
            self._key, self._number = (low, high), 0
        elif seeded or self._key is None:
            self._key, self._number = key_of(self.np_random_seed), 0
        else:
            self._number += 1
        steps, sampler = 0, self._simulation.starts
        if requested is not None:
            steps, sampler = requested.steps.item(), self._reset_options.sampler(requested.start)
        if requested is None or requested.states is None:
            self._x = sampler.draw(self._reader, self._key, self._number)
        else:
            self._x = tuple(requested.states[0].tolist())
        self._noise.begin(self._key, self._number, steps)
        self._episode.restart(steps)
        if self._actuators is not None:
            self._actuators.restart()
        if self._sensor is not None:
            self._sensor.begin(self._key, self._number, steps)

    def _show_start(self) -> None:
        """Let what is drawn begin at the present state."""
        if self.viewer is not None:
            self.viewer.restart([self._x], [self._episode.steps * self.problem.dt], [0])

    def _observe(self, u: Sequence[float]) -> tuple[np.ndarray, float, bool, Info]:
        x, episode = self.components, self._episode
        features, barriers, reward, outside, goal = self._simulation.measure(
            x, u, episode.steps * self.problem.dt
        )
        if not abs(sum(x) + sum(features) + reward) < LARGEST:
            with np.errstate(over="ignore"):
                seen = np.array([features], dtype=np.float32)
            require_sound(tuple(np.array([c]) for c in x), seen, np.array([reward]), self.problem)
        h = min(barriers)
        if left := outside > 0.0:
            features = np.clip(features, self._bounds.low, self._bounds.high)
        observation = np.array(features, dtype=np.float32)
        info = episode.count(barriers, h)
        if self._actuators is not None:
            info |= self._actuators.report()
        if self._sensor is not None:
            observation = self._sensor.observe(x)
            info |= self._sensor.report(x)
        unsafe = self._ends_on_violation and h < 0.0
        return observation, reward, left or goal >= 0.0 or unsafe, info
