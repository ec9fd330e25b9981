"""Episodes by a compiled program, in threads."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from functools import cached_property, partial
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import (
    BrownianBridge,
    bridge_rates,
    reached_by_noise,
)
from safe_envs.agents.evaluation.episode_kernel import bridge_minimum, play_episodes
from safe_envs.agents.evaluation.episodes import (
    EpisodeRecorder,
    PlayedBatch,
    VisitedStates,
    play,
    play_in_processes,
)
from safe_envs.agents.evaluation.resolve import Env, FilterParts, ResolvedEvaluation
from safe_envs.agents.evaluation.rows import EpisodeResults
from safe_envs.agents.evaluation.spec import Progress, RunSettings
from safe_envs.agents.evaluation.statistics import slight_violations
from safe_envs.agents.jobs.job import available_threads
from safe_envs.agents.policies.policy_source import policy_source
from safe_envs.dynamics.noise import key_of
from safe_envs.engine.choice import compiled_or_none, periods_of_a_part
from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.program import Functions, Program
from safe_envs.engine.slots import Data
from safe_envs.envs.world_source import noise_channels, world_source
from safe_envs.errors import NotCompilableError, shortened
from safe_envs.filters.conditions.text import FilterSettings
from safe_envs.filters.decision_source import filter_source, unfiltered_source
from safe_envs.filters.qp import FilterQP
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.backup_filter import BackupFilter, BackupSettings

Decider = FilterQP | BackupFilter
"""What decides: a QP of conditions, or a filter that acts by itself."""


def decider_of(resolved: ResolvedEvaluation, parts: FilterParts) -> Decider | None:
    """Return what decides under a filter; None for the unfiltered env.

    Args:
        resolved: what to simulate.
        parts: of the filter.

    Raises:
        NotCompilableError: NumPy alone can.
    """
    problem, spec = resolved.problem, resolved.spec
    if isinstance(parts, BackupSettings):
        return BackupFilter.for_problem(problem, parts, spec.knowledge)
    if isinstance(parts, FilterSettings):
        raise NotCompilableError(f"the filter {parts.text} {parts.not_compiled}")
    if not parts:
        return None
    return SafetyFilter.for_problem(problem, parts, spec.knowledge, spec.objective).qp


def decision_source(decider: Decider | None, inputs: int, data: Data) -> Source:
    """Return the function `decide` of `safe_envs.engine.slots`.

    Args:
        decider: what decides; None to let every input pass.
        inputs: their number.
        data: receives the numbers.

    Raises:
        NotCompilableError: The filter has no compiled form.
    """
    if decider is None:
        return unfiltered_source(inputs)
    if isinstance(decider, BackupFilter):
        return decider.source(data)
    return filter_source(decider, data)


_HEAD = "def lowest_between(x, before, after, uniforms, first, data):\n"


def bridge_draws(problem: SafetyProblem, continuous: bool) -> int:
    """Return the uniforms that a control period takes for its bridges.

    Args:
        problem: whose barriers they are of.
        continuous: whether h is looked at between control instants too.
    """
    return len(problem.barriers) if continuous and any(reached_by_noise(problem)) else 0


def bridge_source(problem: SafetyProblem, continuous: bool, data: Data) -> Source:
    """Return `lowest_between` and `no_barriers` of `safe_envs.engine.slots`.

    Args:
        problem: whose barriers are looked at.
        continuous: whether to look between control instants too.
        data: receives its numbers.
    """
    nothing = Source(f"def no_barriers(data):\n    return ({'nan, ' * len(problem.barriers)})\n")
    return nothing + _lowest(problem, continuous, data)


def _lowest(problem: SafetyProblem, continuous: bool, data: Data) -> Source:
    if not continuous:
        return Source(f"{_HEAD}    return smallest_barrier(after)\n")
    if not bridge_draws(problem, continuous):
        return Source(f"{_HEAD}    return min(smallest_barrier(before), smallest_barrier(after))\n")
    rates = formulas("bridge_rates", {"x": problem.plant.states}, bridge_rates(problem), data)
    each = "".join(
        f"bridge_minimum(before[{i}], after[{i}], rates[{i}], uniforms[first + {i}]), "
        for i in range(len(problem.barriers))
    )
    lines = f"    rates = bridge_rates(x, data)\n    return smallest_barrier(({each}))\n"
    return rates + Source(_HEAD + lines, (bridge_minimum,))


_PARTS = 8
"""Parts for each thread at least, so that all threads end at about the same time."""

_AHEAD = 64
"""Control periods for which noise is drawn ahead at most."""


class CompiledEpisodes:
    """The episodes of a problem under a policy and a filter, as a compiled program.

    Args:
        problem: what to simulate.
        policy: who acts.
        decider: of the filter; None without one.
        continuous: whether to monitor h between control instants.

    Raises:
        NotCompilableError: The policy or the filter is none that can be compiled.
    """

    def __init__(
        self, problem: SafetyProblem, policy: Any, decider: Decider | None, continuous: bool
    ) -> None:
        data = Data()
        source = (
            world_source(problem, data)
            + policy_source(policy, problem, data)
            + decision_source(decider, len(problem.inputs), data)
            + bridge_source(problem, continuous, data)
        )
        self._problem, self._data, self._work = problem, data.array(), max(source.work, 1)
        channels, draws = noise_channels(problem), bridge_draws(problem, continuous)
        parts = math.ceil(problem.steps / _AHEAD)
        ahead = 4 * math.ceil(problem.steps / (4 * parts))
        self._sizes = problem.steps, ahead, channels, draws
        self._uniforms = len(problem.starts[problem.start].uniforms)
        what = "episodes" if decider is None else "filtered episodes"
        self.program = Program(f"{what} of {problem.name}", (play_episodes,), source)

    def compiled(self) -> Functions:
        """Return the entry points of the program, compiled.

        Raises:
            ConfigurationError: Numba is not installed.
            NotCompilableError: Numba cannot compile a formula.
        """
        functions = self.program.compiled()
        try:
            # The first call compiles: an error shows before a long run, and timing is of steps.
            self._simulate(functions, range(0), _key(0))
        except Exception as error:
            raise NotCompilableError(
                f"Numba cannot compile {self._problem.name}: {shortened(error)}"
            ) from error
        return functions

    def play(
        self,
        functions: Functions,
        episodes: range,
        seed: int,
        threads: int,
        again: Callable[[range], Iterable[PlayedBatch]],
    ) -> Iterator[PlayedBatch]:
        """Simulate consecutive episodes.

        Args:
            functions: entry points of the program.
            episodes: their numbers.
            seed: of the evaluation.
            threads: how many simulate side by side.
            again: simulates by NumPy the episodes of a part of the work from one on in which
                something has no finite value, and says what.

        Returns:
            The batches in the order of the episodes.
        """
        size = periods_of_a_part(len(self._data)) // self._problem.steps
        size = max(1, min(size, len(episodes) // (_PARTS * threads)))
        parts = (
            range(first, min(first + size, episodes.stop))
            for first in range(episodes.start, episodes.stop, size)
        )
        for part, batch in self._in_order(functions, parts, seed, threads):
            done = len(batch.starts)
            if done:
                yield batch
            if done < len(part):
                yield from again(part[done:])

    def _in_order(
        self, functions: Functions, parts: Iterable[range], seed: int, threads: int
    ) -> Iterator[tuple[range, PlayedBatch]]:
        """Simulate parts of the work side by side, a few of them ahead of what is asked for."""
        key = _key(seed)
        under_way: deque[tuple[range, Future[PlayedBatch]]] = deque()
        with ExitStack() as stack:
            pool = ThreadPoolExecutor(threads, "safe_envs_episodes")
            stack.callback(pool.shutdown, cancel_futures=True)
            for part in parts:
                under_way.append((part, pool.submit(self._simulate, functions, part, key)))
                if len(under_way) > 2 * threads:
                    first, future = under_way.popleft()
                    yield first, future.result()
            for first, future in under_way:
                yield first, future.result()

    def _simulate(self, functions: Functions, part: range, key: tuple[Any, ...]) -> PlayedBatch:
        """Simulate a part of the work, as far as it has finite values."""
        problem, count = self._problem, len(part)
        _, ahead, channels, draws = self._sizes
        numbers, counts = np.empty((count, 5)), np.empty((count, 4), dtype=np.int64)
        states = np.empty((count, 4, problem.plant.n))
        inputs = np.zeros((count, len(problem.inputs)))
        done = functions["play_episodes"](
            part.start,
            *key,
            self._sizes,
            problem.dt,
            numbers,
            counts,
            states,
            inputs,
            self._data,
            np.empty(3 * ahead * channels),
            np.empty(ahead * draws),
            np.empty(self._uniforms),
            np.empty(self._work),
        )
        return _batch(problem, numbers[:done], counts[:done], states[:done], inputs[:done])


def _key(seed: int) -> tuple[np.uint64, np.uint64]:
    """Return the key of a seed, always of the types for which a program is compiled."""
    first, second = key_of(seed)
    return np.uint64(first), np.uint64(second)


def _batch(
    problem: SafetyProblem,
    numbers: np.ndarray,
    counts: np.ndarray,
    states: np.ndarray,
    inputs: np.ndarray,
) -> PlayedBatch:
    """Return what a program found out about episodes; see `episode_kernel` for the arrays."""
    returns, h_min, effort, depth, slack = (column.copy() for column in numbers.T)
    whole = counts.T.astype(np.int32)
    results = EpisodeResults(returns, h_min, whole[0], whole[1], whole[2], whole[3], effort)
    start, deepest, violating, lowest = (states[:, i].copy() for i in range(4))
    return PlayedBatch(
        results,
        start,
        slight_violations(problem, ~results.safe, h_min, depth, lowest),
        VisitedStates.of(violating, inputs, slack, deepest, depth),
    )


class NumpyPlayer:
    """Steps many envs at once.

    Args:
        resolved: what to simulate.
        conditions: of the filter, see `FilterParts`.
        settings: how it is run.

    Attributes:
        engine: "numpy".
        jobs: processes.

    Raises:
        SafeEnvsError: The envs cannot be made, or fail at a first step.
    """

    engine = "numpy"

    def __init__(
        self, resolved: ResolvedEvaluation, conditions: FilterParts, settings: RunSettings
    ) -> None:
        spec = self._spec = resolved.spec
        self._resolved, self._conditions = resolved, conditions
        self._size, self.jobs = min(settings.num_envs, spec.episodes), settings.jobs or 1
        continuous = spec.monitoring == "continuous"
        self._bridge = BrownianBridge(resolved.problem) if continuous else None
        self._env: Env = resolved.env(conditions, self._size)

    def play(
        self, progress: Progress | None = None, trajectories: EpisodeRecorder | None = None
    ) -> Iterator[PlayedBatch]:
        """Simulate all episodes.

        Args:
            progress: called with the number of episodes that are done.
            trajectories: is filled, if given.

        Returns:
            The batches in the order of the episodes.
        """
        spec = self._spec
        if self.jobs == 1:
            return self.part(range(spec.episodes), progress, trajectories)
        return play_in_processes(
            partial(self._resolved.env, self._conditions),
            self._resolved.policy,
            spec.episodes,
            spec.seed,
            self._size,
            self.jobs,
            self._bridge is not None,
            progress,
        )

    def part(
        self,
        episodes: range,
        progress: Progress | None = None,
        trajectories: EpisodeRecorder | None = None,
    ) -> Iterator[PlayedBatch]:
        """Simulate some of the episodes in this process; see `play`."""
        return play(
            self._env,
            self._resolved.policy,
            episodes,
            self._spec.seed,
            progress,
            trajectories,
            self._bridge,
        )

    def close(self) -> None:
        """Close the envs."""
        self._env.close()


class CompiledPlayer:
    """Runs a compiled program; the arguments are those of `NumpyPlayer`.

    Attributes:
        engine: "compiled"; "compiled, numpy" once NumPy had to simulate a part of the work again.
        jobs: threads, at most as many as processors.

    Raises:
        NotCompilableError: Only NumPy can do this.
        ConfigurationError: Numba is missing.
        SafeEnvsError: The filter cannot be made.
    """

    def __init__(
        self, resolved: ResolvedEvaluation, conditions: FilterParts, settings: RunSettings
    ) -> None:
        spec = self._spec = resolved.spec
        if resolved.target.filter_spec is not None:
            raise NotCompilableError(
                f"{resolved.target.title} is a third-party env, which only its own code can step"
            )
        if settings.record:
            raise NotCompilableError(
                "trajectories for pictures are kept by the engine 'numpy' alone"
            )
        decider = decider_of(resolved, conditions)
        continuous = spec.monitoring == "continuous"
        self._episodes = CompiledEpisodes(resolved.problem, resolved.policy, decider, continuous)
        self._functions = self._episodes.compiled()
        self.engine = "compiled"
        self.jobs = min(settings.jobs or available_threads(), os.cpu_count() or 1)
        self._reference = partial(NumpyPlayer, resolved, conditions, settings)

    @cached_property
    def _numpy(self) -> NumpyPlayer:
        return self._reference()

    def play(
        self, progress: Progress | None = None, trajectories: EpisodeRecorder | None = None
    ) -> Iterator[PlayedBatch]:
        """Simulate all episodes; see `NumpyPlayer.play`."""
        done = 0
        for batch in self._episodes.play(
            self._functions,
            range(self._spec.episodes),
            self._spec.seed,
            self.jobs,
            self._again,
        ):
            yield batch
            done += len(batch.starts)
            if progress:
                progress(done)

    def _again(self, episodes: range) -> Iterator[PlayedBatch]:
        self.engine = "compiled, numpy"
        return self._numpy.part(episodes)

    def close(self) -> None:
        """Do nothing: there is nothing to close."""


Player = NumpyPlayer | CompiledPlayer


def player_of(
    resolved: ResolvedEvaluation, conditions: FilterParts, settings: RunSettings
) -> Player:
    """Return who simulates the episodes under a filter; see `RunSettings.engine`.

    Args:
        resolved: what to simulate.
        conditions: of the filter, see `FilterParts`.
        settings: how it is run.

    Raises:
        NotCompilableError: The compiled engine was asked for, and cannot do this.
        SafeEnvsError: What is to be simulated cannot be made.
    """
    periods = resolved.spec.episodes * resolved.problem.steps
    compiled = compiled_or_none(
        settings.engine, periods, partial(CompiledPlayer, resolved, conditions, settings)
    )
    return compiled or NumpyPlayer(resolved, conditions, settings)
