"""Episodes by a compiled program, in threads."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.bridge_source import bridge_draws, bridge_source
from safe_envs.agents.evaluation.decision_source import Decider, decision_source
from safe_envs.agents.evaluation.episode_batch import PlayedBatch
from safe_envs.agents.evaluation.episode_kernel import play_episodes
from safe_envs.agents.evaluation.rounding import slight_violations
from safe_envs.agents.evaluation.rows import EpisodeResults
from safe_envs.agents.evaluation.visited_states import VisitedStates
from safe_envs.agents.policies.policy_source import policy_source
from safe_envs.compiled.data import Data
from safe_envs.compiled.engine import periods_of_a_part
from safe_envs.compiled.program import Functions, Program
from safe_envs.dynamics.philox import key_of
from safe_envs.envs.world_source import noise_channels, world_source
from safe_envs.errors import NotCompilableError, shortened
from safe_envs.problem.problem import SafetyProblem

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
