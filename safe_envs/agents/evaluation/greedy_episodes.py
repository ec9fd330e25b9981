"""Episodes of the greedy policy of a table, and how many of them leave the workspace."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import smallest
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.agents.policies.best import BestPolicy
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.philox import episode_seeds
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.wrappers import SpecificationMonitorVector


@dataclass(frozen=True)
class SimulatedRate:
    """The safety rate of the greedy policy of a table.

    Attributes:
        rate: share of safe episodes, or of those that meet the specification of the table, with
            leaving counted as the table does.
        low: lower end of its interval.
        high: upper end.
        leave_rate: share of the episodes that left the workspace in the safe set.
        safe: number of safe episodes.
        episodes: how many were simulated.
        seed: of the simulation; they are the episodes that `evaluate` has with it.
        confidence: of the interval.
    """

    rate: float
    low: float
    high: float
    leave_rate: float
    safe: int
    episodes: int
    seed: int
    confidence: float


def simulate(
    policy: BestPolicy,
    episodes: int,
    seed: int,
    confidence: float,
    num_envs: int,
    progress: Progress | None = None,
) -> SimulatedRate:
    """Simulate the greedy policy of a table in its world.

    Args:
        policy: to simulate.
        episodes: how many.
        seed: from which each episode gets its own, as in `evaluate`.
        confidence: of the interval.
        num_envs: episodes side by side.
        progress: called with the part that is done, from 0 to 1.

    Returns:
        The rate, with leaving counted as the table does.
    """
    env = SafeVectorEnv(policy.problem, min(num_envs, episodes))
    safe = left = 0
    for first in range(0, episodes, env.num_envs):
        count = min(env.num_envs, episodes - first)

        def tell(part: float, first: int = first, count: int = count) -> None:
            if progress:
                progress((first + count * part) / episodes)

        seeds = episode_seeds(seed, range(first, first + env.num_envs))
        play = _judge if policy.settings.specification else _play
        of_batch = play(env, policy, seeds, np.arange(env.num_envs) < count, tell)
        safe, left = safe + of_batch[0], left + of_batch[1]
    env.close()
    if policy.settings.leaving == "safe":
        safe += left
    low, high = rate_interval(safe, episodes, confidence)
    return SimulatedRate(
        safe / episodes, low, high, left / episodes, safe, episodes, seed, confidence
    )


def _play(
    env: SafeVectorEnv, policy: BestPolicy, seeds: list[int], counts: np.ndarray, tell: Progress
) -> tuple[int, int]:
    """Count the episodes of a batch that stay safe to their end, and those that leave while safe.

    Args:
        env: to simulate.
        policy: who acts.
        seeds: of the episodes.
        counts: which of them count.
        tell: called with the part that is done.
    """
    plant, problem = env.problem.plant, env.problem
    outside = compile_function(plant.states, (plant.numeric(problem.outside),), "arrays")
    observation, info = env.reset(seed=seeds)
    safe = counts & (smallest(info["barrier"]) > 0.0)
    alive, left = counts.copy(), np.zeros_like(counts)
    state, start = None, np.ones_like(counts)
    for k in range(1, problem.steps + 1):
        actions, state = policy.predict(observation, state, start, deterministic=True)
        observation, _, terminated, truncated, info = env.step(actions)
        safe &= (smallest(info["barrier"]) > 0.0) | ~alive
        left |= alive & safe & (outside(*env.components)[0] > 0.0)
        start = terminated | truncated
        alive &= ~start
        tell(k / problem.steps)
        # What follows a violation changes none of the counts.
        if not (alive & safe).any():
            break
    return int(np.count_nonzero(safe & ~left)), int(np.count_nonzero(left))


def _judge(
    env: SafeVectorEnv, policy: BestPolicy, seeds: list[int], counts: np.ndarray, tell: Progress
) -> tuple[int, int]:
    """Count the episodes of a batch that meet a specification: in the workspace, and outside.

    What was settled before the workspace is left counts as met inside of it.

    Args:
        env: to simulate.
        policy: who acts.
        seeds: of the episodes.
        counts: which of them count.
        tell: called with the part that is done.
    """
    plant, problem = env.problem.plant, env.problem
    outside = compile_function(plant.states, (plant.numeric(problem.outside),), "arrays")
    monitor = SpecificationMonitorVector(env, policy.settings.specification)
    observation, info = monitor.reset(seed=seeds)
    alive, met, left = counts.copy(), 0, 0
    state, start, settled = None, np.ones_like(counts), info["verdict"] > 0
    for k in range(1, problem.steps + 1):
        actions, state = policy.predict(observation, state, start, deterministic=True)
        observation, _, terminated, truncated, info = monitor.step(actions)
        start = terminated | truncated
        over = alive & start & info["satisfied"]
        lost = over & ~settled & (outside(*env.components)[0] > 0.0)
        met, left = met + np.count_nonzero(over & ~lost), left + np.count_nonzero(lost)
        settled, alive = info["verdict"] > 0, alive & ~start
        tell(k / problem.steps)
        if not alive.any():
            break
    return int(met), int(left)
