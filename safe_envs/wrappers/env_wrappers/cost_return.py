"""The interface of safety-gymnasium, whose `step` returns the cost after the reward."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from safe_envs.errors import ConfigurationError
from safe_envs.independent_copies import IndependentCopies

SixTuple = tuple[Any, Any, Any, Any, Any, dict[str, Any]]


class CostReturnWrapper(IndependentCopies):
    """Gives a `step` of six values to an env of this project, scalar or vector, filtered or not.

    It is no `gymnasium.Wrapper`, since Gymnasium's checkers and wrappers take five values: put it
    around everything else. Every other attribute, such as `action_space`, is that of the env.

    Args:
        env: whose `info` holds the `cost` of each step.

    Raises:
        ConfigurationError: it is no Gymnasium env.
    """

    def __init__(self, env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]) -> None:
        if not isinstance(env, gym.Env | gym.vector.VectorEnv):
            raise ConfigurationError(
                f"env = {env!r}; give a Gymnasium env or vector env, such as"
                " gym.make('safe_envs/Quadrotor-v0')"
            )
        self.env = env
        self._mode = (
            env.metadata.get("autoreset_mode") if isinstance(env, gym.vector.VectorEnv) else None
        )
        self._ended = np.zeros(getattr(env, "num_envs", ()), dtype=bool)

    def __getattr__(self, name: str) -> Any:
        # What is private is not forwarded; and a copy that is being made has no env to ask yet.
        if name == "env" or name.startswith("_"):
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.env, name)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`."""
        restarted = (options or {}).get("reset_mask", True)
        self._ended = self._ended & ~np.asarray(restarted, dtype=bool)
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> SixTuple:
        """Hold an action for one control period.

        Returns:
            The observation, the reward, the cost of the state that was reached, whether the episode
            was terminated or truncated, and the env's info with that cost once more as `cost_sum`.
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
        cost, masks = info["cost"], {}
        if self._mode is not None:
            cost, masks = self._costs(info), {"_cost_sum": info["_cost"]}
            self._ended = terminated | truncated
        info = {**info, "cost_sum": cost, **masks}
        return observation, reward, cost, terminated, truncated, info

    def _costs(self, info: dict[str, Any]) -> np.ndarray:
        """Return the cost of each env, shape (num_envs,), where the info may be that of a reset."""
        cost = info["cost"]
        if self._mode == AutoresetMode.SAME_STEP and "final_info" in info:
            last = info["final_info"]
            return np.where(last["_cost"], last["cost"], cost)
        return np.where(self._ended, 0.0, cost) if self._mode == AutoresetMode.NEXT_STEP else cost
