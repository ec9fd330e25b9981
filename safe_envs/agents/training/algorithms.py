"""The algorithms of Stable-Baselines3, made from hyperparameters of the RL Zoo."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from safe_envs.agents.policies.sb3 import actor_of
from safe_envs.agents.training.hyperparameters import OFF_POLICY, python_value, scheduled
from safe_envs.agents.training.replay_buffer import replay_options
from safe_envs.errors import ConfigurationError, SafeEnvsError, nearest, shown
from safe_envs.problem.problem import SafetyProblem

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

MOST_SHOWN = 1000
"""Characters of hyperparameters, or of errors about them, at most, that a message repeats."""

_GIVEN = ("self", "env", "seed", "device", "_init_setup_model")
_IN_PYTHON = ("normalize", "policy_kwargs", "replay_buffer_kwargs")
"""Hyperparameters that the RL Zoo writes as texts in Python."""

_OF_THE_LIMIT = ("cost_limit", "cost_unit")
_OF_THE_ENV = ("normalize",)
_OF_THE_NOISE = ("noise_type", "noise_std")
_OF_THE_BUFFER = ("replay_buffer_class", "replay_buffer_kwargs")


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """Return the class of an algorithm.

    Args:
        name: one of `safe_envs.agents.training.hyperparameters.ALGORITHMS`.
    """
    if name == "ppo-lag":
        from safe_envs.agents.training.ppo_lagrangian import PPOLagrangian

        return PPOLagrangian
    if name == "sac-lag":
        from safe_envs.agents.training.sac_lagrangian import SACLagrangian

        return SACLagrangian
    import stable_baselines3

    return getattr(stable_baselines3, name.upper())


def new_model(
    name: str,
    envs: VecEnv,
    problem: SafetyProblem,
    settings: Mapping[str, Any],
    action: str | None,
    seed: int,
    constraint: Mapping[str, float] | None = None,
) -> BaseAlgorithm:
    """Make an untrained algorithm, whose `get_env()` is `envs`, normalised if the settings say so.

    Args:
        name: see `algorithm_class`.
        envs: on which it learns.
        problem: of the envs.
        settings: hyperparameters of the algorithm, and `normalize`, `noise_type` and `noise_std`.
        action: on which an off-policy algorithm learns with a filter in the loop; None without a
            filter, or on-policy.
        seed: of the algorithm.
        constraint: `Training.constraint`.

    Raises:
        ConfigurationError: the algorithm does not take these settings, or its policy cannot be
            saved as numbers.
    """
    # Stable-Baselines3 writes into what it is given.
    left = scheduled(copy.deepcopy(dict(settings)))
    _require_known(name, left)
    try:
        for key in _IN_PYTHON:
            if isinstance(left.get(key), str):
                left[key] = python_value(key, left[key])
        envs = _normalized(envs, left.pop("normalize", False), left.get("gamma", 0.99))
        left |= _action_noise(
            left.pop("noise_type", None), left.pop("noise_std", None), problem.plant.m
        )
        if action is not None:
            left |= _replay(problem, action, left)
        if isinstance(left.get("train_freq"), list):
            left["train_freq"] = tuple(left["train_freq"])
        left |= constraint or {}
        model: Any = algorithm_class(name)(env=envs, seed=seed, device="cpu", **left)
    except SafeEnvsError:
        raise
    except Exception as error:  # What a hyperparameter may raise has no limits.
        raise ConfigurationError(
            f"{name} does not take these hyperparameters: {str(error)[:MOST_SHOWN]}; they are"
            f" {str(settings)[:MOST_SHOWN]}"
        ) from error
    # Better now than when the first checkpoint is written.
    actor_of(model.policy)
    return model


def _require_known(name: str, settings: Mapping[str, Any]) -> None:
    parameters = _parameters(algorithm_class(name))
    allowed = [key for key in parameters if key not in (*_GIVEN, *_OF_THE_LIMIT)]
    allowed += [*_OF_THE_ENV, *(_OF_THE_NOISE if name in OFF_POLICY else ())]
    for key, value in settings.items():
        if key in _OF_THE_LIMIT and key in parameters:
            raise ConfigurationError(
                f"{shown(key)} is no hyperparameter; give the limit by --cost-limit, or by"
                " --violation-limit"
            )
        if key not in allowed:
            raise ConfigurationError(
                f"{name} does not take the hyperparameter {shown(key)}; {nearest(key, allowed)}"
            )
        # Stable-Baselines3 would only fail after the first rollout.
        if (
            isinstance(value, str)
            and key in parameters
            and type(parameters[key].default) in (int, float)
        ):
            raise ConfigurationError(f"{key} = {shown(value)}; give a number")


def _parameters(kind: type[BaseAlgorithm]) -> dict[str, inspect.Parameter]:
    """Return the parameters of an algorithm by name, and those that it passes on to its base."""
    found = dict(inspect.signature(kind).parameters)
    passed_on = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    named = {key: value for key, value in found.items() if value.kind not in passed_on}
    return named if named.keys() == found.keys() else {**_parameters(kind.__mro__[1]), **named}


def _normalized(envs: VecEnv, normalize: Any, gamma: float) -> VecEnv:
    """Return the envs, in a VecNormalize if the Zoo's `normalize` asks for it."""
    if normalize is False or normalize is None:
        return envs
    if normalize is not True and not isinstance(normalize, Mapping):
        raise ConfigurationError(
            f"normalize = {normalize!r}; give true, false, or a mapping such as {{norm_obs: true,"
            " norm_reward: false}"
        )
    from stable_baselines3.common.vec_env import VecNormalize

    return VecNormalize(envs, **{"gamma": gamma, **({} if normalize is True else normalize)})


def _action_noise(kind: str | None, deviation: float | None, inputs: int) -> dict[str, Any]:
    from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

    kinds = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}
    if kind is None and deviation is None:
        return {}
    if kind not in kinds:
        raise ConfigurationError(f"noise_type = {kind!r}; {nearest(str(kind), kinds)}")
    if deviation is None:
        raise ConfigurationError(f"noise_type = {kind!r} needs noise_std")
    return {"action_noise": kinds[kind](np.zeros(inputs), np.full(inputs, float(deviation)))}


def _replay(problem: SafetyProblem, action: str, settings: dict[str, Any]) -> dict[str, Any]:
    """Move the settings that the replay buffer needs out of the others, and return its own."""
    given = [key for key in _OF_THE_BUFFER if key in settings]
    if given:
        raise ConfigurationError(
            f"{', '.join(given)}: with a filter in the loop the replay buffer is that of --action;"
            " leave it out"
        )
    return replay_options(
        problem, action, n_steps=settings.pop("n_steps", 1), gamma=settings.pop("gamma", 0.99)
    )
