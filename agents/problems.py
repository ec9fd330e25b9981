"""From a registered id to its problem."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from safe_envs import ENV_IDS, SafeEnv, SafetyProblem
from safe_envs.errors import ConfigurationError, nearest


def full_id(env_id: str) -> str:
    """Return the registered id, which may be given without its namespace.

    Raises:
        ConfigurationError: there is no such id.
    """
    for candidate in (env_id, f"safe_envs/{env_id}"):
        if candidate in gym.registry:
            return candidate
    name = env_id if "/" in env_id else f"safe_envs/{env_id.removesuffix('-v0')}-v0"
    raise ConfigurationError(f"unknown env {env_id!r}; {nearest(name, ENV_IDS)}")


def make_env(env_id: str, options: Mapping[str, Any] | None = None) -> SafeEnv:
    """Make the scalar env of an id, without wrappers.

    Args:
        env_id: registered id.
        options: arguments of `gym.make`; those that are None are left out.

    Raises:
        ConfigurationError: the id is unknown or not of this project, or an argument is not allowed.
    """
    spec = gym.spec(full_id(env_id))
    creator = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
    if not (isinstance(creator, type) and issubclass(creator, SafeEnv)):
        raise ConfigurationError(f"{env_id} is not one of this project's envs; {nearest(env_id, ENV_IDS)}")
    given = {key: value for key, value in (options or {}).items() if value is not None}
    return gym.make(spec, disable_env_checker=True, **given).unwrapped  # pyright: ignore[reportReturnType]


def load_problem(env_id: str, options: Mapping[str, Any] | None = None) -> SafetyProblem:
    """The problem of a registered env; arguments and errors as for `make_env`.

    Raises:
        ConfigurationError: `max_episode_steps` is given, which is no property of a problem.
    """
    if (options or {}).get("max_episode_steps") is not None:
        raise ConfigurationError("max_episode_steps is not part of a problem; shorten its episodes by horizon")
    return make_env(env_id, options).problem
