"""The interface of safety-gymnasium, whose `step` returns the cost after the reward."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import VectorizeMode
from gymnasium.vector import AutoresetMode

from safe_envs.envs.info import step_cost
from safe_envs.errors import ConfigurationError, nearest, require_whole
from safe_envs.independent_copies import IndependentCopies
from safe_envs.registry import env_class, full_id
from safe_envs.wrappers.env_wrappers.autoreset import autoreset_mode
from safe_envs.wrappers.env_wrappers.episode_filter import FilterChoice
from safe_envs.wrappers.env_wrappers.safety_filter import SafetyFilterWrapper
from safe_envs.wrappers.env_wrappers.safety_filter_vector import SafetyFilterVectorWrapper

SixTuple = tuple[Any, Any, Any, Any, Any, dict[str, Any]]


class CostReturnWrapper(IndependentCopies):
    """Gives a `step` of six values to an env of this project, scalar or vector, filtered or not.

    It is no `gymnasium.Wrapper`, since Gymnasium's checkers and wrappers take five values: put it
    around everything else. Every other attribute, such as `action_space`, is that of the env.

    Args:
        env: whose `info` holds the `cost` of each step.

    Raises:
        ConfigurationError: it is no Gymnasium env, or a vector env that does not say how it resets.
    """

    def __init__(self, env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]) -> None:
        if not isinstance(env, gym.Env | gym.vector.VectorEnv):
            raise ConfigurationError(
                f"env = {env!r}; give a Gymnasium env or vector env, such as"
                " gym.make('safe_envs/Quadrotor-v0')"
            )
        self.env = env
        self._mode = autoreset_mode(env) if isinstance(env, gym.vector.VectorEnv) else None
        self._ended = np.zeros(getattr(env, "num_envs", ()), dtype=bool)
        self._before = np.zeros(self._ended.shape)

    def __getattr__(self, name: str) -> Any:
        # What is private is not forwarded; and a copy that is being made has no env to ask yet.
        if name == "env" or name.startswith("_"):
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.env, name)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`."""
        restarted = np.asarray((options or {}).get("reset_mask", True), dtype=bool)
        self._ended = self._ended & ~restarted
        observation, info = self.env.reset(seed=seed, options=options)
        self._before = np.where(restarted, info.get("episode_cost", 0.0), self._before)
        return observation, info

    def step(self, action: Any) -> SixTuple:
        """Hold an action for one control period.

        Returns:
            The observation, the reward, the cost of the state that was reached, or of all states
            where a wrapper repeats actions, whether the episode was terminated or truncated, and
            the env's info with that cost once more as `cost_sum`.
            Over a vector env the first five are arrays (num_envs, ...): a step that ends an episode
            in same-step autoreset has the cost of its last state, and one that only starts an
            episode, in next-step autoreset, costs nothing.

        Raises:
            ConfigurationError: the env reports no cost.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        if "cost" not in info:
            raise ConfigurationError(
                f"info of {self.env} has no 'cost', but {', '.join(info) or 'nothing'}; use an env"
                " of this project"
            )
        cost, masks = self._costs(info), {}
        self._before = np.array(info.get("episode_cost", 0.0), dtype=np.float64)
        if self._mode is None:
            cost = float(cost)
        else:
            self._ended, masks = terminated | truncated, {"_cost_sum": info["_cost"]}
        info = {**info, "cost_sum": cost, **masks}
        return observation, reward, cost, terminated, truncated, info

    def _costs(self, info: dict[str, Any]) -> np.ndarray:
        """Return the cost of each env, where the info may be that of a reset."""
        cost = self._since(info)
        if self._mode == AutoresetMode.SAME_STEP and "final_info" in info:
            last = info["final_info"]
            return np.where(last["_cost"], self._since(last), cost)
        return np.where(self._ended, 0.0, cost) if self._mode == AutoresetMode.NEXT_STEP else cost

    def _since(self, info: dict[str, Any]) -> Any:
        """Return the cost since the last step."""
        cost = info["cost"]
        if "violation" not in info or "episode_cost" not in info:
            return np.asarray(cost)
        return step_cost(cost, info["violation"], info["episode_cost"], self._before)


def make_with_cost(
    env_id: str,
    filter: FilterChoice | None = None,  # noqa: A002  (the word of the whole project)
    **options: Any,
) -> CostReturnWrapper:
    """Make an env whose `step` returns the cost after the reward, as `safety_gymnasium.make` does.

    Args:
        env_id: registered id, with or without its namespace.
        filter: condition of a safety filter around the env, or its text, like "scbf".
        **options: arguments of `gym.make`.

    Raises:
        ConfigurationError: an id, a filter or an argument is unknown or out of range.
        RelativeDegreeError: the filter does not suit the env's barrier.
    """
    env = gym.make(full_id(env_id), **options)
    return CostReturnWrapper(env if filter is None else SafetyFilterWrapper(env, filter))


def make_vec_with_cost(
    env_id: str,
    num_envs: int = 1,
    vectorization_mode: str | None = None,
    filter: FilterChoice | None = None,  # noqa: A002
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    **options: Any,
) -> CostReturnWrapper:
    """Make a vector env whose `step` returns the costs after the rewards.

    Args:
        env_id: registered id, with or without its namespace.
        num_envs: size of the batch.
        vectorization_mode: of `gym.make_vec`: "vector_entry_point" for the native vector env, which
            is the default, "sync", or "async" for a process for each env.
        filter: see `make_with_cost`.
        autoreset_mode: "NextStep", "SameStep" or "Disabled", in all three vectorisations.
        **options: arguments of `gym.make`.

    Raises:
        ConfigurationError: an id, a filter, a mode or an argument is unknown or out of range.
        RelativeDegreeError: the filter does not suit the env's barrier.
    """
    modes = [mode.value for mode in VectorizeMode]
    if vectorization_mode is not None and vectorization_mode not in modes:
        raise ConfigurationError(
            f"vectorization_mode = {vectorization_mode!r};"
            f" {nearest(str(vectorization_mode), modes)}"
        )
    resets = [mode.value for mode in AutoresetMode]
    if autoreset_mode not in (*resets, *AutoresetMode):
        raise ConfigurationError(
            f"autoreset_mode = {autoreset_mode!r}; {nearest(str(autoreset_mode), resets)}"
        )
    require_whole("num_envs", num_envs, 1)
    if given := sorted({"wrappers", "vector_kwargs"} & options.keys()):
        raise ConfigurationError(
            f"{', '.join(given)}: leave it out; make such envs by gym.make_vec, and put a"
            " CostReturnWrapper around them"
        )
    name, mode = full_id(env_id), AutoresetMode(autoreset_mode)
    if vectorization_mode in (None, VectorizeMode.VECTOR_ENTRY_POINT.value):
        env_class(name)  # others have no native vector env
        native = VectorizeMode.VECTOR_ENTRY_POINT
        env = gym.make_vec(name, num_envs, native, autoreset_mode=mode.value, **options)
        return CostReturnWrapper(env if filter is None else SafetyFilterVectorWrapper(env, filter))
    around: list[Callable[..., Any]] = (
        [] if filter is None else [partial(SafetyFilterWrapper, condition=filter)]
    )
    return CostReturnWrapper(
        gym.make_vec(
            name,
            num_envs,
            vectorization_mode,
            vector_kwargs={"autoreset_mode": mode},
            wrappers=around,
            **options,
        )
    )
