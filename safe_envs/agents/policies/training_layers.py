"""What lay between a model of Stable-Baselines3 and the env that it was trained on.

A model knows its env, if it has one: the layers of normalisation, rescaling and the like through
which it saw it. Each of them is taken up as a function of observations or of actions, or refused.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.agents.policies.base import Spaces
from safe_envs.agents.policies.trained import Map
from safe_envs.agents.policies.wrapper_functions import WAY_OUT, function_of, remembers
from safe_envs.errors import ConfigurationError, SystemDefinitionWarning
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import StateEstimatorVectorWrapper, StateEstimatorWrapper
from safe_envs.wrappers.env_wrappers.layers_below import CHANGING, passes_on

_OF_OWN = ("problem", "physical_action", "episode")
"""Attributes by which an env of this project is known where it is out of reach."""


class Normalizer:
    """What a VecNormalize does to observations, with its statistics at one time.

    Attributes:
        norm_obs: True.
        obs_rms: the means and variances, by key where the observations have keys.
        clip_obs: bound of the result.
        epsilon: added to the variances.

    Args:
        wrapper: a VecNormalize of observations.
    """

    norm_obs = True

    def __init__(self, wrapper: Any) -> None:
        self.obs_rms = copy.deepcopy(wrapper.obs_rms)
        self.clip_obs, self.epsilon = wrapper.clip_obs, wrapper.epsilon

    def __call__(self, rows: Any) -> Any:
        """Normalise a batch of observations."""
        if not isinstance(self.obs_rms, dict):
            return self._scaled(rows, self.obs_rms)
        scaled = {key: self._scaled(rows[key], moments) for key, moments in self.obs_rms.items()}
        return {**rows, **scaled}

    def _scaled(self, rows: np.ndarray, moments: Any) -> np.ndarray:
        found = (rows - moments.mean) / np.sqrt(moments.var + self.epsilon)
        return np.clip(found, -self.clip_obs, self.clip_obs).astype(np.float32)


@dataclass
class TrainingLayers:
    """What lay between a model and its env.

    Attributes:
        spaces: of the observations and the actions of the env, below all layers.
        observe: from the env's observations to the model's.
        act: from the model's actions to the env's.
        problem: of the env, if it is one of this project.
        spec: that Gymnasium made the env of, if it did.
    """

    spaces: Spaces
    observe: list[Map] = field(default_factory=list)
    act: list[Map] = field(default_factory=list)
    problem: SafetyProblem | None = None
    spec: Any = None


def training_layers(model: Any, env_id: str, normalization: Any = None) -> TrainingLayers:
    """Return what lay between a model and the env of its training, as far as the model knows.

    Args:
        model: an algorithm or a policy of Stable-Baselines3.
        env_id: of the third-party env that it is to act in, whose own wrappers belong to it; the
            name of the problem for others.
        normalization: the VecNormalize of its training, in place of that of the model's env.

    Raises:
        ConfigurationError: A layer cannot be taken up, or the statistics of the training are
            missing.
    """
    found = TrainingLayers((model.observation_space, model.action_space))
    envs = model.get_env() if callable(getattr(model, "get_env", None)) else None
    if envs is not None:
        _look_through(envs, env_id, found)
    if normalization is not None:
        found.observe = [each for each in found.observe if not isinstance(each, Normalizer)]
        found.observe += [Normalizer(normalization)] if normalization.norm_obs else []
        return found
    # What has learned on the envs that it has now is of these.
    unknown = envs is None or (model._last_obs is None and model.get_vec_normalize_env() is None)
    if unknown and saw_normalized(vars(model)):
        raise missing_statistics(f"the policy of {type(model).__name__}")
    return found


def saw_normalized(saved: Mapping[str, Any]) -> bool | None:
    """Return whether a model learned on a VecNormalize; None where that is unknown.

    On-policy algorithms keep an observation as it was before, if it was normalised; off-policy ones
    keep one in any case.

    Args:
        saved: attributes of the model by name.
    """
    if "replay_buffer_class" in saved or not saved.get("num_timesteps"):
        return None
    return saved.get("_last_original_obs") is not None


def missing_statistics(what: str) -> ConfigurationError:
    """Return the error of a policy whose normalisation of observations is unknown.

    Args:
        what: the policy is, to begin the message with.
    """
    return ConfigurationError(
        f"{what} was trained on VecNormalize, and the statistics of that are not at hand: save"
        " model.get_vec_normalize_env() as vecnormalize.pkl next to the .zip, or load the model"
        " with env=VecNormalize.load(...), or save both by"
        " safe_envs.agents.policies.network.save_policy(model, folder, problem, normalization)."
        " Where it normalised rewards alone, these files say so"
    )


def _look_through(envs: Any, env_id: str, found: TrainingLayers) -> None:
    """Take up the layers of envs of Stable-Baselines3, from the outermost on."""
    from stable_baselines3.common import vec_env as sb3

    plain = (sb3.VecMonitor, sb3.VecCheckNan, sb3.VecVideoRecorder, sb3.VecTransposeImage)
    observe: list[Map] = []
    layer: Any = envs
    while isinstance(layer, sb3.VecEnvWrapper):
        if isinstance(layer, sb3.VecNormalize):
            observe += [Normalizer(layer)] if layer.norm_obs else []
        elif isinstance(layer, sb3.VecExtractDictObs):
            observe.append(lambda rows, key=layer.key: rows[key])
        elif type(layer) not in plain:
            _require_harmless(layer, layer.venv)
        layer = layer.venv
    found.spaces = layer.observation_space, layer.action_space
    if isinstance(layer, sb3.DummyVecEnv):
        _look_at(layer.envs, env_id, found, observe)
    elif isinstance(getattr(layer, "env", None), gym.vector.VectorEnv):
        _look_at_batch(layer.env, found)
    else:
        _ask(layer, env_id, found)
    found.observe = observe[::-1]


def _look_at(
    envs: list[gym.Env[Any, Any]], env_id: str, found: TrainingLayers, observe: list[Map]
) -> None:
    """Take up the wrappers of single envs, which all of them have."""
    chains = [list(_changing_wrappers(env)) for env in envs]
    if len({tuple(map(type, chain)) for chain in chains}) > 1:
        raise ConfigurationError(
            f"the {len(envs)} envs of the training have different wrappers, so that the policy saw"
            " no single env; give model.policy to play its network alone"
        )
    chain = chains[0]
    kinds = _wrappers_of_id(env_id) if chain else []
    base: Any = _innermost(envs[0])
    while chain and kinds and type(chain[-1]) is kinds[-1]:
        base, _ = chain.pop(), kinds.pop()
    for layer in chain:
        if isinstance(layer, gym.ObservationWrapper) and not remembers(layer, len(envs)):
            observe.append(function_of(layer, "observation"))
        elif isinstance(layer, gym.ActionWrapper) and not remembers(layer, len(envs)):
            found.act.append(function_of(layer, "action"))
        else:
            _require_harmless(layer, layer.env)
    found.spaces = base.observation_space, base.action_space
    found.problem, found.spec = _problem_of(base.unwrapped), base.unwrapped.spec


def _changing_wrappers(env: gym.Env[Any, Any]) -> Iterator[Any]:
    """Yield the wrappers of an env that are not known to leave what it shows and does alone."""
    return (each for each in _wrappers(env) if not (_is_own(each) or passes_on(each)))


def _wrappers(env: gym.Env[Any, Any]) -> Iterator[Any]:
    """Yield the wrappers of an env, down to an estimator: what that shows are observations."""
    while isinstance(env, gym.Wrapper) and not isinstance(env, StateEstimatorWrapper):
        yield env
        env = env.env


def _innermost(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return next((each.env for each in reversed([*_wrappers(env)])), env)


def _wrappers_of_id(env_id: str) -> list[type[Any]]:
    """Return the classes of the wrappers that an id of a third-party env stands for."""
    if env_id not in gym.registry:
        return []
    env = gym.make(env_id)
    found = [type(each) for each in _changing_wrappers(env)]
    env.close()
    return found


def _look_at_batch(env: gym.vector.VectorEnv, found: TrainingLayers) -> None:
    """Look at a vector env of this project, and refuse what changes what is seen of it."""
    layer: Any = env
    while isinstance(layer, gym.vector.VectorWrapper):
        if isinstance(layer, StateEstimatorVectorWrapper):
            break
        if not (_is_own(layer) or passes_on(layer)):
            _require_harmless(layer, layer.env)
        layer = layer.env
    found.problem = _problem_of(layer.unwrapped)


def _ask(envs: Any, env_id: str, found: TrainingLayers) -> None:
    """Ask envs out of reach, mostly of other processes, as far as they answer."""
    try:
        # A process ends if it is asked for what it has not, or cannot send.
        if all(map(envs.has_attr, _OF_OWN)):
            found.problem = envs.get_attr("problem", [0])[0]
        seen = [kind for kind in CHANGING if any(envs.env_is_wrapped(kind, [0]))]
    except Exception:  # such as of processes that have ended, and of envs of other libraries
        return
    own = _wrappers_of_id(env_id) if seen else []
    seen = [kind for kind in seen if not any(issubclass(each, kind) for each in own)]
    if seen:
        raise ConfigurationError(
            f"the policy was trained behind {seen[0].__name__} in another process, out of reach;"
            f" load the model with the same wrappers in a DummyVecEnv, or {WAY_OUT}"
        )


def _problem_of(env: Any) -> SafetyProblem | None:
    found = getattr(env, "problem", None)
    return found if isinstance(found, SafetyProblem) else None


def _is_own(layer: Any) -> bool:
    """Whether a layer is this project's, and leaves the spaces as they are."""
    return type(layer).__module__.startswith("safe_envs.") and _keeps_spaces(layer, layer.env)


def _keeps_spaces(layer: Any, below: Any) -> bool:
    return (
        layer.observation_space == below.observation_space
        and layer.action_space == below.action_space
    )


def _require_harmless(layer: Any, below: Any) -> None:
    """Refuse a layer that changes what a policy sees or does, and warn of one that may."""
    name = type(layer).__name__
    if isinstance(layer, CHANGING) or not _keeps_spaces(layer, below):
        raise ConfigurationError(
            f"the policy was trained behind {name}, which is more than a function of one"
            f" observation or of one action, and is not there in an evaluation; {WAY_OUT}"
        )
    warnings.warn(
        f"the policy was trained behind {name}, which is not there in an evaluation: if it changes"
        f" observations or actions, {WAY_OUT}",
        SystemDefinitionWarning,
        stacklevel=2,
    )
