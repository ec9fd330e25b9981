"""Paths by a compiled program, in threads."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import reached_by_noise
from safe_envs.agents.evaluation.decision_source import Decider, decision_source
from safe_envs.agents.policies.policy_source import policy_source
from safe_envs.agents.rare_events.heights import Heights
from safe_envs.agents.rare_events.particles import PathPlayer
from safe_envs.agents.rare_events.path_kernel import FAILED, FULL, draw_path_starts, play_paths
from safe_envs.agents.rare_events.path_source import path_source
from safe_envs.agents.rare_events.records import Records
from safe_envs.compiled.data import Data
from safe_envs.compiled.engine import periods_of_a_part
from safe_envs.compiled.program import Functions, Program
from safe_envs.envs.world_source import noise_channels, world_source
from safe_envs.errors import NotCompilableError, shortened
from safe_envs.problem.problem import SafetyProblem

_AHEAD = 16
"""Control periods for which noise is drawn ahead at most; a path may end at any time."""

_FEWEST_PATHS = 64
_PARTS = 4
"""Paths of a part of the work at least, and parts for each thread."""


class PathProgram:
    """What plays the paths of a problem under a policy and a filter, as a compiled program.

    Args:
        problem: what to simulate.
        policy: who acts.
        decider: of the filter; None without one.
        continuous: whether to look at h between control instants too.

    Attributes:
        problem: as given.
        program: with the entry points `draw_path_starts` and `play_paths`.
        most_paths: to play by one call.

    Raises:
        NotCompilableError: The policy or the filter is none that can be compiled.
    """

    def __init__(
        self, problem: SafetyProblem, policy: Any, decider: Decider | None, continuous: bool
    ) -> None:
        data = Data()
        bridged = continuous and any(reached_by_noise(problem))
        source = (
            world_source(problem, data)
            + policy_source(policy, problem, data)
            + decision_source(decider, len(problem.inputs), data)
            + path_source(problem, bridged, data)
        )
        self.problem = problem
        self.program = Program(f"paths of {problem.name}", (draw_path_starts, play_paths), source)
        self._data, self._work = data.array(), max(source.work, 1)
        self.most_paths = max(1, periods_of_a_part(len(self._data)) // problem.steps)
        ahead = min(_AHEAD, 4 * math.ceil(problem.steps / 4))
        self._sizes = ahead, noise_channels(problem), len(problem.barriers) if bridged else 0
        self._root = math.sqrt(problem.dt / problem.substeps)
        self._uniforms = len(problem.starts[problem.start].uniforms)

    def compiled(self) -> Functions:
        """Return the entry points of the program, compiled.

        Raises:
            ConfigurationError: Numba is not installed.
            NotCompilableError: Numba cannot compile a formula.
        """
        functions = self.program.compiled()
        nothing = np.empty(0, dtype=np.int64)
        heights = Heights(np.empty(0), self.problem.steps, np.empty((0, 1)))
        records = Records(0, self.problem.plant.n)
        keys = nothing.astype(np.uint64)
        try:
            # The first call compiles: an error shows before a long run, and timing is of steps.
            self.starts(functions, keys)
            self.play(functions, nothing, keys, heights, records, 0.0, nothing, nothing)
        except Exception as error:
            raise NotCompilableError(
                f"Numba cannot compile {self.problem.name}: {shortened(error)}; use the engine"
                " 'numpy'"
            ) from error
        return functions

    def starts(self, functions: Functions, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the states and the barriers at the starts of paths, and how many have one.

        Args:
            functions: entry points of the program.
            keys: of the paths, uint64 (B,).
        """
        states = np.empty((len(keys), self.problem.plant.n))
        barriers = np.empty((len(keys), len(self.problem.barriers)))
        found = functions["draw_path_starts"](
            keys, states, barriers, self._data, np.empty(self._uniforms)
        )
        return states, barriers, found

    def play(
        self,
        functions: Functions,
        paths: np.ndarray,
        keys: np.ndarray,
        heights: Heights,
        records: Records,
        length: float,
        ends: np.ndarray,
        outcomes: np.ndarray,
    ) -> None:
        """Play paths; see `play_paths`.

        Args:
            functions: entry points of the program.
            paths: their numbers, int64 (B,).
            keys: of all paths.
            heights: of all paths.
            records: of all paths.
            length: of the drift.
            ends: receives when each ended, int64, of all paths.
            outcomes: receives how each ended, int64, of all paths.
        """
        ahead, channels, draws = self._sizes
        functions["play_paths"](
            paths,
            keys,
            heights.kinds,
            heights.weights,
            heights.units,
            self._sizes,
            (self.problem.dt, length, self._root),
            records.count,
            records.heights,
            records.instants,
            records.ended,
            records.states,
            records.integrals,
            ends,
            outcomes,
            self._data,
            np.empty(ahead * channels),
            np.empty(ahead * draws),
            np.empty(self._work),
        )


class CompiledPaths:
    """Simulates paths by a compiled program.

    Args:
        program: of the problem, the policy and the filter.
        functions: its entry points.
        reference: simulates by NumPy the paths that do not come to a regular end, and says why.
        threads: how many simulate side by side.

    Attributes:
        steps: control periods of an episode.
    """

    def __init__(
        self, program: PathProgram, functions: Functions, reference: PathPlayer, threads: int
    ) -> None:
        self.steps = program.problem.steps
        self._program, self._functions = program, functions
        self._reference, self._threads = reference, threads

    def starts(self, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `safe_envs.agents.rare_events.particles.PathPlayer`."""
        states, barriers, found = self._program.starts(self._functions, keys)
        return (states, barriers) if found == len(keys) else self._reference.starts(keys)

    def play(
        self,
        paths: np.ndarray,
        keys: np.ndarray,
        heights: Heights,
        records: Records,
        length: float,
    ) -> np.ndarray:
        """See `safe_envs.agents.rare_events.particles.PathPlayer`."""
        ends, outcomes = np.zeros((2, len(keys)), dtype=np.int64)
        left = paths
        while left.size:
            self._play(left, keys, heights, records, length, ends, outcomes)
            left = paths[outcomes[paths] == FULL]
            if left.size:
                records.grow()
        failed = paths[outcomes[paths] == FAILED]
        if failed.size:
            records.keep(failed, 1)
            ends[failed] = self._reference.play(failed, keys, heights, records, length)
        return ends[paths]

    def _play(self, left: np.ndarray, *arguments: Any) -> None:
        """Divide the work among the threads."""
        count = min(_PARTS * self._threads, math.ceil(len(left) / _FEWEST_PATHS))
        count = max(count, math.ceil(len(left) / self._program.most_paths))
        parts = np.array_split(left, count)
        if self._threads == 1 or count == 1:
            for part in parts:
                self._program.play(self._functions, part, *arguments)
            return
        with ExitStack() as stack:
            pool = ThreadPoolExecutor(self._threads, "safe_envs_paths")
            stack.callback(pool.shutdown, cancel_futures=True)
            under_way = [
                pool.submit(self._program.play, self._functions, part, *arguments) for part in parts
            ]
            for each in under_way:
                each.result()
