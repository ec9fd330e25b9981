"""Wrappers between a filter and a third-party env, which can make what it computes false."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
from gymnasium import wrappers
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, vector

from safe_envs.envs.env import SafeEnv
from safe_envs.errors import ConfigurationError, SystemDefinitionWarning

_SEE = (
    gym.ObservationWrapper,
    gym.vector.VectorObservationWrapper,
    wrappers.NormalizeObservation,
    wrappers.FrameStackObservation,
    wrappers.MaxAndSkipObservation,
)
_ACT = (gym.ActionWrapper, gym.vector.VectorActionWrapper)
_REPEAT = tuple(
    # Gymnasium has the one since 1.3.
    getattr(wrappers, name)
    for name in ("MaxAndSkipObservation", "RepeatAction", "AtariPreprocessing")
    if hasattr(wrappers, name)
)
CHANGING = (*_SEE, *_ACT, *_REPEAT)
"""Wrappers that change what is seen of an env, or done in it."""

_PASS_ON = frozenset(
    f"{layer.step.__module__}.{layer.step.__qualname__}"
    for layer in (
        gym.Wrapper,
        gym.RewardWrapper,
        *(wrappers.TimeLimit, wrappers.OrderEnforcing, wrappers.PassiveEnvChecker),
        *(wrappers.RecordEpisodeStatistics, wrappers.NormalizeReward),
        *(wrappers.RecordVideo, wrappers.RenderCollection, wrappers.HumanRendering),
        *(gym.vector.VectorWrapper, gym.vector.VectorRewardWrapper),
        *(vector.RecordEpisodeStatistics, vector.NormalizeReward),
        *(vector.RecordVideo, vector.HumanRendering),
    )
) | {"stable_baselines3.common.monitor.Monitor.step"}
"""Steps that pass on actions and observations as they are."""


def passes_on(layer: Any) -> bool:
    """Return whether a wrapper is known to pass on actions and observations as they are."""
    step = type(layer).step
    return f"{step.__module__}.{step.__qualname__}" in _PASS_ON


def doubt_layers(env: Any) -> None:
    """Warn of wrappers between a filter and its env that may change what it sees or does.

    Args:
        env: an env or a batch of them, below the filter.

    Raises:
        ConfigurationError: one starts episodes by itself, of which the filter would not know.
    """
    for text in dict.fromkeys(_doubts(env)):
        warnings.warn(text, SystemDefinitionWarning, stacklevel=4)


def _doubts(env: Any) -> Iterator[str]:
    layer = env
    while isinstance(layer, gym.Wrapper | gym.vector.VectorWrapper):
        name = f"{type(layer).__name__} lies between the filter and the env and"
        if isinstance(layer, wrappers.Autoreset):
            raise ConfigurationError(
                f"{name} starts episodes of which the filter does not know; put it around the"
                " filter, or leave it out"
            )
        doubt = _doubt(layer)
        if doubt:
            yield (
                f"{name} {doubt}, the filter keeps something else safe. Put wrappers around"
                " the filter"
            )
        layer = layer.env
    for each in getattr(layer, "envs", []):
        yield from _doubts(each)
    # The envs of other processes are out of reach.
    if isinstance(layer, gym.vector.AsyncVectorEnv):
        one = layer.env_fns[0]()
        yield from _doubts(one)
        one.close()


def _doubt(layer: Any) -> str | None:
    """Return what a wrapper does, and on what condition that does not matter."""
    kind, below = "single_" if isinstance(layer, gym.vector.VectorWrapper) else "", layer.env
    found = {
        "changes observations": ("state_fn undoes that", _SEE, "observation_space"),
        "changes actions": ("action_map undoes that", _ACT, "action_space"),
        "repeats actions": ("dt is the time of all repetitions", _REPEAT, None),
    }
    does, unless = [], []
    for what, (condition, kinds, space) in found.items():
        differs = space and getattr(layer, kind + space) != getattr(below, kind + space)
        if isinstance(layer, kinds) or differs:
            does.append(what)
            unless.append(condition)
    if does:
        return f"{' and '.join(does)}: unless {' and '.join(unless)}"
    if passes_on(layer):
        return None
    return "has a step of its own: if that repeats or changes actions, or changes observations"


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
