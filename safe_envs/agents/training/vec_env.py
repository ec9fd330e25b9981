"""The native vector env, with or without a filter, as a `VecEnv` of Stable-Baselines3."""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from safe_envs.agents.evaluation.spec import UNFILTERED
from safe_envs.agents.training.lazy_info import LazyInfo
from safe_envs.agents.training.native_vec_env import NativeVecEnv
from safe_envs.envs.info import Info
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError, require_whole, shown
from safe_envs.registry import env_class, full_id
from safe_envs.wrappers import SafetyFilterVectorWrapper, StateEstimatorVectorWrapper
from safe_envs.wrappers.conditions import Condition

_TRUNCATED = "TimeLimit.truncated"
_PENALTY = "intervention_penalty"

Filter = Condition | Sequence[Condition] | str | None

_NATIVE = (SafeVectorEnv, SafetyFilterVectorWrapper, StateEstimatorVectorWrapper)


def make_sb3_env(  # noqa: PLR0913  (all but env_id have defaults)
    env_id: str,
    num_envs: int = 8,
    filter: Filter = None,  # noqa: A002  (the word of the whole project)
    *,
    knowledge: str = "model",
    objective: str = "nearest",
    intervention_penalty: float = 0.0,
    seed: int | None = None,
    engine: str = "numpy",
    estimator: str | None = None,
    observe: str = "estimate",
    **options: Any,
) -> SafeVecEnv:
    """Make the `VecEnv` of a registered env for the algorithms of Stable-Baselines3.

    Args:
        env_id: registered id, with or without its namespace.
        num_envs: size of the batch.
        filter: a `Condition` for every barrier, one for each, or their text; None or "none" for the
            unfiltered env.
        knowledge: what the filter knows; see `SafetyFilterWrapper`.
        objective: of the filter; see `SafetyFilterWrapper`.
        intervention_penalty: see `SafeVecEnv`.
        seed: Env i is seeded by seed + i at its first reset; an algorithm's own `seed` comes later
            and replaces it.
        engine: "numpy", "compiled" or "auto"; see `SafeVectorEnv`.
        estimator: of the state, for envs with a `measurement`; see `StateEstimatorWrapper`.
        observe: what the agent sees with an estimator; see there.
        **options: arguments of `gym.make`, also `terminate_on_violation`; those that are None are
            left out.

    Raises:
        ConfigurationError: an id, a filter or an argument is unknown or out of range.
        NotCompilableError: the compiled engine was asked for, and the filter has learned terms
            without a compiled form.
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
        engine=engine,
        **given,
    )
    if estimator is not None:
        env = StateEstimatorVectorWrapper(env, estimator, observe, knowledge)
    if filter is not None and filter != UNFILTERED:
        env = SafetyFilterVectorWrapper(env, filter, knowledge, objective)
    result = SafeVecEnv(env, intervention_penalty)
    if seed is not None:
        result.seed(int(seed))
    return result


class SafeVecEnv(NativeVecEnv):
    """The equivalent of DummyVecEnv over the scalar envs, without a loop over them.

    The infos are `LazyInfo`s: their entries are made when they are read. The info of an env that is
    done describes the last step of its episode, with "terminal_observation";
    "TimeLimit.truncated" tells whether only time ended it. `reset` takes what `set_options` was
    given: the options of `SafeEnv.reset`, in which the envs may differ but for the start's name.

    The algorithms learn on the action that the policy proposed, and on-policy ones have to: they
    see a filter only through the transition, in which all proposals that it corrects to the same
    action look alike. So nothing draws the policy away from proposals that need correction, unless
    a penalty does. Its amount is in the infos as "intervention_penalty", float64 of shape
    (num_envs,) in `batch_info`: zeros at reset, and no such key if c is 0.
    With `replay_buffer_class=FilteredReplayBuffer` SAC, TD3 and DDPG store executed actions, with
    the reward before the penalty; see `safe_envs.agents.training.replay_buffer`.

    Attributes:
        env: the native vector env, with or without a filter.
        batch_info: arrays by key of the last step or reset, with the batch in front; envs that are
            done have those of the last step of their episode.

    Args:
        env: with same-step reset.
        intervention_penalty: c >= 0; the reward is reduced by c |u_safe - u_nominal|, the Euclidean
            distance of `info`'s actions in units of the half widths of the input bounds.

    Raises:
        ConfigurationError: the env is another one, or resets otherwise; or the penalty is out of
            range, or is given without a filter.
    """

    def __init__(self, env: gym.vector.VectorEnv, intervention_penalty: float = 0.0) -> None:
        if not isinstance(env, _NATIVE):
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
        self.batch_info: Info = {}
        self._penalty = float(intervention_penalty)
        self._half = np.array(center_and_half_width(env.unwrapped.problem)[1])  # pyright: ignore[reportAttributeAccessIssue]
        self._actions = np.empty(0)
        super().__init__(env)

    def reset(self) -> np.ndarray:
        """Start an episode in every env, with the seeds of `seed` unless they were used.

        Returns:
            Observations, float32 of shape (num_envs, n); the infos are in `reset_infos`.

        Raises:
            ConfigurationError: an option of `set_options` is unknown, or one env has others.
            InvalidInputError: a state or a time is not allowed.
        """
        observation, info = self.env.reset(seed=self._seeds, options=_joined(self._options))
        self._reset_seeds()
        self._reset_options()
        self.batch_info = self._at_rest(info)
        self.reset_infos = self._infos(self.batch_info)
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions in [-1, 1], shape (num_envs, m), for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Hold the actions for one control period; start a new episode in each env that is done.

        Returns:
            Observations, float32 (num_envs, n); rewards, float32 (num_envs,); dones, bool
            (num_envs,); a dict for each env.

        Raises:
            InvalidInputError: the actions have another shape or are not finite.
            NumericalError: the state of an env is no longer finite.
        """
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        dones = terminated | truncated
        ended = dones.nonzero()[0].tolist()
        # In `final_info` the native env leaves whole arrays, which include the envs that go on.
        batch = _arrays(info["final_info"] if ended else info)
        batch[_TRUNCATED] = truncated & ~terminated
        self.batch_info = batch
        if self._penalty:
            distance = np.linalg.norm(
                (batch["safe_action"] - batch["nominal_action"]) / self._half, axis=1
            )
            batch[_PENALTY] = self._penalty * distance
            reward = reward - batch[_PENALTY]
        infos = self._infos(batch)
        if ended:
            restarted = self._at_rest(info)
            for i in ended:
                infos[i]["terminal_observation"] = info["final_obs"][i].copy()
                self.reset_infos[i] = LazyInfo(restarted, i)
        return observation, reward.astype(np.float32), dones, infos

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the state of each episode; see `SafeVectorEnv.snapshot`."""
        return self.env.snapshot()  # pyright: ignore[reportAttributeAccessIssue]

    def restore(self, snapshot: Mapping[str, np.ndarray], seed: int) -> None:
        """Put each episode into the state of a snapshot; see `SafeVectorEnv.restore`.

        Args:
            snapshot: of `snapshot`.
            seed: of the noise and of the starts from then on.
        """
        self.env.restore(snapshot, seed)  # pyright: ignore[reportAttributeAccessIssue]

    def _at_rest(self, info: Info) -> Info:
        """Return the arrays of a reset, with a penalty of zero."""
        batch = _arrays(info)
        if self._penalty:
            batch[_PENALTY] = np.zeros(self.num_envs)
        return batch

    def _infos(self, batch: Info) -> list[dict[str, Any]]:
        return [LazyInfo(batch, i) for i in range(self.num_envs)]


def _require_penalty(penalty: Any, filtered: bool) -> None:
    if not isinstance(penalty, numbers.Real) or not 0.0 <= float(penalty) < math.inf:
        raise ConfigurationError(f"intervention_penalty = {penalty!r}; give a finite number from 0")
    if penalty and not filtered:
        raise ConfigurationError(
            f"intervention_penalty = {penalty!r} without a filter, which alone intervenes; give a"
            " filter, or 0"
        )


def _arrays(info: Info) -> Info:
    """Return the arrays of a vector env's info, without Gymnasium's masks."""
    return {key: info[key] for key in _of_arrays(tuple(info))}


@lru_cache(maxsize=64)
def _of_arrays(keys: tuple[str, ...]) -> tuple[str, ...]:
    return tuple([key for key in keys if not key.startswith(("_", "final_"))])


def _joined(options: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the options of each env as those of a batch."""
    first = options[0]
    if any(each.keys() != first.keys() for each in options) or "reset_mask" in first:
        raise ConfigurationError(
            f"set_options was given {shown(options)}; give each env the same of state, start and t"
        )
    if any(each.get("start") != first.get("start") for each in options):
        raise ConfigurationError(
            f"set_options was given {shown(options)}; all envs start from one distribution"
        )
    return {
        name: value if name == "start" else [each[name] for each in options]
        for name, value in first.items()
    }
