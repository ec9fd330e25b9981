"""Policies that were trained elsewhere: a model of Stable-Baselines3, and what lay around it.

A model knows its env, if it has one: the layers of normalisation, rescaling and the like through
which it saw it. Each of them is taken up as a function of observations or of actions, or refused.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array

from safe_envs.agents.policies.base import Policy, Spaces, arrays_of, each, rows_of
from safe_envs.errors import (
    ConfigurationError,
    InvalidInputError,
    SystemDefinitionWarning,
    shortened,
)
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.estimator import StateEstimatorVectorWrapper, StateEstimatorWrapper
from safe_envs.wrappers.layers import CHANGING, passes_on

_BLOCK = 512
"""Observations in a block: a call takes long, and longer with more rows."""

Map = Callable[[Any], Any]
"""From a batch of observations, or of actions, to another one."""


class TrainedPolicy(Policy):
    """A model with Stable-Baselines3's `predict`, asked for its deterministic action.

    It is called with blocks of the same number of rows, see `BlockPolicy`. A recurrent model keeps
    its memory in the hidden state that `predict` returns.

    Args:
        model: whose `predict` is called.
        space: of one observation of the env that it acts in.
        observe: what lay between that env and the model, from the env on.
        act: what the model's actions went through, from the model on.
    """

    _offset = 0

    def __init__(
        self,
        model: Any,
        space: gym.Space[Any],
        observe: Sequence[Map] = (),
        act: Sequence[Map] = (),
    ) -> None:
        self.name = type(model).__name__
        self._model, self._space = model, space
        self._observe, self._act = tuple(observe), tuple(act)

    def begin(self, episodes: range, seed: int) -> None:
        """Remember in which row of its block the first episode belongs; see `Policy.begin`."""
        self._offset = episodes.start % _BLOCK

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Choose actions; see `Policy.predict`.

        Raises:
            InvalidInputError: The observation is of another space than that of the env.
        """
        rows, size, is_batch = rows_of(observation, self._space)
        for change in self._observe:
            rows = change(rows)
        end = self._offset + size
        blocks = -(-end // _BLOCK)
        # Any observation would do in the other rows; zeros may be none.
        places = np.clip(np.arange(blocks * _BLOCK) - self._offset, 0, size - 1)
        starts = np.zeros(size, dtype=bool) if episode_start is None else np.asarray(episode_start)
        memories = state if isinstance(state, _Memories) else [None] * blocks
        if len(memories) != blocks:
            raise InvalidInputError(
                f"the hidden state is of {len(memories)} blocks of observations, and the"
                f" observations are {blocks}; give None at the beginning of each batch"
            )
        found, kept = [], _Memories()
        for k, memory in enumerate(memories):
            part = places[k * _BLOCK : (k + 1) * _BLOCK]
            block = each(lambda array, part=part: array[part], rows)
            actions, memory = self._model.predict(block, memory, starts[part], deterministic=True)
            found.append(actions)
            kept.append(memory)
        actions: Any = np.concatenate(found)[self._offset : end]
        for change in self._act:
            actions = change(actions)
        memory = state if all(memory is None for memory in kept) else kept
        return (actions if is_batch else actions[0]), memory


class _Memories(list[Any]):
    """The hidden state of each block."""


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
    """Return a copy of a wrapper over an env of which only the spaces are known."""
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
