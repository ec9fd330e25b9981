"""When vector envs start their next episodes."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode

from safe_envs.errors import ConfigurationError


def autoreset_mode(env: gym.vector.VectorEnv[Any, Any, Any]) -> AutoresetMode:
    """Return how a vector env resets.

    Args:
        env: whose metadata says it.

    Raises:
        ConfigurationError: it does not say so.
    """
    try:
        return AutoresetMode(env.metadata.get("autoreset_mode"))
    except ValueError as error:
        raise ConfigurationError(
            f"{env} does not say when it resets: its metadata has no autoreset_mode of Gymnasium"
        ) from error
