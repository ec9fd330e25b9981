"""The layer of an env from which a filter reads the state."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker

from safe_envs.envs.env import SafeEnv
from safe_envs.errors import ConfigurationError


def state_layer(env: Any, kinds: tuple[type, ...], vector: bool) -> Any:
    """Return the layer of an env from which a filter reads the state.

    Args:
        env: an env, possibly wrapped.
        kinds: classes of layers that show the state.
        vector: whether the filter is for a batch.

    Raises:
        ConfigurationError: There is none.
    """
    layer = env
    while isinstance(layer, gym.Wrapper | gym.vector.VectorWrapper) and not isinstance(
        layer, kinds
    ):
        layer = layer.env
    if not isinstance(layer, kinds):
        raise _unreadable(layer, vector)
    return layer


def _unreadable(env: Any, vector: bool) -> ConfigurationError:
    if isinstance(env, gym.vector.VectorEnv) != vector:
        kind, wrapper = ("single", "") if vector else ("vector", "Vector")
        return ConfigurationError(
            f"{env} is a {kind} env; put SafetyFilter{wrapper}Wrapper over it"
        )
    if vector and any(isinstance(each.unwrapped, SafeEnv) for each in getattr(env, "envs", [])):
        return ConfigurationError(
            f"{env} holds envs of this project one by one; make them by gym.make_vec, which is many"
            " times faster too"
        )
    return ConfigurationError(
        f"{env} is not one of this project's envs, so that a filter cannot read its state; give"
        " model, barriers, state_fn: see FilterSpec"
    )


def only_checks_between(env: gym.Env[Any, Any], inner: Any) -> bool:
    """Return whether no wrapper between a layer and one below can change a step.

    Then its input need not be encoded.

    Args:
        env: what the one layer wraps.
        inner: the other layer.
    """
    while isinstance(env, (OrderEnforcing, PassiveEnvChecker)):
        env = env.env
    return env is inner
