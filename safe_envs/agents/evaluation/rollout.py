"""Episodes in waves on a vector env: what is counted, and what is kept for pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge, Exponentials, smallest
from safe_envs.agents.evaluation.comparison import SafetyBits
from safe_envs.agents.evaluation.rounding import may_touch, touches
from safe_envs.agents.evaluation.statistics import (
    FirstValues,
    RunningSum,
    SafetyCurve,
    rate_interval,
    share,
)
from safe_envs.agents.evaluation.visited_states import Seen, Watch
from safe_envs.agents.jobs import blas_threads
from safe_envs.agents.policies.base import Policy
from safe_envs.dynamics.codegen import Components
from safe_envs.envs.info import Info
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyMonitorVector
from safe_envs.wrappers.env_wrappers.safety_filter_vector import readable

Env = SafeVectorEnv | SafetyMonitorVector | SafetyFilterVectorWrapper
Progress = Callable[[float], None]
OnStart = Callable[[Components, int], None]
Row = dict[str, Any]

_KEPT_BARRIERS = 256
_KEPT_STATES = 32
_MOST_RECORDED = 1_000_000


def episode_seed(seed: int, episode: int) -> int:
    """Seed of the env in an episode of an evaluation: its own child of the evaluation's seed."""
    return int(np.random.SeedSequence(seed, spawn_key=(episode,)).generate_state(1, np.uint64)[0])


class Recorder:
    """Trajectories of the first episodes, NaN after their ends.

    Attributes:
        barrier: smallest barrier value, shape (steps + 1, at most 256).
        states: shape (steps + 1, at most 32, n).

    Raises:
        ConfigurationError: an episode has more steps than a picture could show.
    """

    def __init__(self, steps: int, states: int, episodes: int) -> None:
        if steps > _MOST_RECORDED:
            raise ConfigurationError(
                f"an episode of {steps} steps is too long to draw; choose a horizon of at most"
                f" {_MOST_RECORDED} steps"
            )
        self.barrier = np.full((steps + 1, min(episodes, _KEPT_BARRIERS)), np.nan)
        self.states = np.full((steps + 1, min(episodes, _KEPT_STATES), states), np.nan)

    def note(self, k: int, first: int, present: np.ndarray, h: np.ndarray, x: Components) -> None:
        """Keep instant k of a wave that begins with the episode `first`."""
        self._put(self.barrier[k], first, present, h)
        for j, component in enumerate(x):
            self._put(self.states[k, :, j], first, present, component)

    @staticmethod
    def _put(row: np.ndarray, first: int, present: np.ndarray, values: np.ndarray) -> None:
        room = row[first : first + len(present)]
        np.copyto(room, values[: len(room)], where=present[: len(room)])


class EpisodeBatch:
    """Counts of episodes that run side by side, an array entry for each; ended and surplus ones
    stay as they are."""

    def __init__(self, size: int, count: int, h: np.ndarray, x: Components, inputs: int) -> None:
        self.watch = Watch(x, h, inputs)
        self.alive = np.arange(size) < count
        self.safe = h > 0.0
        self.h_min = h.copy()
        self.counted = np.zeros(size, dtype=np.int64)
        self.interventions = np.zeros(size, dtype=np.int64)
        self.infeasible = np.zeros(size, dtype=np.int64)
        self.lengths = np.zeros(size, dtype=np.int64)
        self.effort = np.zeros(size)
        self.returns = np.zeros(size)

    def add(
        self,
        h: np.ndarray,
        x: tuple[Components, Components],
        u: Components,
        reward: np.ndarray,
        info: Info,
    ) -> None:
        """Count a step with its smallest h; it counts for the filter only if the episode was safe
        up to its beginning.

        Args:
            h: smallest barrier value of the step.
            x: the states before and after it.
            u: what was executed.
            reward: of the step.
            info: of the env.
        """
        alive, counts = self.alive, self.alive & self.safe
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

    def first_violation(self, never: int) -> np.ndarray:
        """Instant of each episode's first violation, or `never`, shape (B,)."""
        # The steps that count are those up to it.
        return np.where(self.safe, never, self.counted)


class EpisodeStatistics:
    """Sums over the episodes of a row, wave by wave.

    Args:
        problem: whose episodes they are.

    Attributes:
        flags: which of the episodes were safe.
        seen: states that say something against a bound.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self.episodes = self.safe = self.steps = self._touching = 0
        self.seen = Seen.nothing(problem)
        self._problem = problem
        self.flags = SafetyBits()
        self._curve, self._dt, self._never = (
            SafetyCurve(problem.steps),
            problem.dt,
            problem.steps + 1,
        )
        self._counted = self._interventions = self._infeasible = self._with_effort = 0
        self._effort, self._return, self._h_min = RunningSum(), RunningSum(), FirstValues()

    def add(self, wave: EpisodeBatch, count: int) -> None:
        """Add the first `count` episodes of a wave."""
        self.episodes += count
        self.safe += int(wave.safe[:count].sum())
        self.flags.add(wave.safe[:count])
        self._curve.add(wave.first_violation(self._never)[:count])
        self.steps += int(wave.lengths[:count].sum())
        self._counted += int(wave.counted[:count].sum())
        self._interventions += int(wave.interventions[:count].sum())
        self._infeasible += int(wave.infeasible[:count].sum())
        some = wave.counted[:count] > 0
        self._with_effort += int(some.sum())
        self._effort.add(wave.effort[:count][some] / wave.counted[:count][some])
        self._return.add(wave.returns[:count])
        self._h_min.add(wave.h_min[:count])
        self.seen = self.seen.joined(wave.watch.seen(count))
        near = ~wave.safe[:count] & may_touch(wave.h_min[:count], wave.watch.depth[:count])
        if near.any():
            self._touching += int(
                touches(
                    self._problem, wave.h_min[:count][near], wave.watch.lowest.T[:count][near]
                ).sum()
            )

    def row(self, confidence: float) -> Row:
        """The statistics of the episodes, with intervals of a confidence; None where no step
        counts."""
        low, high = rate_interval(self.safe, self.episodes, confidence)
        p05, median = self._h_min.quantiles((0.05, 0.5))
        return {
            "episodes": self.episodes,
            "safe": self.safe,
            "safety_rate": self.safe / self.episodes,
            "ci_low": low,
            "ci_high": high,
            "min_h_median": median,
            "min_h_p05": p05,
            "violations": self.episodes - self.safe,
            "touching": self._touching,
            "intervention_rate": share(self._interventions, self._counted),
            "infeasible_rate": share(self._infeasible, self._counted),
            "effort_mean": share(self._effort.total, self._with_effort),
            "return_mean": self._return.total / self.episodes,
            "curve": self._curve.row(self._dt, confidence),
        }


def run_episodes(
    env: Env,
    policy: Any,
    episodes: int,
    seed: int,
    progress: Progress | None = None,
    recorder: Recorder | None = None,
    on_start: OnStart | None = None,
    bridge: BrownianBridge | None = None,
) -> EpisodeStatistics:
    """Simulate episodes 0..episodes-1 in waves of the size of the vector env.

    Args:
        env: with next-step autoreset: what it simulates after an episode's end is ignored.
        policy: anything with Stable-Baselines3's `predict`.
        episodes: how many.
        seed: whose children seed the episodes.
        progress: told, after every step, how many episodes are done; the fraction tells of those
            under way.
        recorder: keeps trajectories, if any.
        on_start: given the components of the start states of each wave, arrays of shape
            (num_envs,), and how many of them, from the first, are of episodes that count.
        bridge: looks at h between control instants too; it changes neither control nor noise.
    """
    return totals_of(
        readable(env).problem,
        play(env, policy, range(episodes), seed, progress, recorder, bridge),
        on_start,
    )


@dataclass(frozen=True)
class Played:
    """A wave that was simulated.

    Attributes:
        wave: its counts.
        count: how many of its episodes, from the first, count.
        starts: components of their start states, arrays of shape (num_envs,).
    """

    wave: EpisodeBatch
    count: int
    starts: Components


def totals_of(
    problem: SafetyProblem, waves: Iterable[Played], on_start: OnStart | None = None
) -> EpisodeStatistics:
    """Add up waves, in order; see `run_episodes` for `on_start`."""
    totals = EpisodeStatistics(problem)
    for played in waves:
        if on_start:
            on_start(played.starts, played.count)
        totals.add(played.wave, played.count)
    return totals


def play(
    env: Env,
    policy: Any,
    episodes: range,
    seed: int,
    progress: Progress | None = None,
    recorder: Recorder | None = None,
    bridge: BrownianBridge | None = None,
) -> Iterator[Played]:
    """Simulate consecutive episodes wave by wave; see `run_episodes` for the arguments."""
    world = readable(env)
    for first in range(episodes.start, episodes.stop, env.num_envs):
        count = min(env.num_envs, episodes.stop - first)
        rows = range(first, first + env.num_envs)
        with blas_threads.limited():
            if isinstance(policy, Policy):
                policy.begin(rows, seed)
            started = env.reset(seed=[episode_seed(seed, i) for i in rows])
            starts = world.components
            watch = (
                None
                if bridge is None
                else _Watch(bridge, Exponentials(seed, rows, bridge.draws), starts, started[1])
            )
            wave = _play(env, policy, started, first, count, progress, recorder, watch)
        yield Played(wave, count, starts)


class _Watch:
    """Looks at h during each period of a wave."""

    def __init__(
        self, bridge: BrownianBridge, draws: Exponentials, x: Components, info: Info
    ) -> None:
        self._bridge, self._draws, self._x, self._barriers = bridge, draws, x, info["barrier"]

    def lowest(self, x: Components, barriers: np.ndarray) -> np.ndarray:
        """Smallest h of the period that led to states, shape (B,)."""
        found = self._bridge.lowest(self._x, self._barriers, barriers, self._draws.next())
        self._x, self._barriers = x, barriers
        return smallest(found)


def _play(
    env: Env,
    policy: Any,
    started: tuple[np.ndarray, Info],
    first: int,
    count: int,
    progress: Progress | None,
    recorder: Recorder | None,
    watch: _Watch | None,
) -> EpisodeBatch:
    """Simulate a wave that was just reset, and that begins with the episode `first`."""
    world = readable(env)
    steps = world.problem.steps
    observation, info = started
    h = smallest(info["barrier"])
    wave = EpisodeBatch(len(h), count, h, world.components, len(world.problem.inputs))
    if recorder:
        recorder.note(0, first, wave.alive, h, world.components)
    state, start = None, np.ones(len(h), dtype=bool)
    for k in range(1, steps + 1):
        actions, state = policy.predict(observation, state, start, deterministic=True)
        before = world.components
        observation, reward, terminated, truncated, info = env.step(actions)
        h = smallest(info["barrier"])
        lowest = h if watch is None else watch.lowest(world.components, info["barrier"])
        wave.add(lowest, (before, world.components), _executed(world, actions, info), reward, info)
        if recorder:
            recorder.note(k, first, wave.alive, h, world.components)
        start = terminated | truncated
        wave.alive &= ~start
        if progress:
            progress(first + count * k / steps)
        if not wave.alive.any():
            break
    if progress:
        progress(first + count)
    return wave


def _executed(
    world: SafeVectorEnv | SafetyMonitorVector, actions: np.ndarray, info: Info
) -> Components:
    """Components of the executed input in physical units."""
    return tuple(info["safe_action"].T) if "safe_action" in info else world.physical_action(actions)
