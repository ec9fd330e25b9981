"""Wrappers between a filter and a third-party env, which can make what it computes false."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
from gymnasium import wrappers
from gymnasium.wrappers import vector

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
