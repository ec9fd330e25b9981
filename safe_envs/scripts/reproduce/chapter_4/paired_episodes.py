"""The same episodes under several filters: when each is first unsafe, and by how much two filters
differ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safe_envs.agents.evaluation.rollout import run_episodes
from safe_envs.agents.evaluation.statistics import paired_difference_interval
from safe_envs.agents.policies.base import Policy
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.reproduce.framework.artefact import Number
from safe_envs.wrappers import Condition, SafetyFilterVectorWrapper, parse_conditions

_WAVE = 1024


@dataclass(frozen=True)
class Exits:
    """When the episodes of a filter are first unsafe.

    Attributes:
        instant: first control instant with h <= 0 of each episode, past the last one if there is
            none, shape (episodes,).
        infeasible: share of the steps before it in which no action meets the condition.
    """

    instant: np.ndarray
    infeasible: float

    def safe(self, step: int) -> np.ndarray:
        """Which episodes are safe up to a control instant, that one included, shape (episodes,)."""
        return self.instant > step

    def rate(self, name: str, step: int) -> Number:
        """The share of these."""
        return Number.rate(name, int(self.safe(step).sum()), len(self.instant))


def exits(
    problem: SafetyProblem, condition: str | Condition, policy: Policy, episodes: int, seed: int
) -> Exits:
    """Simulate a filter over a policy; episode i has the same start and noise under every filter.

    Args:
        problem: with its horizon.
        condition: of the filter, or its text.
        policy: whose actions are filtered.
        episodes: how many.
        seed: of all of them.
    """
    conditions = parse_conditions(condition, problem) if isinstance(condition, str) else condition
    env = SafetyFilterVectorWrapper(SafeVectorEnv(problem, min(episodes, _WAVE)), conditions)
    found = run_episodes(env, policy, episodes, seed).results
    instants = np.where(found.safe, problem.steps + 1, found.first_violation)
    return Exits(instants, int(found.infeasible.sum()) / max(int(found.counted.sum()), 1))


def difference(name: str, first: np.ndarray, second: np.ndarray) -> Number:
    """By how much the rate of one filter is above another's on the same episodes, in points, with
    its paired interval.

    Args:
        name: of the number.
        first: which episodes are safe with the one, shape (episodes,).
        second: with the other.
    """
    table = [
        int(both.sum())
        for both in (first & second, first & ~second, ~first & second, ~first & ~second)
    ]
    low, high = paired_difference_interval(*table)
    return Number(
        name, 100 * (table[1] - table[2]) / len(first), 100 * low, 100 * high, unit="points"
    )


def is_above(number: Number, value: float = 0.0) -> bool:
    """Whether the whole interval of a number is above a value."""
    return number.low is not None and number.low > value


def is_below(number: Number, value: float = 0.0) -> bool:
    """Whether the whole interval of a number is below a value."""
    return number.high is not None and number.high < value


def with_interval(number: Number) -> str:
    """A difference with its sign and its interval, as text."""
    return f"{number.ours:+.1f} [{number.low:.1f}, {number.high:.1f}]"
