"""The native vector env for Stable-Baselines3: its `VecEnv`, filtered or bare, without a loop over
the envs.

This module imports Stable-Baselines3, and with it torch.
"""

from __future__ import annotations

import math
import numbers
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvStepReturn

from safe_envs.agents.evaluation.evaluate import BARE
from safe_envs.agents.training.lazy_info import LazyInfo
from safe_envs.envs.info import Info
from safe_envs.envs.simulation import center_and_half_width
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError, require_whole
from safe_envs.registry import env_class, full_id
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper
from safe_envs.wrappers.conditions import Condition

_TRUNCATED = "TimeLimit.truncated"
_TAKEN_OFF = "intervention_penalty"
_OF_ONE_ENV = {
    "observation_space": "single_observation_space",
    "action_space": "single_action_space",
}
_TUPLES_OF_ENVS = ("np_random", "np_random_seed")
_OF_THE_BATCH = ("reset", "step", "step_physical", "close")

Filter = Condition | Sequence[Condition] | str | None


def make_sb3_env(
    env_id: str,
    num_envs: int = 8,
    filter: Filter = None,  # noqa: A002  (the word of the whole project)
    *,
    knowledge: str = "model",
    objective: str = "nearest",
    intervention_penalty: float = 0.0,
    seed: int | None = None,
    **options: Any,
) -> SafeVecEnv:
    """Make the `VecEnv` of a registered env for the algorithms of Stable-Baselines3.

    Args:
        env_id: registered id, with or without its namespace.
        num_envs: size of the batch.
        filter: a `Condition` for every barrier, one for each, or their text; None or "none" for the
            bare env.
        knowledge: what the filter knows; see `SafetyFilterWrapper`.
        objective: of the filter; see `SafetyFilterWrapper`.
        intervention_penalty: see `SafeVecEnv`.
        seed: env i is seeded by seed + i at its first reset; an algorithm's own `seed` comes later
            and replaces it.
        **options: arguments of `gym.make`; those that are None are left out.

    Raises:
        ConfigurationError: an id, a filter or an argument is unknown or out of range.
        RelativeDegreeError: the filter does not suit the env's barrier.
    """
    require_whole("num_envs", num_envs, 1)
    if seed is not None:
        require_whole("seed", seed, 0)
    given = {key: value for key, value in options.items() if value is not None}
    # This refuses ids of other projects, whose vector envs take other arguments.
    env_class(env_id)
    env = gym.make_vec(
        full_id(env_id),
        int(num_envs),
        "vector_entry_point",
        autoreset_mode=AutoresetMode.SAME_STEP.value,
        **given,
    )
    if filter is not None and filter != BARE:
        env = SafetyFilterVectorWrapper(env, filter, knowledge, objective)
    result = SafeVecEnv(env, intervention_penalty)
    if seed is not None:
        result.seed(int(seed))
    return result


class SafeVecEnv(VecEnv):
    """What DummyVecEnv does over the scalar envs, done by the native vector env.

    The infos are `LazyInfo`s: their entries are made when they are read. The info of an env that is
    done shows the last step of its episode, with "terminal_observation"; "TimeLimit.truncated" says
    whether only time ended it. Options of `set_options` are used up by `reset` and change nothing,
    as with the scalar envs, which have none.

    The algorithms learn on the action that the policy proposed, and on-policy ones have to: they
    see a filter only through the transition, in which all proposals that it corrects to the same
    action look alike. So nothing draws the policy away from proposals that need correction, unless
    a penalty does. What it takes off a reward is in the infos as "intervention_penalty", float64 of
    shape (num_envs,) in `batch_info`; zeros at reset, and no such key if c is 0.
    `safe_envs.agents.training.replay_buffer` stores executed actions with the reward before the
    penalty.

    Attributes:
        env: the native vector env, filtered or bare.
        batch_info: arrays by key of the last step or reset, with the batch in front; envs that are
            done have those of the last step of their episode.

    Args:
        env: with same-step reset.
        intervention_penalty: c >= 0; the reward is reduced by c |u_safe - u_nominal|, the Euclidean
            distance of `info`'s actions in units of the half widths of the box.

    Raises:
        ConfigurationError: the env is another one, or resets otherwise; or the penalty is out of
            range, or is given without a filter.
    """

    def __init__(self, env: gym.vector.VectorEnv, intervention_penalty: float = 0.0) -> None:
        if not isinstance(env, SafeVectorEnv | SafetyFilterVectorWrapper):
            raise ConfigurationError(
                f"{env} is neither one of this project's vector envs nor a filter over one; use"
                " make_sb3_env"
            )
        if env.metadata["autoreset_mode"] != AutoresetMode.SAME_STEP:
            raise ConfigurationError(
                f"{env} has autoreset_mode {env.metadata['autoreset_mode'].value!r}; make it with"
                " 'SameStep'"
            )
        _require_penalty(intervention_penalty, isinstance(env, SafetyFilterVectorWrapper))
        self.env = env
        self.batch_info: Info = {}
        self._native: SafeVectorEnv = env.unwrapped  # pyright: ignore[reportAttributeAccessIssue]
        self._penalty = float(intervention_penalty)
        self._half = np.array(center_and_half_width(self._native.problem)[1])
        self._actions = np.empty(0)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        # Stable-Baselines3 lists the modes that this very env can be shown in, Gymnasium those that
        # it could be made with.
        self.metadata = {**env.metadata, "render_modes": self.metadata["render_modes"]}

    def reset(self) -> np.ndarray:
        """Start an episode in every env, with the seeds of `seed` if they were not used yet.

        Returns:
            Observations, float32 of shape (num_envs, n); the infos are in `reset_infos`.
        """
        observation, info = self.env.reset(seed=self._seeds)
        self._reset_seeds()
        self._reset_options()
        self.batch_info = self._at_rest(info)
        self.reset_infos = self._infos(self.batch_info)
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions in [-1, 1], shape (num_envs, m), for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Hold the actions for one control period, and start a new episode in each env that is
        done.

        Returns:
            Observations, float32 (num_envs, n); rewards, float32 (num_envs,); dones, bool
            (num_envs,); a dict for each env.

        Raises:
            InvalidInputError: the actions have another shape or are not finite.
            NumericalError: the state of an env is not finite any more.
        """
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        dones = terminated | truncated
        ended = dones.nonzero()[0].tolist()
        # The native env leaves whole arrays in `final_info`, with the envs that go on.
        batch = _arrays(info["final_info"] if ended else info)
        batch[_TRUNCATED] = truncated & ~terminated
        self.batch_info = batch
        if self._penalty:
            distance = np.linalg.norm(
                (batch["safe_action"] - batch["nominal_action"]) / self._half, axis=1
            )
            batch[_TAKEN_OFF] = self._penalty * distance
            reward = reward - batch[_TAKEN_OFF]
        infos = self._infos(batch)
        if ended:
            restarted = self._at_rest(info)
            for i in ended:
                infos[i]["terminal_observation"] = info["final_obs"][i].copy()
                self.reset_infos[i] = LazyInfo(restarted, i)
        return observation, reward.astype(np.float32), dones, infos

    def snapshot(self) -> dict[str, np.ndarray]:
        """Where each episode stands; see `SafeVectorEnv.snapshot`."""
        return self.env.snapshot()  # pyright: ignore[reportAttributeAccessIssue]

    def restore(self, snapshot: Mapping[str, np.ndarray], seed: int) -> None:
        """Put each episode where a snapshot has it; see `SafeVectorEnv.restore`."""
        self.env.restore(snapshot, seed)  # pyright: ignore[reportAttributeAccessIssue]

    def close(self) -> None:
        """Close the native env."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return a picture of each env, None for each where the render mode is not "rgb_array"."""
        if self.render_mode != "rgb_array":
            warnings.warn(
                f"render_mode = {self.render_mode!r}, so that there are no images; make the env"
                " with 'rgb_array'",
                stacklevel=2,
            )
            return [None] * self.num_envs
        pictures: Any = self.env.render()
        return list(pictures)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the filter's wrapper or else of the native env, for each env.

        Each env gets its row of an array with the batch in front, like `state`, or of each array in
        a tuple or list of them, like `executed`, and its own spaces and generator; of anything
        else, all get the same object.

        Raises:
            AttributeError: neither has it.
        """
        value = self._find(_OF_ONE_ENV.get(attr_name, attr_name))
        if attr_name in _TUPLES_OF_ENVS:
            return [value[i] for i in self._get_indices(indices)]
        return self._for_each(value, indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute where it is found, or else on the native env, for all envs.

        Raises:
            AttributeError: it is a property that cannot be set.
            ConfigurationError: some envs are left out, which share their attributes with the
                others.
        """
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ConfigurationError(
                f"{attr_name!r} is shared by all {self.num_envs} envs; set it without indices, or"
                " make another VecEnv"
            )
        holder = next((layer for layer in self._layers() if attr_name in vars(layer)), self._native)
        setattr(holder, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the filter's wrapper or else of the native env, once for the whole
        batch.

        Its arguments have the batch in front, and its result is handed out as by `get_attr`; of
        `render`, each env gets its picture.

        Raises:
            AttributeError: neither has it.
            ConfigurationError: the method moves the envs on, which is for this class to do.
        """
        # Gymnasium has these two for single envs only.
        if method_name == "get_wrapper_attr":
            return self.get_attr(*method_args, indices=indices)
        if method_name == "has_wrapper_attr":
            return [self.has_attr(*method_args) for _ in self._get_indices(indices)]
        if method_name in _OF_THE_BATCH:
            raise ConfigurationError(
                f"env_method does not call {method_name!r}, which acts on all envs at once; call"
                " that of the VecEnv"
            )
        result = self._find(method_name)(*method_args, **method_kwargs)
        if method_name == "render" and result is not None:
            return [result[i] for i in self._get_indices(indices)]
        return self._for_each(result, indices)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Say for each env whether it is in such a wrapper; `SafetyFilterWrapper` stands for that
        of vector envs as well."""
        wanted = (
            SafetyFilterVectorWrapper if wrapper_class is SafetyFilterWrapper else wrapper_class
        )
        wrapped = any(isinstance(layer, wanted) for layer in self._layers())
        return [wrapped for _ in self._get_indices(indices)]

    def _at_rest(self, info: Info) -> Info:
        """What the envs report at reset, where nothing was taken off a reward yet."""
        batch = _arrays(info)
        if self._penalty:
            batch[_TAKEN_OFF] = np.zeros(self.num_envs)
        return batch

    def _infos(self, batch: Info) -> list[dict[str, Any]]:
        return [LazyInfo(batch, i) for i in range(self.num_envs)]

    def _layers(self) -> Iterator[gym.vector.VectorEnv]:
        layer: gym.vector.VectorEnv = self.env
        while isinstance(layer, gym.vector.VectorWrapper):
            yield layer
            layer = layer.env
        yield layer

    def _find(self, name: str) -> Any:
        for layer in self._layers():
            try:
                return getattr(layer, name)
            except AttributeError:
                continue
        raise AttributeError(f"neither {self.env} nor what it wraps has an attribute {name!r}")

    def _for_each(self, value: Any, indices: VecEnvIndices) -> list[Any]:
        envs = self._get_indices(indices)
        if self._batched(value):
            return [value[i].copy() for i in envs]
        if isinstance(value, tuple | list) and value and all(map(self._batched, value)):
            kind = tuple if isinstance(value, tuple) else list
            return [kind([v[i].copy() if v.ndim > 1 else v.item(i) for v in value]) for i in envs]
        return [value for _ in envs]

    def _batched(self, value: Any) -> bool:
        return isinstance(value, np.ndarray) and value.shape[:1] == (self.num_envs,)


def _require_penalty(penalty: Any, filtered: bool) -> None:
    if not isinstance(penalty, numbers.Real) or not 0.0 <= float(penalty) < math.inf:
        raise ConfigurationError(f"intervention_penalty = {penalty!r}; give a finite number from 0")
    if penalty and not filtered:
        raise ConfigurationError(
            f"intervention_penalty = {penalty!r} without a filter, which alone intervenes; give a"
            " filter, or 0"
        )


def _arrays(info: Info) -> Info:
    """What a vector env reported of each env, without Gymnasium's masks."""
    return {key: info[key] for key in _of_arrays(tuple(info))}


@lru_cache(maxsize=64)
def _of_arrays(keys: tuple[str, ...]) -> tuple[str, ...]:
    return tuple([key for key in keys if not key.startswith(("_", "final_"))])
