"""Gymnasium's `RecordEpisodeStatistics` with the cost and the minimum h of each episode."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from safe_envs.envs.info import VectorStep
from safe_envs.errors import ConfigurationError
from safe_envs.independent_copies import IndependentCopies
from safe_envs.wrappers.env_wrappers.autoreset import autoreset_mode

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
