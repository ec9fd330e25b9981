"""How long the episodes of registered envs are, in their specs."""

from __future__ import annotations

import dataclasses
import inspect
import sys
from typing import Any

import gymnasium as gym
from gymnasium.envs import registration
from gymnasium.envs.registration import EnvSpec, load_env_creator

from safe_envs.errors import ConfigurationError

_MAKERS = (
    registration.make.__code__,
    registration.make_vec.__code__,
    getattr(dataclasses, "_replace", dataclasses.replace).__code__,
)
"""Code that makes envs, or other specs, of a spec."""

_NOT_OF_PROBLEMS = {
    "autoreset_mode",
    "engine",
    "render_mode",
    "terminate_on_violation",
    *inspect.signature(registration.make).parameters,
    *inspect.signature(registration.make_vec).parameters,
}
"""Arguments of envs, `gym.make` and `gym.make_vec` that problems do not have."""


class SystemSpec(EnvSpec):
    """The spec of an env that ends its episodes itself, after the horizon of its problem.

    `max_episode_steps` is the length of the env's own episodes, or what was given, by Gymnasium's
    TimeLimit for one, where that is less. What makes envs and further specs of a spec reads only
    what was given: by the length, `gym.make` would limit the episodes of an env whatever `dt` and
    `horizon` it is made with.

    Attributes:
        own_steps: control periods until the env itself truncates an episode; None for those of the
            problem that it has by default.
    """

    own_steps: int | None = None

    @classmethod
    def of(cls, spec: EnvSpec, own_steps: int | None = None) -> SystemSpec:
        """Return a spec with everything that another one was given.

        Args:
            spec: the other one.
            own_steps: see the class.
        """
        found = cls(**_given(spec))
        found.own_steps = own_steps
        return found

    @property
    def max_episode_steps(self) -> int | None:
        """Control periods until an episode is truncated; None where that is not known."""
        if sys._getframe(1).f_code in _MAKERS:
            return self.given_steps
        own = self._default_steps() if self.own_steps is None else self.own_steps
        return _least(self.given_steps, own)

    @max_episode_steps.setter
    def max_episode_steps(self, steps: int | None) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        self.given_steps = steps

    def to_json(self) -> str:
        """Return what was given as JSON; see `EnvSpec.to_json`."""
        return EnvSpec(**_given(self)).to_json()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, EnvSpec) and _given(self) == _given(other)

    def _default_steps(self) -> int | None:
        creator: Any = load_env_creator(self.entry_point)  # pyright: ignore[reportArgumentType]
        given = {name: value for name, value in self.kwargs.items() if name not in _NOT_OF_PROBLEMS}
        try:
            steps = creator.make_problem(**given).steps
        except ConfigurationError:  # The id for any system has none of its own.
            return None
        return _least(steps, self.kwargs.get("max_episode_steps"))


class OwnSpec:
    """Base of envs whose spec tells the length of their own episodes, `_limit` periods.

    Gymnasium's class is among the direct bases of each subclass: skrl looks no further.
    """

    _spec: EnvSpec | None = None
    _limit: int

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        for kind in (gym.Env, gym.vector.VectorEnv):
            if issubclass(cls, kind) and kind not in cls.__bases__:
                bases = list(cls.__bases__)
                last = max(i for i, base in enumerate(bases) if issubclass(base, kind))
                cls.__bases__ = (*bases[: last + 1], kind, *bases[last + 1 :])  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def spec(self) -> EnvSpec | None:
        """The spec that the env was made of, with the length of its episodes."""
        return self._spec

    @spec.setter
    def spec(self, given: EnvSpec | None) -> None:
        self._spec = None if given is None else SystemSpec.of(given, self._limit)


def register_system(
    env_id: str, entry_point: str, vector_entry_point: str, **arguments: Any
) -> None:
    """Register an id with Gymnasium.

    Args:
        env_id: the id.
        entry_point: place of its `SystemEnv`.
        vector_entry_point: place of its `SystemVectorEnv`.
        **arguments: of the env.
    """
    gym.register(
        env_id, entry_point, vector_entry_point=vector_entry_point, kwargs=arguments or None
    )
    gym.registry[env_id] = SystemSpec.of(gym.registry[env_id])


def _least(*limits: int | None) -> int | None:
    """Return the least of some limits; Gymnasium's -1 is none, as None is."""
    return min((n for n in limits if n not in (None, -1)), default=None)  # pyright: ignore[reportReturnType, reportArgumentType]


def _given(spec: EnvSpec) -> dict[str, Any]:
    """Return the arguments of which a spec is made."""
    found = {f.name: getattr(spec, f.name) for f in dataclasses.fields(EnvSpec) if f.init}
    if isinstance(spec, SystemSpec):
        found["max_episode_steps"] = spec.given_steps
    return found
