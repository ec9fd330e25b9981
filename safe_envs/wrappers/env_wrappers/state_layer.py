"""The layer of an env from which a filter reads the state, or an estimator what is measured."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker

from safe_envs.envs.env import SafeEnv
from safe_envs.errors import ConfigurationError


def state_layer(
    env: Any, kinds: tuple[type, ...], vector: bool, wrapper: str = "SafetyFilter"
) -> Any:
    """Return the layer of an env from which a wrapper reads the state.

    Args:
        env: an env, possibly wrapped.
        kinds: classes of layers that show the state.
        vector: whether the wrapper is for a batch.
        wrapper: name of its class, for messages: without "Wrapper" or "VectorWrapper".

    Raises:
        ConfigurationError: There is none.
    """
    layer = env
    while isinstance(layer, gym.Wrapper | gym.vector.VectorWrapper) and not isinstance(
        layer, kinds
    ):
        layer = layer.env
    if not isinstance(layer, kinds):
        raise _unreadable(layer, vector, wrapper)
    return layer


def _unreadable(env: Any, vector: bool, wrapper: str) -> ConfigurationError:
    if isinstance(env, gym.vector.VectorEnv) != vector:
        kind, other = ("single", "") if vector else ("vector", "Vector")
        return ConfigurationError(f"{env} is a {kind} env; put {wrapper}{other}Wrapper over it")
    if vector and any(isinstance(each.unwrapped, SafeEnv) for each in getattr(env, "envs", [])):
        return ConfigurationError(
            f"{env} holds envs of this project one by one; make them by gym.make_vec, which is many"
            " times faster too"
        )
    if wrapper == "StateEstimator":
        return ConfigurationError(
            f"{env} is not one of this project's envs, which alone have the option measurement;"
            " take filter_measurement of a SafetyFilter with an estimator"
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
