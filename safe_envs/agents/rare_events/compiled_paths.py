"""Paths by a compiled program, in threads."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from safe_envs.agents.evaluation.brownian_bridge import bridge_rates, reached_by_noise
from safe_envs.agents.evaluation.compiled_episodes import Decider, decider_of, decision_source
from safe_envs.agents.evaluation.episode_kernel import bridge_minimum
from safe_envs.agents.evaluation.resolve import Env, FilterParts, ResolvedEvaluation
from safe_envs.agents.jobs.job import available_threads
from safe_envs.agents.policies.policy_source import policy_source
from safe_envs.agents.rare_events.numpy_paths import NumpyPaths, TiltedNoiseEnv, barrier_slopes
from safe_envs.agents.rare_events.path_kernel import FAILED, FULL, draw_path_starts, play_paths
from safe_envs.agents.rare_events.splitting import Heights, PathPlayer, Records
from safe_envs.engine.choice import compiled_or_none, periods_of_a_part
from safe_envs.engine.formulas import Source, formulas
from safe_envs.engine.program import Functions, Program
from safe_envs.engine.slots import Data
from safe_envs.envs.world_source import noise_channels, world_source
from safe_envs.errors import ConfigurationError, NotCompilableError, shortened
from safe_envs.filters.conditions.text import FilterSettings
from safe_envs.problem.problem import SafetyProblem


def path_source(problem: SafetyProblem, bridged: bool, data: Data) -> Source:
    """Return the functions that playing paths takes next to those of the world.

    Args:
        problem: what is simulated.
        bridged: whether to draw h between control instants.
        data: receives its numbers.
    """
    entries = "".join(f"row[{i}], " for i in range(problem.plant.n))
    state = Source(f"def state_in(row):\n    return ({entries})\n")
    return state + _tilt(problem, data) + _lowest(problem, bridged, data)


def _tilt(problem: SafetyProblem, data: Data) -> Source:
    channels, head = len(problem.plant.noise_channels), "def tilt_direction(x, barriers, data):\n"
    if not channels:
        return Source(f"{head}    return (0.0,)\n")
    slopes = barrier_slopes(problem)
    lines = ["slopes = barrier_slopes(x, data)", "h = barriers[0]"]
    rows = [
        "".join(f"slopes[{i}], " for i in range(first, first + channels))
        for first in range(0, len(slopes), channels)
    ]
    lines.append(f"steepest = ({rows[0]})")
    for i, row in enumerate(rows[1:], 1):
        lines += [f"if barriers[{i}] < h:", f"    h = barriers[{i}]", f"    steepest = ({row})"]
    squares = " + ".join(f"steepest[{i}] * steepest[{i}]" for i in range(channels))
    lines += [
        f"steepness = sqrt({squares})",
        "if not steepness > 0.0:",
        f"    return ({'0.0, ' * channels})",
        f"return ({''.join(f'steepest[{i}] / steepness, ' for i in range(channels))})",
    ]
    text = head + "".join(f"    {line}\n" for line in lines)
    return formulas("barrier_slopes", {"x": problem.plant.states}, slopes, data) + Source(text)


def _lowest(problem: SafetyProblem, bridged: bool, data: Data) -> Source:
    count = len(problem.barriers)
    lines = ["def lowest_relative(x, before, after, units, uniforms, first, data):"]
    if bridged:
        lines += [
            "    rates = bridge_rates(x, data)",
            *(
                f"    h{i} = bridge_minimum("
                f"before[{i}], after[{i}], rates[{i}], uniforms[first + {i}])"
                for i in range(count)
            ),
        ]
    else:
        lines += [f"    h{i} = after[{i}]" for i in range(count)]
    lines.append("    lowest = h0 / units[0]")
    lines += [f"    lowest = min(lowest, h{i} / units[{i}])" for i in range(1, count)]
    text = "\n".join([*lines, "    return lowest\n"])
    if not bridged:
        return Source(text)
    rates = formulas("bridge_rates", {"x": problem.plant.states}, bridge_rates(problem), data)
    return rates + Source(text, (bridge_minimum,))


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
        """See `safe_envs.agents.rare_events.splitting.PathPlayer`."""
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
        """See `safe_envs.agents.rare_events.splitting.PathPlayer`."""
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


class ChosenPlayer(NamedTuple):
    """Who simulates, and how.

    Attributes:
        player: who simulates.
        engine: "numpy" or "compiled".
        jobs: threads.
    """

    player: PathPlayer
    engine: str
    jobs: int


def player_of(
    resolved: ResolvedEvaluation,
    conditions: FilterParts,
    num_envs: int,
    engine: str,
    periods: float,
) -> ChosenPlayer:
    """Return who simulates paths under a filter.

    Args:
        resolved: what to simulate.
        conditions: of the filter, see `FilterParts`.
        num_envs: the most envs of NumPy side by side.
        engine: one of `safe_envs.engine.choice.ENGINES`.
        periods: control periods to simulate, about.

    Raises:
        ConfigurationError: The filter remembers the path, or the compiled engine was asked for,
            and Numba is missing.
        NotCompilableError: It was asked for, and cannot do this.
    """
    if isinstance(conditions, FilterSettings) and conditions.of_paths:
        raise ConfigurationError(
            f"the filter {conditions.text} remembers {conditions.of_paths}, and paths that are"
            " split go on from states alone; evaluate it with more episodes instead"
        )
    continuous = resolved.spec.monitoring == "continuous"
    reference = NumpyPaths(
        resolved.problem,
        partial(_tilted_env, resolved, conditions),
        resolved.policy,
        num_envs,
        continuous,
    )
    compiled = compiled_or_none(
        engine, periods, partial(_compiled, resolved, conditions, continuous, reference)
    )
    return compiled or ChosenPlayer(reference, "numpy", 1)


def _tilted_env(resolved: ResolvedEvaluation, conditions: FilterParts, lengths: np.ndarray) -> Env:
    return resolved.filtered(TiltedNoiseEnv(resolved.problem, lengths), conditions)


def _compiled(
    resolved: ResolvedEvaluation,
    conditions: FilterParts,
    continuous: bool,
    reference: PathPlayer,
) -> ChosenPlayer:
    decider = decider_of(resolved, conditions)
    program = PathProgram(resolved.problem, resolved.policy, decider, continuous)
    threads = available_threads()
    functions = program.compiled()
    player = CompiledPaths(program, functions, reference, threads)
    return ChosenPlayer(player, "compiled", threads)
