"""Episodes under one filter, period by period, and when each is first unsafe."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from safe_envs import SafetyProblem, SafeVectorEnv
from safe_envs.agents import Policy, evaluate, make_policy
from safe_envs.agents.evaluation.rollout import episode_seed
from safe_envs.envs.info import Info
from safe_envs.scripts.reproduce.framework.artefact import Number
from safe_envs.wrappers import Condition, SafetyFilterVectorWrapper, parse_conditions


@dataclass(frozen=True)
class Period:
    """A control period of episodes that run side by side, with B episodes and n states.

    Attributes:
        states: at its end, shape (B, n).
        before: smallest h at its beginning, shape (B,).
        after: smallest h at its end, shape (B,).
        running: which episodes have not ended at its beginning, shape (B,).
        info: of the environment at its end.
    """

    states: np.ndarray
    before: np.ndarray
    after: np.ndarray
    running: np.ndarray
    info: Info


def periods(
    problem: SafetyProblem,
    condition: str | Condition,
    policy: str,
    episodes: range,
    seed: int,
    knowledge: str = "model",
) -> Iterator[Period]:
    """Simulate consecutive episodes of an evaluation under a filter; yield their control periods.

    Args:
        problem: with its horizon.
        condition: of the filter, or its text.
        policy: name of the policy whose actions are filtered.
        episodes: numbers of the episodes; number i has the same start and noise in every filter.
        seed: of all of them.
        knowledge: what the filter knows, "model" or "plant".

    Returns:
        An iterator over the periods, until all episodes have ended.
    """
    conditions = parse_conditions(condition, problem) if isinstance(condition, str) else condition
    world = SafeVectorEnv(problem, len(episodes))
    env = SafetyFilterVectorWrapper(world, conditions, knowledge)
    actor: Policy = make_policy(policy, problem)
    observation, info = env.reset(seed=[episode_seed(seed, i) for i in episodes])
    running = np.ones(len(episodes), dtype=bool)
    before = info["barrier"].min(axis=1)
    for _ in range(problem.steps):
        observation, _, terminated, truncated, info = env.step(actor.predict(observation)[0])
        after = info["barrier"].min(axis=1)
        yield Period(world.state, before, after, running, info)
        before, running = after, running & ~(terminated | truncated)
        if not running.any():
            return


@dataclass(frozen=True)
class Violations:
    """When the episodes of a filter are first unsafe.

    Attributes:
        instant: first control instant with h <= 0 of each episode, past the last one if there is
            none, shape (episodes,).
        infeasible: share of the steps before it in which no action meets the condition.
    """

    instant: np.ndarray
    infeasible: float

    def safe(self, step: int) -> np.ndarray:
        """Return which episodes are safe up to a control instant, inclusive, shape (episodes,)."""
        return self.instant > step

    def rate(self, name: str, step: int) -> Number:
        """Return the share of these episodes in per cent.

        Args:
            name: of the number.
            step: control instant.
        """
        return Number.rate(name, int(self.safe(step).sum()), len(self.instant))


def violations(
    problem: SafetyProblem, condition: str | Condition, policy: str, episodes: int, seed: int
) -> Violations:
    """Return when the first episodes of an evaluation are first unsafe.

    Args:
        problem: with its horizon.
        condition: of the filter, or its text.
        policy: name of the policy whose actions are filtered.
        episodes: number of them.
        seed: of all of them.
    """
    found = evaluate(
        problem,
        policy,
        [condition],
        episodes=episodes,
        seed=seed,
        bounds=False,
        keep_episodes=True,
    )
    results = next(iter(found.episodes.values()))[0]
    instant = np.where(results.safe, problem.steps + 1, results.first_violation)
    return Violations(instant, results.infeasible.sum() / max(results.counted.sum(), 1))
