"""Steps of scalar and vector envs, for the speeds of `doctor` and the benchmarks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper

ENV_ID = "safe_envs/StochasticDubins-v0"
NUM_ENVS = 1024


class Case(NamedTuple):
    """A call to time.

    Attributes:
        call: what is timed.
        states: how many it handles.
        prepare: done before each round.
        calls: in a round; None for as many as fit its time.
    """

    call: Callable[[], Any]
    states: int = 1
    prepare: Callable[[], Any] = lambda: None
    calls: int | None = None


def scalar_steps() -> dict[str, Case]:
    """Return steps of a scalar env, unfiltered and filtered."""

    # No episode may end within a round: the vehicle turns on the spot, with little noise.
    def make() -> gym.Env[Any, Any]:
        return gym.make(ENV_ID, horizon=1e9, start=[0.0, 0.0, 0.0], noise=0.01)

    envs = {"unfiltered": make(), "filtered": SafetyFilterWrapper(make(), "scbf")}
    action = np.array([0.9], dtype=np.float32)
    return {
        f"env.step, {name}": Case(
            lambda env=env: env.step(action), prepare=lambda env=env: env.reset(seed=0)
        )
        for name, env in envs.items()
    }


def vector_steps(engine: str = "numpy") -> dict[str, Case]:
    """Return steps of a vector env, unfiltered and filtered."""
    unfiltered, other = (gym.make_vec(ENV_ID, num_envs=NUM_ENVS, engine=engine) for _ in range(2))
    envs = {"unfiltered": unfiltered, "filtered": SafetyFilterVectorWrapper(other, "scbf")}
    actions = np.full((NUM_ENVS, 1), 0.3, dtype=np.float32)
    cases = {}
    for name, env in envs.items():
        env.reset(seed=0)
        # Ten whole episodes, so that resets and draws of noise have their share of every round.
        calls = 10 * (env.unwrapped.problem.steps + 1)  # pyright: ignore[reportAttributeAccessIssue]
        cases[f"vector env, {name}"] = Case(
            lambda env=env: env.step(actions), NUM_ENVS, calls=calls
        )
    return cases
