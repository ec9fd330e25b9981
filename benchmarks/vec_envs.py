"""The speed of the native VecEnv against that of DummyVecEnv."""

from __future__ import annotations

import time
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from safe_envs.agents import make_sb3_env
from safe_envs.registry import full_id
from safe_envs.wrappers import SafetyFilterWrapper


def speeds(
    env_id: str,
    num_envs: int = 64,
    filter: str | None = None,  # noqa: A002
    steps: int = 100,
    rounds: int = 6,
    engine: str = "numpy",
) -> dict[str, float]:
    """Measure the speed of `SB3VecEnv` and of DummyVecEnv, reading infos as every algorithm does.

    Args:
        env_id: registered id.
        num_envs: size of the batches.
        filter: text of a condition; None for the unfiltered env.
        steps: of a batch in a round.
        rounds: of which the fastest counts.
        engine: of `SB3VecEnv`.

    Returns:
        Steps of single envs per second, by the name of the class.
    """

    def scalar() -> gym.Env[Any, Any]:
        env = gym.make(full_id(env_id))
        return env if filter is None else SafetyFilterWrapper(env, filter)

    venvs = (
        make_sb3_env(env_id, num_envs, filter, engine=engine),
        DummyVecEnv([scalar] * num_envs),
    )
    inputs = len(venvs[0].get_attr("problem")[0].inputs)
    actions = (
        np.random.default_rng(0).uniform(-1.0, 1.0, (steps, num_envs, inputs)).astype(np.float32)
    )
    best = dict.fromkeys((type(venv).__name__ for venv in venvs), 0.0)
    for _ in range(rounds):
        for venv in venvs:
            best[type(venv).__name__] = max(
                best[type(venv).__name__], num_envs * steps / _seconds(venv, actions)
            )
    return best


def _seconds(venv: VecEnv, actions: np.ndarray) -> float:
    """Time an algorithm's way through some steps, without its learning."""
    venv.seed(0)
    venv.reset()
    began = time.perf_counter()
    for action in actions:
        for info in venv.step(action)[3]:
            info.get("episode")
            info.get("is_success")
    return time.perf_counter() - began
