"""Safety of envs that know nothing of it: `info` as for this project's own, and their states and
inputs for a filter."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.dynamics.codegen import Components, Flavour, compile_function, stacked
from safe_envs.envs.episode import Episode
from safe_envs.envs.info import Info
from safe_envs.errors import InvalidInputError, NumericalError, SystemDefinitionWarning
from safe_envs.rendering.viewer import Viewer
from safe_envs.validators import real_array
from safe_envs.wrappers.env_wrappers.external_env import FilterSpec

_CHANGE_SIGHT = (
    gym.ObservationWrapper,
    gym.wrappers.NormalizeObservation,
    gym.wrappers.FrameStackObservation,
)
"""Wrappers that change observations."""


class SafetyMonitor(gym.Wrapper[np.ndarray, Any, np.ndarray, Any], gym.utils.RecordConstructorArgs):
    """Adds cost, violation, barrier, h_min and episode_cost to `info`, by a model's barriers;
    actions go through unchanged.

    Keys of the same names that the env reports itself are replaced.

    Args:
        env: any env with a box of actions.
        spec: how its state is seen, and what is safe; or FILE.py:NAME of that, with which an env's
            own spec can be written as JSON.

    Attributes:
        problem: the model as a problem.
        executed: the model's input of the last step.
        viewer: what the pictures are drawn from; None unless the render mode is "rgb_array".

    Raises:
        ConfigurationError: the spec does not fit the env.
    """

    def __init__(self, env: gym.Env[Any, Any], spec: FilterSpec | str) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, spec=spec, _disable_deepcopy=True)
        gym.Wrapper.__init__(self, env)
        spec = FilterSpec.load(spec) if isinstance(spec, str) else spec
        doubt_layers(env)
        self.problem = spec.problem(env.unwrapped, env.action_space, *named_and_limited(env))
        self._spec = spec
        self._barriers = barriers_of(spec, "floats")
        self._low, self._high, self._kind = ends_of(env.action_space)
        self.viewer = (
            Viewer(self.problem, "rgb_array", 1) if env.render_mode == "rgb_array" else None
        )
        self.executed: Sequence[float] = ()
        self._x: tuple[float, ...] | None = None
        self._episode = Episode()

    @property
    def components(self) -> tuple[float, ...]:
        """The state that the last observation shows, as plain floats."""
        if self._x is None:
            raise gym.error.ResetNeeded("the env has no state yet: call reset() first")
        return self._x

    def physical_action(self, action: Any) -> list[float]:
        """The model's input for an action; what lies beyond the action space is clipped.

        Raises:
            InvalidInputError: the action has another shape, or does not hold finite real numbers.
        """
        given = np.asarray(real_array("action", action), dtype=np.float64)
        if given.shape != self._low.shape or not np.isfinite(given).all():
            raise InvalidInputError(
                f"action {given.tolist()}: the env takes finite numbers of shape {self._low.shape}"
            )
        return self._spec.inputs(np.clip(given, self._low, self._high)).tolist()

    def normalized_action(self, u: Sequence[float]) -> np.ndarray:
        """Inverse of `physical_action`: the env's action for an input of the model, in the numbers
        of the action space."""
        return np.clip(self._spec.actions(np.array(u)), self._low, self._high).astype(self._kind)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._episode.restart()
        seen = self._seen(observation)
        if self.viewer is not None:
            self.viewer.restart([self.components], [0.0], [0])
        return observation, {**info, **seen}

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """Pass on an action, and look at what comes of it."""
        self.executed = self.physical_action(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._episode.steps += 1
        seen = self._seen(observation)
        if self.viewer is not None:
            time = self._episode.steps * self.problem.dt
            self.viewer.advance([self.components], [time], [self.executed])
        return observation, reward, terminated, truncated, {**info, **seen}

    def step_physical(self, u: Sequence[float]) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """`step` for the model's input."""
        return self.step(self.normalized_action(u))

    def render(self) -> Any:
        """The env's own picture, in the mode "rgb_array" with what the filter does and the barrier
        beside it.

        Raises:
            gymnasium.error.DependencyNotInstalled: pygame is missing.
        """
        picture = self.env.render()
        return picture if self.viewer is None else self.viewer.frames([np.asarray(picture)])[0]

    def _seen(self, observation: Any) -> Info:
        self._x = tuple(self._spec.state(observation).tolist())
        try:
            barrier = self._barriers(*self._x)
        except (ArithmeticError, ValueError) as error:
            raise _undefined(self.problem.name, self._x) from error
        h = min(barrier)
        if not math.isfinite(h):
            raise _undefined(self.problem.name, self._x)
        return self._episode.count(barrier, h)


def doubt_layers(env: gym.Env[Any, Any]) -> None:
    """Warn of wrappers between a filter and its env that change what it sees or does."""
    layer = env
    while isinstance(layer, gym.Wrapper):
        sees = (
            isinstance(layer, _CHANGE_SIGHT)
            or layer.observation_space != layer.env.observation_space
        )
        acts = isinstance(layer, gym.ActionWrapper) or layer.action_space != layer.env.action_space
        if sees or acts:
            part = "state_fn" if sees else "action_map"
            warnings.warn(
                f"{type(layer).__name__} lies between the filter and the env and changes"
                f" {'observations' if sees else 'actions'}: unless {part} undoes that, the filter"
                " keeps something else safe. Put wrappers around the filter",
                SystemDefinitionWarning,
                stacklevel=4,
            )
        layer = layer.env


def named_and_limited(env: Any) -> tuple[str, int | None]:
    """Name of an env, and the number of steps after which it is truncated."""
    spec = env.spec
    return (
        (type(env.unwrapped).__name__, None) if spec is None else (spec.id, spec.max_episode_steps)
    )


def ends_of(space: Any) -> tuple[np.ndarray, np.ndarray, Any]:
    """Lower and upper ends of a box of actions in double precision, and the kind of its numbers."""
    return space.low.astype(np.float64), space.high.astype(np.float64), space.dtype


def barriers_of(spec: FilterSpec, flavour: Flavour) -> Any:
    """The barriers of a spec, compiled."""
    return compile_function(
        spec.model.states, [spec.model.numeric(b.expression) for b in spec.named], flavour
    )


def _undefined(name: str, x: Sequence[float]) -> NumericalError:
    return NumericalError(
        f"a barrier over {name} has no finite value at the state {list(x)}; check it there"
    )


def barrier_table(barriers: Any, name: str, x: Components) -> np.ndarray:
    """Values of the barriers at a batch of states, shape (B, k).

    Raises:
        NumericalError: one is not finite.
    """
    with np.errstate(all="ignore"):
        table = stacked(barriers(*x), len(x[0]))
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise _undefined(name, [float(c[bad][0]) for c in x])
    return table
