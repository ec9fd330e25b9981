"""Episodes on a vector env, batch by batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge, Exponentials, smallest
from safe_envs.agents.evaluation.resolve import Env
from safe_envs.agents.evaluation.rows import (
    EpisodeResults,
    EpisodeSummary,
    EstimationCounts,
    EstimationResults,
)
from safe_envs.agents.evaluation.spec import Progress
from safe_envs.agents.evaluation.statistics import (
    CurveCounts,
    RunningSum,
    SafeFlags,
    SlightViolations,
    rate_interval,
    share,
    slight_violations,
)
from safe_envs.agents.jobs import job
from safe_envs.agents.jobs.executor import compute_in_order
from safe_envs.agents.policies.base import Policy, shapes_of
from safe_envs.agents.policies.registry import policy_name
from safe_envs.dynamics.codegen import Components
from safe_envs.dynamics.noise import episode_seeds
from safe_envs.envs.info import Info
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError, InvalidInputError, SafeEnvsError, shortened
from safe_envs.filters.decision_log import DecisionLog, LogColumns
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.monitor import SafetyMonitorVector
from safe_envs.wrappers.safety_filter import readable

_KEPT = 64


@dataclass(frozen=True)
class VisitedStates:
    """The states of episodes where a filter violated its conditions most, and where h was largest.

    Attributes:
        violating: states before a first violation of h where the filter violated its conditions
            most, one an episode, shape (E, n).
        actions: what was executed there, shape (E, m).
        slack: violation of the worst condition there, shape (E,), the largest first.
        deepest: states where the smallest h was largest, one an episode, shape (D, n).
        depth: h there, shape (D,), the largest first.
    """

    violating: np.ndarray
    actions: np.ndarray
    slack: np.ndarray
    deepest: np.ndarray
    depth: np.ndarray

    @classmethod
    def nothing(cls, problem: SafetyProblem) -> VisitedStates:
        """Return those of no episodes."""
        n, m = len(problem.states), len(problem.inputs)
        return cls(np.empty((0, n)), np.empty((0, m)), np.empty(0), np.empty((0, n)), np.empty(0))

    @classmethod
    def of(
        cls,
        violating: np.ndarray,
        actions: np.ndarray,
        slack: np.ndarray,
        deepest: np.ndarray,
        depth: np.ndarray,
    ) -> VisitedStates:
        """Return the most extreme ones of the states of episodes.

        Args:
            violating: where the slack was largest, shape (E, n).
            actions: what was executed there, shape (E, m).
            slack: violation of the worst condition there, 0 where none was, shape (E,).
            deepest: where the smallest h was largest, shape (E, n).
            depth: h there, shape (E,).
        """
        worst, highest = _first(slack), _first(depth)
        worst = worst[slack[worst] > 0.0]
        return cls(violating[worst], actions[worst], slack[worst], deepest[highest], depth[highest])

    def joined(self, other: VisitedStates) -> VisitedStates:
        """Return the most extreme states of both."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        violating, actions, slack, deepest, depth = (np.concatenate(pair) for pair in pairs)
        worst, highest = _first(slack), _first(depth)
        return VisitedStates(
            violating[worst], actions[worst], slack[worst], deepest[highest], depth[highest]
        )


def _first(values: np.ndarray) -> np.ndarray:
    """Where the largest values are, the largest first."""
    return np.argsort(-values, kind="stable")[:_KEPT]


class StateWatch:
    """Keeps the extreme states of each episode of a batch."""

    def __init__(self, x: Components, h: np.ndarray, inputs: int) -> None:
        self._deepest = np.stack(x)
        self.depth = h.copy()
        """Largest value of the smallest barrier in each episode up to a violation, shape (B,)."""
        self._violating, self._slack = np.zeros_like(self._deepest), np.zeros(len(h))
        self._actions = np.zeros((inputs, len(h)))
        self.lowest = np.stack(x)
        """States (n, B) where an episode that violates has its smallest h."""

    def add(
        self, before: Components, u: Components, slack: np.ndarray | None, counts: np.ndarray
    ) -> None:
        """Look at a step, from the state before it.

        Args:
            before: state before the step.
            u: what was executed.
            slack: violation of the worst condition, shape (B,); None without a filter.
            counts: the episodes without a violation so far.
        """
        if slack is None or not slack.any():
            return
        worse = counts & (slack > self._slack)
        if not worse.any():
            return
        np.copyto(self._slack, slack, where=worse)
        _keep(self._violating, before, worse)
        _keep(self._actions, u, worse)

    def reached(
        self, x: Components, h: np.ndarray, h_min: np.ndarray, alive: np.ndarray, counts: np.ndarray
    ) -> None:
        """Look at the state that a step led to.

        Args:
            x: the state.
            h: its smallest barrier.
            h_min: the smallest of the episode before it.
            alive: the episodes that go on.
            counts: those of them without a violation before.
        """
        higher = counts & (h > self.depth)
        np.copyto(self.depth, h, where=higher)
        _keep(self._deepest, x, higher)
        lower = alive & (h <= 0.0) & (h < h_min)
        if lower.any():
            _keep(self.lowest, x, lower)

    def visited(self, count: int) -> VisitedStates:
        """Return the extreme states of the first `count` episodes."""
        part = slice(count)
        return VisitedStates.of(
            self._violating.T[part],
            self._actions.T[part],
            self._slack[part],
            self._deepest.T[part],
            self.depth[part],
        )


def _keep(kept: np.ndarray, values: Any, where: np.ndarray) -> None:
    for row, value in zip(kept, values, strict=True):
        np.copyto(row, value, where=where)


class EpisodeBatch:
    """Counts of episodes that run side by side, an array entry for each.

    Those of ended and of surplus episodes stay as they are.
    """

    def __init__(
        self, size: int, count: int, h: np.ndarray, x: Components, inputs: int, info: Info
    ) -> None:
        self.watch = StateWatch(x, h, inputs)
        self.alive = np.arange(size) < count
        self.safe = h > 0.0
        self.h_min = h.copy()
        self.counted = np.zeros(size, dtype=np.int64)
        self.interventions = np.zeros(size, dtype=np.int64)
        self.infeasible = np.zeros(size, dtype=np.int64)
        self.lengths = np.zeros(size, dtype=np.int64)
        self.effort = np.zeros(size)
        self.returns = np.zeros(size)
        self.estimation = EstimationCounts(size, info) if "nees" in info else None

    def add(
        self,
        h: np.ndarray,
        x: tuple[Components, Components],
        u: Components,
        reward: np.ndarray,
        info: Info,
    ) -> None:
        """Count a step; for the filter only if the episode was safe up to its beginning.

        Args:
            h: smallest barrier value of the step.
            x: the states before and after it.
            u: what was executed.
            reward: of the step.
            info: of the env.
        """
        alive, counts = self.alive, self.alive & self.safe
        if self.estimation is not None:
            self.estimation.add(info, alive)
        self.watch.add(x[0], u, info.get("slack"), counts)
        self.watch.reached(x[1], h, self.h_min, alive, counts)
        self.counted += counts
        self.lengths += alive
        if "intervention" in info:
            self.interventions += counts & info["intervention"]
            self.infeasible += counts & ~info["feasible"]
        square = u[0] * u[0]
        for component in u[1:]:
            square = square + component * component
        self.effort += np.where(counts, square, 0.0)
        self.returns += np.where(alive, reward, 0.0)
        np.copyto(self.h_min, np.minimum(self.h_min, h), where=alive)
        self.safe &= (h > 0.0) | ~alive

    def results(self, count: int) -> EpisodeResults:
        """Return the results of the first `count` episodes."""
        # The steps that count are those up to the first violation, itself included.
        part = slice(count)
        safe, counted = self.safe[part], self.counted[part]
        return EpisodeResults(
            returns=self.returns[part],
            min_h=self.h_min[part],
            first_violation=np.where(safe, -1, counted).astype(np.int32),
            length=self.lengths[part].astype(np.int32),
            interventions=self.interventions[part].astype(np.int32),
            infeasible=self.infeasible[part].astype(np.int32),
            effort=np.where(counted > 0, self.effort[part] / np.maximum(counted, 1), np.nan),
        )

    def slight(self, problem: SafetyProblem, count: int) -> SlightViolations:
        """Return which violations among the first `count` episodes are no more than rounding.

        Args:
            problem: whose barriers they are.
            count: number of episodes.

        Returns:
            Their numbers, and the worst of them.
        """
        part = slice(count)
        return slight_violations(
            problem,
            ~self.safe[part],
            self.h_min[part],
            self.watch.depth[part],
            self.watch.lowest.T[part],
        )


@dataclass(frozen=True)
class PlayedBatch:
    """A batch of episodes that was simulated.

    Attributes:
        results: of each episode that counts.
        starts: their start states, shape (E, n).
        slight: violations that are no more than rounding.
        visited: states that may contradict a bound.
        estimation: sums over the estimates of each episode; None without an estimator.
    """

    results: EpisodeResults
    starts: np.ndarray
    slight: SlightViolations
    visited: VisitedStates
    estimation: EstimationResults | None = None


_KEPT_BARRIERS = 256
_KEPT_STATES = 32
_DECIDED = ("intervention", "feasible", "active_barrier")
_MOST_RECORDED = 1_000_000


class EpisodeRecorder:
    """Receives what happens in the episodes of a rollout; this one forgets it."""

    def note(self, k: int, first: int, present: np.ndarray, h: np.ndarray, x: Components) -> None:
        """Keep instant k of a batch that begins with the episode `first`.

        Args:
            k: the instant.
            first: number of the first episode.
            present: which episodes are under way, shape (B,).
            h: smallest barrier values, shape (B,).
            x: components of the states, each of shape (B,).
        """

    def note_decision(
        self, k: int, x: Components, barriers: np.ndarray, executed: Components, info: Info
    ) -> None:
        """Keep the decision at instant k of the first episode, which is the first of its batch.

        Args:
            k: the instant.
            x: components of the states at which was decided, each of shape (B,).
            barriers: their values there, shape (B, number of barriers).
            executed: components of the inputs, each of shape (B,).
            info: of the step, with the keys of a filter if there is one.
        """


class Trajectories(EpisodeRecorder):
    """Trajectories of the first episodes, NaN after their ends.

    Attributes:
        barrier: smallest barrier value, shape (steps + 1, at most 256).
        states: shape (steps + 1, at most 32, n).
        log: decisions of the first episode; without a filter, what was proposed is executed.

    Raises:
        ConfigurationError: an episode has more steps than a picture could show.
    """

    def __init__(self, problem: SafetyProblem, episodes: int) -> None:
        steps = problem.steps
        if steps > _MOST_RECORDED:
            raise ConfigurationError(
                f"an episode of {steps} steps is too long to draw; choose a horizon of at most"
                f" {_MOST_RECORDED} steps"
            )
        self.barrier = np.full((steps + 1, min(episodes, _KEPT_BARRIERS)), np.nan)
        self.states = np.full((steps + 1, min(episodes, _KEPT_STATES), problem.plant.n), np.nan)
        variables = (*problem.states, *problem.inputs)
        columns = LogColumns.of(
            problem.plant.states,
            problem.plant.inputs,
            [barrier.name for barrier in problem.barriers],
            units={each.symbol: each.unit for each in variables},
        )
        self.log = DecisionLog(columns)
        self._dt, self._bounds = problem.dt, np.transpose(problem.input_bounds)

    def note(self, k: int, first: int, present: np.ndarray, h: np.ndarray, x: Components) -> None:
        """See `EpisodeRecorder`."""
        self._put(self.barrier[k], first, present, h)
        for j, component in enumerate(x):
            self._put(self.states[k, :, j], first, present, component)

    def note_decision(
        self, k: int, x: Components, barriers: np.ndarray, executed: Components, info: Info
    ) -> None:
        """See `EpisodeRecorder`."""
        action = [float(component[0]) for component in executed]
        filtered = "safe_action" in info
        self.log.append(
            [
                k * self._dt,
                *(float(component[0]) for component in x),
                *(info["nominal_action"][0] if filtered else action),
                *action,
                *self._bounds[0],
                *self._bounds[1],
                *barriers[0],
                *(info["slacks"][0] if filtered else np.zeros(barriers.shape[1])),
                *((info[key][0] for key in _DECIDED) if filtered else (False, True, -1)),
            ]
        )

    @staticmethod
    def _put(row: np.ndarray, first: int, present: np.ndarray, values: np.ndarray) -> None:
        room = row[first : first + len(present)]
        np.copyto(room, values[: len(room)], where=present[: len(room)])


_PARTS = 4
"""Parts at least into which the work of each process is divided, so that there is progress."""

_LARGEST_PART = 65_536
"""Episodes of a part at most, as the results of all of them are sent at once."""


def episode_seed(seed: int, episode: int) -> int:
    """Return the seed of the env in an episode; see `episode_seeds`.

    Args:
        seed: of the evaluation.
        episode: its number.
    """
    return episode_seeds(seed, range(episode, episode + 1))[0]


def play(
    env: Env,
    policy: Any,
    episodes: range,
    seed: int,
    progress: Progress | None = None,
    trajectories: EpisodeRecorder | None = None,
    bridge: BrownianBridge | None = None,
) -> Iterator[PlayedBatch]:
    """Simulate consecutive episodes in batches of the size of the vector env.

    Args:
        env: with next-step autoreset: what it simulates after an episode's end is ignored.
        policy: anything with Stable-Baselines3's `predict`.
        episodes: their numbers.
        seed: of the evaluation, from which every episode gets a seed of its own.
        progress: called after every step with the number of episodes that are done; those under
            way count with the part that is done.
        trajectories: is filled, if given.
        bridge: gives the minimum h between control instants too; it changes neither control nor
            noise.

    Returns:
        Each batch once its episodes have ended.
    """
    world = readable(env)
    for first in range(episodes.start, episodes.stop, env.num_envs):
        count = min(env.num_envs, episodes.stop - first)
        rows = range(first, first + env.num_envs)
        with job.limited():
            if isinstance(policy, Policy):
                policy.begin(rows, seed)
            seeds = episode_seeds(seed, rows)
            started = env.reset(seed=seeds)
            starts = world.components
            watch = (
                None
                if bridge is None
                else _MinimumWatch(bridge, Exponentials(seeds, bridge.draws), starts, started)
            )
            batch = _play(env, policy, started, first, count, progress, trajectories, watch)
        yield PlayedBatch(
            batch.results(count),
            np.stack(starts, axis=1)[:count],
            batch.slight(world.problem, count),
            batch.watch.visited(count),
            batch.estimation and batch.estimation.results(count),
        )


def play_in_processes(
    make_env: Callable[[int], Env],
    policy: Any,
    episodes: int,
    seed: int,
    num_envs: int,
    jobs: int,
    continuous: bool,
    progress: Progress | None,
) -> Iterator[PlayedBatch]:
    """Simulate episodes 0..episodes-1 by `jobs` processes, which remain for the next call.

    Args:
        make_env: makes a vector env of a size.
        policy: anything with Stable-Baselines3's `predict`.
        episodes: how many.
        seed: of the evaluation, from which every episode gets a seed of its own.
        num_envs: how many to simulate side by side in each process, at most.
        jobs: number of processes.
        continuous: whether to monitor h between control instants.
        progress: receives the number of episodes that are done.

    Returns:
        The batches in the order of the episodes.

    Raises:
        ConfigurationError: Something cannot be sent to a process, mostly a custom policy.
        WorkersLostError: A process was ended from outside.
    """
    size = min(max(1, math.ceil(episodes / (jobs * _PARTS))), _LARGEST_PART)
    parts = [range(first, min(first + size, episodes)) for first in range(0, episodes, size)]
    shared = (make_env, policy, seed, num_envs, continuous)
    for part, batches in zip(parts, compute_in_order(_played, shared, parts, jobs), strict=True):
        yield from batches
        if progress:
            progress(part.stop)


def _played(
    shared: tuple[Callable[[int], Env], Any, int, int, bool], part: range
) -> list[PlayedBatch]:
    make_env, policy, seed, num_envs, continuous = shared
    env = make_env(min(num_envs, len(part)))
    bridge = BrownianBridge(readable(env).problem) if continuous else None
    try:
        return list(play(env, policy, part, seed, bridge=bridge))
    finally:
        env.close()


class _MinimumWatch:
    """Draws the minimum h during each period of a batch."""

    def __init__(
        self,
        bridge: BrownianBridge,
        draws: Exponentials,
        x: Components,
        started: tuple[np.ndarray, Info],
    ) -> None:
        self._bridge, self._draws, self._x = bridge, draws, x
        self._barriers = started[1]["barrier"]

    def minimum(self, x: Components, barriers: np.ndarray) -> np.ndarray:
        """Return the minimum h of the period that led to the states x, shape (B,)."""
        found = self._bridge.sample_minimum(self._x, self._barriers, barriers, self._draws.next())
        self._x, self._barriers = x, barriers
        return smallest(found)


def _play(
    env: Env,
    policy: Any,
    started: tuple[np.ndarray, Info],
    first: int,
    count: int,
    progress: Progress | None,
    trajectories: EpisodeRecorder | None,
    watch: _MinimumWatch | None,
) -> EpisodeBatch:
    """Simulate a batch that was just reset and begins with the episode `first`."""
    world = readable(env)
    steps = world.problem.steps
    observation, info = started
    h = smallest(info["barrier"])
    batch = EpisodeBatch(len(h), count, h, world.components, len(world.problem.inputs), info)
    if trajectories:
        trajectories.note(0, first, batch.alive, h, world.components)
    state, start = None, np.ones(len(h), dtype=bool)
    for k in range(1, steps + 1):
        actions, state = acted(policy, observation, state, start)
        before, barriers = world.components, info["barrier"]
        observation, reward, terminated, truncated, info = env.step(actions)
        h, executed = smallest(info["barrier"]), _executed(world, actions, info)
        lowest = h if watch is None else watch.minimum(world.components, info["barrier"])
        if trajectories and first == 0 and batch.alive[0]:
            trajectories.note_decision(k - 1, before, barriers, executed, info)
        batch.add(lowest, (before, world.components), executed, reward, info)
        if trajectories:
            trajectories.note(k, first, batch.alive, h, world.components)
        start = terminated | truncated
        batch.alive &= ~start
        if progress:
            progress(first + count * k / steps)
        if not batch.alive.any():
            break
    if progress:
        progress(first + count)
    return batch


def acted(policy: Any, observation: Any, state: Any, start: np.ndarray) -> tuple[Any, Any]:
    """Return the actions and the state of a policy, whose failure is that of what was given.

    Args:
        policy: anything with Stable-Baselines3's `predict`.
        observation: of each env, shape (B, k) mostly.
        state: of the policy, as it returned it last; None at first.
        start: which envs begin an episode, bool (B,).

    Returns:
        The actions, shape (B, m), and the state.

    Raises:
        InvalidInputError: The policy failed.
    """
    try:
        actions, state = policy.predict(observation, state, start, deterministic=True)
    except SafeEnvsError:
        raise
    except (Exception, SystemExit) as error:
        raise InvalidInputError(
            f"the policy {policy_name(policy)} failed on observations {shapes_of(observation)}"
            f" ({type(error).__name__}: {shortened(error)}); predict(observation, state,"
            " episode_start, deterministic) returns the actions and the next state"
        ) from error
    return actions, state


def _executed(
    world: SafeVectorEnv | SafetyMonitorVector, actions: np.ndarray, info: Info
) -> Components:
    """Return the components of the executed input in physical units."""
    if "executed_action" in info:
        return tuple(info["executed_action"].T)
    return tuple(info["safe_action"].T) if "safe_action" in info else world.physical_action(actions)


_QUANTILES_OF = 65_536
"""Episodes of which quantiles are taken, the first ones: enough, as they are independent."""


class EpisodeStatistics:
    """The episodes under one filter, batch by batch.

    They need one bit for each episode, and are the same, to the last bit, however the episodes are
    divided into batches.

    Args:
        problem: whose episodes they are.

    Attributes:
        safe: which episodes are safe.
        steps: control periods of all episodes.
        visited: states that may contradict a bound.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self._problem = problem
        self.safe = SafeFlags()
        self.steps = 0
        self.visited = VisitedStates.nothing(problem)
        self._slight = SlightViolations(0, 0, 0.0)
        self._curve = CurveCounts(problem.steps)
        self._min_h = np.empty(_QUANTILES_OF)
        self._safe = self._counted = self._interventions = self._infeasible = 0
        self._returns, self._efforts, self._with_effort = RunningSum(), RunningSum(), 0
        self._estimation: list[EstimationResults] = []

    def add(self, batch: PlayedBatch) -> None:
        """Add a batch."""
        found = batch.results
        counted, begun = found.counted, len(self.safe)
        moved = counted > 0
        if begun < _QUANTILES_OF:
            part = self._min_h[begun : begun + len(counted)]
            part[:] = found.min_h[: len(part)]
        self.safe.add(found.safe)
        self.steps += int(found.length.sum())
        self.visited = self.visited.joined(batch.visited)
        self._slight = self._slight.joined(batch.slight)
        self._curve.add(found.first_violation)
        self._safe += int(np.count_nonzero(found.safe))
        self._counted += int(counted.sum())
        self._interventions += int(found.interventions.sum())
        self._infeasible += int(found.infeasible.sum())
        self._returns.add(found.returns)
        self._efforts.add(found.effort[moved])
        self._with_effort += int(np.count_nonzero(moved))
        if batch.estimation is not None:
            self._estimation.append(batch.estimation)

    @property
    def estimation(self) -> EstimationResults | None:
        """Sums over the estimates of each episode; None without an estimator."""
        return EstimationResults.joined(self._estimation) if self._estimation else None

    def summary(self, confidence: float) -> EpisodeSummary:
        """Return statistics with intervals of a confidence; None where no step counts."""
        episodes, safe = len(self.safe), self._safe
        low, high = rate_interval(safe, episodes, confidence)
        h = self._min_h[:episodes]
        # Between -inf and a number there is nothing.
        method = "linear" if np.isfinite(h).all() else "lower"
        p05, median = np.quantile(h, (0.05, 0.5), method=method).tolist()
        return EpisodeSummary(
            episodes=episodes,
            safe=safe,
            safety_rate=safe / episodes,
            ci_low=low,
            ci_high=high,
            min_h_median=median,
            min_h_p05=p05,
            violations=episodes - safe,
            touching=self._slight.touching,
            below_rounding=self._slight.below,
            worst_below_rounding=self._slight.worst,
            intervention_rate=share(self._interventions, self._counted),
            infeasible_rate=share(self._infeasible, self._counted),
            effort_mean=share(self._efforts.total, self._with_effort),
            return_mean=self._returns.total / episodes,
            curve=self._curve.curve(self._problem.dt, confidence),
        )
