"""The functions of wrappers of observations and of actions, for batches."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array

from safe_envs.agents.policies.observations import arrays_of, each
from safe_envs.agents.policies.trained import Map
from safe_envs.errors import ConfigurationError, shortened

WAY_OUT = (
    "give a function of observations that does what it did, or model.policy, which plays the"
    " network on the env's own observations and actions"
)
"""What to do where a wrapper cannot be taken up, to end a message with."""


def remembers(layer: Any, num_envs: int) -> bool:
    """Return whether a wrapper is more than the function that its base class asks for.

    Args:
        layer: a wrapper of observations or of actions.
        num_envs: of the training, each with a wrapper of its own.
    """
    kind, base = type(layer), gym.ObservationWrapper
    base = base if isinstance(layer, base) else gym.ActionWrapper
    own_statistics = hasattr(layer, "update_running_mean") and num_envs > 1
    drawn = isinstance(layer, gym.wrappers.AddRenderObservation)
    return kind.step is not base.step or kind.reset is not base.reset or own_statistics or drawn


def function_of(layer: Any, name: str) -> Map:
    """Return the function of a wrapper of observations or of actions, for a batch.

    Args:
        layer: the wrapper.
        name: of its method, "observation" or "action".

    Raises:
        ConfigurationError: It is no function: it is random, remembers, or looks at the env.
    """
    given, made = getattr(layer.env, f"{name}_space"), getattr(layer, f"{name}_space")
    if name == "action":
        given, made = made, given
    try:
        found = _of_rows(getattr(_apart(layer), name), made)
        sampled = copy.deepcopy(given)
        sampled.seed(0)
        one, other = sampled.sample(), sampled.sample()
        rows = concatenate(given, [one, other, one], create_empty_array(given, 3))
        answers = arrays_of(found(rows))
        same = all(np.array_equal(a[0], a[2], equal_nan=a.dtype.kind == "f") for a in answers)
    except Exception as error:
        raise _no_function(layer, f" ({type(error).__name__}: {shortened(error)})") from error
    if not same:
        raise _no_function(layer, "")
    return found


def _no_function(layer: Any, reason: str) -> ConfigurationError:
    return ConfigurationError(
        f"the policy was trained behind {type(layer).__name__}, which is no function of what it is"
        f" given alone{reason}; {WAY_OUT}"
    )


def _of_rows(function: Callable[[Any], Any], space: gym.Space[Any]) -> Map:
    """Return a function of a batch from one of its rows, whose values are of a space."""

    def of_batch(rows: Any) -> Any:
        count = len(arrays_of(rows)[0])
        values = [function(each(lambda array, i=i: array[i], rows)) for i in range(count)]
        return concatenate(space, values, create_empty_array(space, count))

    return of_batch


class _Below(gym.Env[Any, Any]):
    """An env of which only the spaces are known, so that nobody can look at more."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.observation_space, self.action_space = env.observation_space, env.action_space


def _apart(layer: Any) -> Any:
    """Return a copy of a wrapper over an env of which only the spaces are known.

    What the training goes on with stays as it is.
    """
    twin, below = copy.copy(layer), _Below(layer.env)
    memo, env = {id(layer.unwrapped): below}, layer.env
    while isinstance(env, gym.Wrapper):
        memo[id(env)], env = below, env.env
    own = {key: value for key, value in vars(layer).items() if key != "env"}
    vars(twin).update(copy.deepcopy(own, memo))
    twin.env = below
    if hasattr(twin, "update_running_mean"):
        twin.update_running_mean = False
    return twin
