"""Gymnasium's `RecordEpisodeStatistics` with the cost and the minimum h of each episode."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import VectorizeMode
from gymnasium.vector import AutoresetMode

from safe_envs.envs.info import VectorStep, step_cost
from safe_envs.errors import ConfigurationError, IndependentCopies, nearest, require_whole
from safe_envs.registry import env_class, full_id
from safe_envs.wrappers.filter_layers import FilterChoice
from safe_envs.wrappers.layers import autoreset_mode
from safe_envs.wrappers.safety_filter import SafetyFilterVectorWrapper, SafetyFilterWrapper

_SOURCES = {"c": "episode_cost", "h_min": "h_min"}
"""Keys that are added to the statistics, and those of `info` that hold them."""

_OWN = "gymnasium_statistics"
"""Key under which Gymnasium's wrapper leaves its part, until it is joined with the others'."""


class RecordSafetyStatistics(IndependentCopies, gym.wrappers.RecordEpisodeStatistics):
    """Gymnasium's `RecordEpisodeStatistics`, with the episode's cost and minimum h.

    The last step of an episode has them in `info["episode"]`: the return "r", the length "l", the
    seconds "t", the cost "c", which is the number of unsafe states, and "h_min", the smallest value
    of a barrier. For envs of this project, filtered or not, and for third-party ones in a
    `SafetyMonitor` or a filter. It may be recorded in a spec and made again from it.

    Around a `Monitor` of Stable-Baselines3 it adds "c" and "h_min" to that one's entry. Inside of
    one its entry is replaced: give `Monitor` the `info_keywords` ("episode_cost", "h_min"), or this
    wrapper another `stats_key`.

    Args:
        env: whose info has `episode_cost` and `h_min`.
        buffer_length: how many episodes the queues hold.
        stats_key: of the entry of `info`.

    Attributes:
        return_queue: returns of the last episodes.
        length_queue: their lengths.
        time_queue: how many seconds they took.
        cost_queue: their costs.
        h_min_queue: their minimum h.

    Raises:
        ConfigurationError: at the end of an episode, the env reports no cost or no h.
    """

    def __init__(
        self, env: gym.Env[Any, Any], buffer_length: int = 100, stats_key: str = "episode"
    ) -> None:
        # The first record counts: what Gymnasium's wrapper is given below is not the user's key.
        gym.utils.RecordConstructorArgs.__init__(
            self, buffer_length=buffer_length, stats_key=stats_key
        )
        super().__init__(env, buffer_length, _OWN)
        self._key = stats_key
        self.cost_queue: deque[float] = deque(maxlen=buffer_length)
        self.h_min_queue: deque[float] = deque(maxlen=buffer_length)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Pass on an action; the last step of an episode reports its statistics."""
        observation, reward, terminated, truncated, info = super().step(action)
        if terminated or truncated:
            added = _of_episode(info, self.env)
            self.cost_queue.append(added["c"])
            self.h_min_queue.append(added["h_min"])
            info[self._key] = info.pop(_OWN) | info.get(self._key, {}) | added
        return observation, reward, terminated, truncated, info


class RecordSafetyStatisticsVector(IndependentCopies, gym.wrappers.vector.RecordEpisodeStatistics):
    """`RecordSafetyStatistics` over a vector env: arrays (num_envs,), with Gymnasium's masks.

    A step at which episodes end has their statistics in `info["episode"]`, with zeros for the other
    envs, and tells in `info["_episode"]` which ended. In all autoreset modes the last step of an
    episode counts, and a step that only resets an env does not.

    Args:
        env: whose info has `episode_cost` and `h_min`; it says how it resets.
        buffer_length: how many episodes the queues hold.
        stats_key: of the entry of `info`.

    Attributes:
        return_queue: returns of the last episodes; for the other queues see
            `RecordSafetyStatistics`.

    Raises:
        ConfigurationError: the env does not say how it resets; or, at the end of an episode, it
            reports no cost or no h.
    """

    def __init__(
        self, env: gym.vector.VectorEnv, buffer_length: int = 100, stats_key: str = "episode"
    ) -> None:
        self.autoreset_mode = autoreset_mode(env)
        super().__init__(env, buffer_length, _OWN)
        self._key = stats_key
        self.cost_queue: deque[float] = deque(maxlen=buffer_length)
        self.h_min_queue: deque[float] = deque(maxlen=buffer_length)

    def reset(
        self, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes in every env, or those of a mask; see `SafeVectorEnv.reset`."""
        going_on = ~np.asarray((options or {}).get("reset_mask", True), dtype=bool)
        kept = {
            name: np.where(going_on, getattr(self, name), 0)
            for name in ("episode_start_times", "episode_returns", "episode_lengths", "prev_dones")
        }
        # Gymnasium's vector envs take the mask out of the options: its wrapper does not see it then
        # and restarts all statistics. Here those of the episodes that go on are put back.
        answer = super().reset(seed=seed, options=None if options is None else dict(options))
        for name, values in kept.items():
            now = getattr(self, name)
            setattr(self, name, np.where(going_on, values, now).astype(now.dtype))
        return answer

    def step(self, actions: Any) -> VectorStep:
        """Pass on actions; steps at which episodes end report their statistics."""
        observation, reward, terminated, truncated, info = super().step(actions)
        ended = terminated | truncated
        if ended.any():
            same_step = self.autoreset_mode == AutoresetMode.SAME_STEP
            last = info["final_info"] if same_step else info
            added = {key: np.where(ended, v, 0.0) for key, v in _of_episode(last, self.env).items()}
            self.cost_queue.extend(added["c"][ended].tolist())
            self.h_min_queue.extend(added["h_min"][ended].tolist())
            del info[f"_{_OWN}"]
            info[self._key] = info.pop(_OWN) | info.get(self._key, {}) | added
            info[f"_{self._key}"] = ended
        return observation, reward, terminated, truncated, info


def _of_episode(info: Mapping[str, Any], env: Any) -> dict[str, Any]:
    """Return what is added to the statistics of an episode, from the info of its last step."""
    missing = [source for source in _SOURCES.values() if source not in info]
    if missing:
        raise ConfigurationError(
            f"info of {env} has no {', '.join(map(repr, missing))}: put the wrapper around an env"
            " of this project, or around a SafetyMonitor"
        )
    return {key: info[source] for key, source in _SOURCES.items()}


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
        cost, added = self._costs(info), {}
        self._before = np.array(info.get("episode_cost", 0.0), dtype=np.float64)
        if self._mode is None:
            cost = added["cost_sum"] = float(cost)
        else:
            self._ended = terminated | truncated
            added = {"cost_sum": np.array(cost), "_cost_sum": np.array(info["_cost"])}
        return observation, reward, cost, terminated, truncated, {**info, **added}

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
        [] if filter is None else [partial(SafetyFilterWrapper, filter=filter)]
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
