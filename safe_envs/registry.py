"""Registered ids, and the problems behind them."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.systems import CUSTOM_ID, ENV_IDS

if TYPE_CHECKING:
    from safe_envs.envs.registered import SystemEnv
    from safe_envs.problem.problem import SafetyProblem


def full_id(env_id: str) -> str:
    """Return the registered id, which may be given without its namespace.

    Raises:
        ConfigurationError: there is no such id, or it is no text.
    """
    if not isinstance(env_id, str):
        raise ConfigurationError(f"env_id = {shown(env_id)}; give the id of an env as text")
    candidates = (env_id, f"safe_envs/{env_id}")
    # Gymnasium takes longer to import than all that a command needs up to here, and before it is
    # imported nobody has an env of their own under the short name.
    if sys.modules.get("gymnasium") is None:
        for candidate in candidates:
            if candidate in ENV_IDS:
                return candidate
    import gymnasium as gym

    for candidate in candidates:
        if candidate in gym.registry:
            return candidate
    name = env_id if "/" in env_id else f"safe_envs/{env_id.removesuffix('-v0')}-v0"
    raise ConfigurationError(
        f"unknown env {shown(env_id)}; {nearest(name, ENV_IDS, '`safe-envs list` shows all')}"
    )


def which_env(env_id: str | None, system: str | None) -> str:
    """Return the id of a registered env, or the one that stands for systems from outside.

    Args:
        env_id: registered id, if one was given.
        system: place of a system, if one was given: FILE.py:NAME.

    Raises:
        ConfigurationError: there is no such id, or not just one of the two was given.
    """
    if (env_id is None) == (system is None):
        what = "neither is there" if env_id is None else f"both are there, {env_id} and {system}"
        raise ConfigurationError(
            f"name an env by ENV_ID, or a system of your own by --system FILE.py:NAME; {what}"
        )
    return CUSTOM_ID if env_id is None else full_id(env_id)


def title_of(env_id: str, options: Mapping[str, Any]) -> str:
    """Return how results call an env: its id, or the place of a system from outside.

    Args:
        env_id: registered id.
        options: by which its problem was made.
    """
    return options.get("system") or env_id


def env_class(env_id: str) -> type[SystemEnv]:
    """Return the class of a registered env.

    Raises:
        ConfigurationError: The id is unknown or not of this project.
    """
    import gymnasium as gym
    from gymnasium.envs.registration import load_env_creator

    from safe_envs.envs.registered import SystemEnv

    entry_point = gym.spec(full_id(env_id)).entry_point
    creator = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    if not (isinstance(creator, type) and issubclass(creator, SystemEnv)):
        raise _not_own(env_id)
    return creator


def require_own(env_id: str) -> None:
    """Raise ConfigurationError for an env of Gymnasium itself; nothing else is imported.

    Args:
        env_id: registered id.
    """
    import gymnasium as gym

    entry_point = gym.spec(env_id).entry_point
    if isinstance(entry_point, str) and entry_point.startswith("gymnasium."):
        raise _not_own(env_id)


def _not_own(env_id: str) -> ConfigurationError:
    return ConfigurationError(
        f"{env_id} is not one of this project's envs. `safe-envs evaluate {env_id} --filter-spec"
        " FILE.py:NAME` puts a filter over any env of Gymnasium. For the envs of this project:"
        f" `safe-envs list`, such as {ENV_IDS[0]}"
    )


def make_problem(env_id: str, **options: Any) -> SafetyProblem:
    """Return the problem of a registered env, without making the env.

    Args:
        env_id: registered id.
        **options: fields of `safe_envs.problem.options.ProblemOptions`, arguments of the barrier by
            themselves, and `system` for the id "safe_envs/Custom-v0". Those that are None are left
            out.

    Raises:
        ConfigurationError: The id is unknown or not of this project, or an option is not allowed.
    """
    import gymnasium as gym

    found = env_class(env_id)
    if options.get("max_episode_steps") is not None:
        raise ConfigurationError(
            "max_episode_steps is not part of a problem; shorten its episodes by horizon"
        )
    if options.get("terminate_on_violation"):
        raise ConfigurationError(
            "terminate_on_violation is not part of a problem; give it to gym.make or make_sb3_env"
        )
    given = {name: value for name, value in options.items() if value is not None}
    return found.make_problem(**{**gym.spec(full_id(env_id)).kwargs, **given})
