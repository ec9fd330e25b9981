"""How much return a policy and its filter give up for their safety, next to what can be had."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.attainable import WorkParts
from safe_envs.agents.evaluation.episodes import EpisodeRecorder, play
from safe_envs.agents.evaluation.resolve import ResolvedEvaluation
from safe_envs.agents.evaluation.rows import EpisodeResults
from safe_envs.agents.evaluation.spec import UNFILTERED, EvaluationSpec, Progress
from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.agents.policies.base import Policy
from safe_envs.dynamics.codegen import Components, compile_function, filled
from safe_envs.dynamics.defined import BarrierFunction
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import SafeEnvsError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.values.frontier import FrontierSettings, PricedValues, price_violations

_FURTHER = 50
"""Points of the line of the largest price."""


@dataclass(frozen=True)
class FrontierPoint:
    """Episodes of a policy under a filter, or at a price of a violation.

    Attributes:
        name: to call it by.
        kind: "policy", "filter", "best" or "price".
        episodes: how many.
        violations: episodes with a violation.
        left: how many of these left the workspace without any h <= 0.
        violation_rate: their share.
        violation_low: lower end of its interval.
        violation_high: upper end.
        return_mean: mean return.
        return_low: lower end of its interval.
        return_high: upper end.
        start_values: mean over its starts of the computed return less the price, at each price.
        price: of a violation, for the kind "price".
    """

    name: str
    kind: str
    episodes: int
    violations: int
    left: int
    violation_rate: float
    violation_low: float
    violation_high: float
    return_mean: float
    return_low: float
    return_high: float
    start_values: tuple[float, ...]
    price: float | None = None


@dataclass(frozen=True, eq=False)
class Frontier:
    """What can be had, as computed, and what policies and filters attain.

    Attributes:
        problem: that was looked at.
        values: the computed returns at prices of a violation.
        attained: episodes of the policies that the prices lead to.
        points: episodes of policies and filters.
        left_out: what has no point, with the reason.
        confidence: of all intervals.
    """

    problem: SafetyProblem
    values: PricedValues
    attained: Sequence[FrontierPoint]
    points: Sequence[FrontierPoint]
    left_out: dict[str, str]
    confidence: float

    def cost(self, point: FrontierPoint) -> float:
        """Return by how much the mean return of a point is below the curve of its own starts."""
        lines = np.array(point.start_values) + point.violation_rate * self.values.prices
        return float(lines.min()) - point.return_mean

    @property
    def excess(self) -> float:
        """By how much a point lies above the curve beyond both its intervals; 0 if none does."""
        found = 0.0
        for point in (*self.points, *self.attained):
            lines = np.array(point.start_values) + point.violation_high * self.values.prices
            found = max(found, point.return_low - float(lines.min()))
        return found

    def needed(self, point: FrontierPoint) -> float:
        """Return the least chance of a violation with which the return of a point can be had."""
        values, prices = np.array(point.start_values)[1:], self.values.prices[1:]
        return float(np.clip(((point.return_mean - values) / prices).max(), 0.0, 1.0))

    def curve(self, count: int = 400, bottom: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return chances of a violation and the largest mean return at them, arrays of one shape.

        The corners of the curve are among them. It begins at the least chance that the prices lead
        to; at smaller ones the largest price alone bounds the return.

        Args:
            count: number of points, at least.
            bottom: return from which that last line is wanted too; None for none of it.
        """
        v, prices = self.values.values, self.values.prices
        corners = np.clip((v[:-1] - v[1:]) / np.diff(prices), 0.0, 1.0)
        least = max(self.values.least_violations, 1e-9)
        spread = np.geomspace(least, 1.0, count) if least < 1.0 else np.ones(1)
        chances = np.unique(np.concatenate([corners[corners >= least], spread]))
        if bottom is not None:
            first = max((bottom - v[-1]) / prices[-1], 0.0)
            further = np.linspace(first, least, _FURTHER, endpoint=False)
            chances = np.concatenate([further[further < least], chances])
        return chances, self.values.largest_return(chances)

    def document(self) -> dict[str, Any]:
        """Return all as JSON-able data."""
        values = self.values
        chances, returns = self.curve()
        return {
            "computed": {
                "violations": chances.tolist(),
                "returns": returns.tolist(),
                "prices": values.prices.tolist(),
                "values": values.values.tolist(),
                "coordinates": [str(s) for s in values.given.small.symbols],
                "cells": list(values.safe_grid.counts),
                "leaving": values.settings.leaving,
                "seconds": values.seconds,
            },
            "attained": [asdict(point) for point in self.attained],
            "points": [
                asdict(p) | {"cost": self.cost(p), "needed": self.needed(p)} for p in self.points
            ],
            "excess": self.excess,
            "left_out": self.left_out,
            "confidence": self.confidence,
        }


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


@dataclass(frozen=True)
class FrontierSpec:
    """What is put next to a computed frontier.

    Attributes:
        policies: names, paths or objects for `make_policy`, by the names of their points.
        filters: texts of filters over the nominal controller.
        may_miss: names of policies and filters that are left out, with a note, if they do not suit.
        episodes: number for each point.
        attained: number of episodes of the policies that prices lead to.
        seed: whole number from 0.
        knowledge: what filters know, "model" or "plant".
        trust: load a policy's .zip, which runs code that it contains.
        confidence: of all intervals.
    """

    policies: Mapping[str, Any]
    filters: Sequence[str] = ()
    may_miss: Sequence[str] = ()
    episodes: int = 1000
    attained: int = 500
    seed: int = 0
    knowledge: str = "model"
    trust: bool = False
    confidence: float = 0.95


def frontier(
    problem: SafetyProblem,
    spec: FrontierSpec,
    settings: FrontierSettings | None = None,
    progress: Progress | None = None,
) -> Frontier:
    """Compute what returns can be had at which risk, and simulate policies and filters.

    Args:
        problem: whose plant is controlled.
        spec: what is simulated.
        settings: of the computation.
        progress: called with the part of the work that is done.

    Returns:
        The curve, and points.

    Raises:
        ConfigurationError: The problem has too many coordinates for a grid, or something unknown is
            asked for.
    """
    settings = settings or FrontierSettings()
    # Unknown names are errors before a long computation.
    # A price is that of the true state, whatever is measured of it.
    problem = problem.unmeasured
    wanted, left_out = _resolved(problem, spec)
    parts = WorkParts(progress, 1 + len(wanted) + settings.policies)
    points = []
    values = price_violations(problem, settings, parts.part(1.0))
    measure = FrontierEpisodes(values, spec.seed, spec.confidence)
    for (name, kind), resolved in wanted.items():
        try:
            points.append(measure.evaluated(name, kind, resolved, parts.part(spec.episodes)))
        except SafeEnvsError as error:
            if name not in spec.may_miss:
                raise
            left_out[name] = str(error)
    attained = [
        measure.at_price(i, spec.attained, parts.part(spec.attained))
        for i in range(len(values.of_policies))
    ]
    return Frontier(problem, values, attained, points, left_out, spec.confidence)


def _resolved(
    problem: SafetyProblem, spec: FrontierSpec
) -> tuple[dict[tuple[str, str], ResolvedEvaluation], dict[str, str]]:
    asked = [(name, "policy", policy, UNFILTERED) for name, policy in spec.policies.items()]
    asked += [(name, "filter", "nominal", name) for name in spec.filters]
    found, left_out = {}, {}
    for name, kind, policy, filter_name in asked:
        given = EvaluationSpec(
            problem=problem,
            policy=policy,
            filters=(filter_name,),
            trust=spec.trust,
            episodes=spec.episodes,
            seed=spec.seed,
            knowledge=spec.knowledge,
            confidence=spec.confidence,
            bounds=False,
        )
        try:
            found[name, "best" if name == "best" else kind] = ResolvedEvaluation(given)
        except SafeEnvsError as error:
            if name not in spec.may_miss:
                raise
            left_out[name] = str(error)
    return found, left_out
