"""Episodes of policies, filters and prices, as points of risk and return."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.frontier_results import FrontierPoint
from safe_envs.agents.evaluation.resolved import ResolvedEvaluation
from safe_envs.agents.evaluation.rollout import play
from safe_envs.agents.evaluation.rows import EpisodeResults
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.agents.evaluation.trajectories import EpisodeRecorder
from safe_envs.agents.policies.base import Policy
from safe_envs.dynamics.codegen import Components, compile_function, filled
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.wrappers.value.priced_values import PricedValues

_BATCH = 1024


class _LastStates(EpisodeRecorder):
    """Keeps the state in which each episode of a batch ended."""

    def __init__(self) -> None:
        self.last: list[np.ndarray] = []

    def note(self, k: int, first: int, present: np.ndarray, h: np.ndarray, x: Components) -> None:
        """Keep the states of the episodes that are under way; see `EpisodeRecorder.note`."""
        if k == 0:
            self.last = [np.array(c, dtype=np.float64) for c in x]
        for kept, component in zip(self.last, x, strict=True):
            np.copyto(kept, component, where=present)


class FrontierEpisodes:
    """Simulates episodes, and makes points of them.

    Args:
        values: the computed returns at prices of a violation.
        seed: whole number from 0.
        confidence: of all intervals.
    """

    def __init__(self, values: PricedValues, seed: int, confidence: float) -> None:
        problem = self._problem = values.given.small.problem
        self._values, self._seed, self._confidence = values, seed, confidence
        self._counts_leaving = values.settings.leaving == "violation"
        self._outside = compile_function(problem.plant.states, (problem.outside,), "arrays")

    def evaluated(
        self, name: str, kind: str, resolved: ResolvedEvaluation, progress: Progress | None
    ) -> FrontierPoint:
        """Simulate a policy under a filter.

        Args:
            name: of the point.
            kind: of the point.
            resolved: the policy and the filter.
            progress: called with the number of episodes that are done.

        Returns:
            The point.
        """
        resolved.learn(lambda: None)
        conditions = resolved.filters[resolved.names[0]][0]
        count = resolved.spec.episodes
        env = resolved.env(conditions, min(_BATCH, count))
        return self._point(name, kind, env, resolved.policy, progress, count)

    def at_price(self, price: int, count: int, progress: Progress | None) -> FrontierPoint:
        """Simulate the policy that a price leads to.

        Args:
            price: place of the price among those whose policy is kept.
            count: number of episodes.
            progress: called with the number of episodes that are done.

        Returns:
            The point.
        """
        env = SafeVectorEnv(self._problem, min(_BATCH, count))
        policy = PricedPolicy(self._values, price, env)
        amount = float(self._values.prices[self._values.of_policies[price]])
        found = self._point(f"price {amount:.3g}", "price", env, policy, progress, count)
        return replace(found, price=amount)

    def _point(
        self,
        name: str,
        kind: str,
        env: Any,
        policy: Any,
        progress: Progress | None,
        episodes: int,
    ) -> FrontierPoint:
        watch = _LastStates()
        results, left, starts = [], [], []
        batches = play(env, policy, range(episodes), self._seed, progress, watch)
        for batch in batches:
            count = len(batch.results.length)
            results.append(batch.results)
            starts.append(batch.starts)
            shape = watch.last[0].shape
            left.append(filled(self._outside(*watch.last)[0], shape)[:count] > 0.0)
        env.close()
        found = EpisodeResults.joined(results)
        only_left = found.safe & np.concatenate(left) & self._counts_leaving
        violations = int((~found.safe | only_left).sum())
        low, high = rate_interval(violations, episodes, self._confidence)
        means = self._values.at_starts(tuple(np.concatenate(starts).T)).mean(axis=0)
        mean, half = _mean(found.returns, self._confidence)
        return FrontierPoint(
            name,
            kind,
            episodes,
            violations,
            int(only_left.sum()),
            violations / episodes,
            low,
            high,
            mean,
            mean - half,
            mean + half,
            tuple(means.tolist()),
        )


class PricedPolicy(Policy):
    """The policy that is best at a price of a violation, as its tables have it.

    It reads the states of the envs in which it acts, and remembers violations.

    Args:
        values: the tables.
        price: place of the price among those whose policy is kept.
        env: in which it acts.
    """

    def __init__(self, values: PricedValues, price: int, env: SafeVectorEnv) -> None:
        self._values, self._price, self._env = values, price, env
        problem = env.problem
        self._barriers = BarrierFunction(
            problem.plant.states, tuple(b.expression for b in problem.barriers), "arrays"
        )

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Choose actions; see `Policy.predict`.

        Returns:
            Actions, shape (B, m), and the control instant with the violations so far.
        """
        x = self._env.components
        count = len(observation)
        k, violated = (0, np.zeros(count, dtype=bool)) if state is None else state
        for h in self._barriers(*x):
            violated = violated | (filled(h, (count,)) <= 0.0)
        last = len(self._values.safe_values) - 1
        inputs = self._values.inputs_at(min(k, last), x, violated, self._price)
        return self._env.normalized_action(list(inputs.T)), (k + 1, violated)


def _mean(values: np.ndarray, confidence: float) -> tuple[float, float]:
    """Return the mean of values, and half the width of Student's interval for it."""
    from scipy.special import stdtrit

    mean = float(values.mean())
    if len(values) < 2:
        return mean, 0.0
    quantile = float(stdtrit(len(values) - 1, 0.5 + confidence / 2.0))
    return mean, quantile * float(values.std(ddof=1)) / math.sqrt(len(values))
