"""An exported promise filter held against the filter in Python."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.errors import require_whole
from safe_envs.wrappers.export.c_compiler import c_compiler
from safe_envs.wrappers.export.export import ExportOptions
from safe_envs.wrappers.export.promise_library import Answers, Decide, built, matching, memories
from safe_envs.wrappers.export.promise_reference import (
    PromiseDecisions,
    PromiseEpisodes,
    clipped,
    decided,
    random_cases,
)
from safe_envs.wrappers.value.promise_filter import PromiseFilter

CLOSE = 1e-9
"""Of a half-width of the input bounds: error of an action that is rounding."""
CLOSE_LEVEL = 1e-12
"""Error of a probability that is rounding."""

_EPISODES = 64
_SHARE_SPOILT = 100
_OK, _INVALID_INPUT = 0, 2


@dataclass(frozen=True)
class PromiseComparison:
    """How an exported promise filter differs from the filter in Python.

    Attributes:
        compiler: with which it was built; "" where there is none, and nothing was compared.
        states: single decisions that were tried.
        steps: decisions in whole episodes, each side with its own memory.
        replaced: decisions that replace the proposed input.
        infeasible: decisions where nothing is promised.
        invalid: states that are not finite, all of which C has to refuse.
        largest_error: of an action, in half-widths of the input bounds.
        largest_level_error: of a promise, or of what an action keeps.
        flags_different: decisions where `replaced`, `feasible` or the status differ.
        beyond: decisions whose action or probabilities differ by more than rounding: the values
            are constant on cells, and rounding decides to which of two cells an edge counts.
        out_of_bounds: actions of C outside their bounds or not finite.
        nanoseconds: processor time of a call.
    """

    compiler: str
    states: int = 0
    steps: int = 0
    replaced: int = 0
    infeasible: int = 0
    invalid: int = 0
    largest_error: float = 0.0
    largest_level_error: float = 0.0
    flags_different: int = 0
    beyond: int = 0
    out_of_bounds: int = 0
    nanoseconds: float = 0.0

    @property
    def was_made(self) -> bool:
        """Whether anything was compared."""
        return bool(self.compiler)


def compare_promise(
    directory: Path | str,
    promise_filter: PromiseFilter,
    options: ExportOptions | None = None,
    *,
    states: int = 100_000,
    seed: int = 0,
) -> PromiseComparison:
    """Build an exported promise filter, and hold it against the filter in Python.

    Single decisions are from random states, instants and promises; some states are not finite. In
    episodes each side goes on from its own memory, along the states of the filter in Python. Code
    is compiled and run only if it is what the filter exports.

    Args:
        directory: where `export_promise` has written its files.
        promise_filter: the filter that was exported.
        options: with which it was.
        states: how many single decisions to try.
        seed: of the states.

    Raises:
        ConfigurationError: The directory does not hold what the filter exports, or the compiler
            fails.
    """
    require_whole("states", states, 1)
    options = options or ExportOptions()
    interface, texts = matching(Path(directory), promise_filter, options)
    compiler = c_compiler()
    if compiler is None:
        return PromiseComparison("")
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        decide = built(Path(folder), compiler, interface, texts)
        cases = random_cases(promise_filter, options.region, states, rng)
        memory = memories(cases.instants, cases.levels)
        begun = time.process_time_ns()
        found = decide(memory, cases.states, cases.proposed)
        spent = time.process_time_ns() - begun
        tally = _Tally(promise_filter)
        tally.add(decided(promise_filter, cases), found)
        invalid = max(1, states // _SHARE_SPOILT)
        tally.add_refused(decide, rng.permutation(invalid), cases.states, cases.proposed)
        steps = _run_episodes(promise_filter, decide, tally, seed)
    return PromiseComparison(
        " ".join(compiler),
        states,
        steps,
        invalid=invalid,
        nanoseconds=spent / states,
        **tally.found,
    )


def _run_episodes(promise_filter: PromiseFilter, decide: Decide, tally: _Tally, seed: int) -> int:
    """Compare whole episodes; return their number of decisions."""
    episodes = PromiseEpisodes(promise_filter, _EPISODES, seed)
    memory, count = memories(np.zeros(_EPISODES), np.zeros(_EPISODES)), 0
    for _ in range(promise_filter.look_ahead.steps + 1):
        proposed = episodes.propose()
        wanted = episodes.decide(clipped(promise_filter, proposed))
        found = decide(memory, np.array(episodes.x).T, proposed)
        tally.add(wanted, found)
        memory, count = found.memory, count + _EPISODES
        episodes.move(wanted.action)
    return count


class _Tally:
    """Counts of what differs.

    Args:
        promise_filter: the filter.

    Attributes:
        found: by their names in `PromiseComparison`.
    """

    def __init__(self, promise_filter: PromiseFilter) -> None:
        self._low, self._high = np.array(promise_filter.problem.box, dtype=float).T
        self.found: dict[str, Any] = dict.fromkeys(
            ("replaced", "infeasible", "flags_different", "beyond", "out_of_bounds"), 0
        )
        self.found |= {"largest_error": 0.0, "largest_level_error": 0.0}

    def add(self, wanted: PromiseDecisions, found: Answers) -> None:
        """Compare some decisions.

        Args:
            wanted: those of Python.
            found: those of C.
        """
        given, counts = found.decisions, self.found
        half = 0.5 * (self._high - self._low)
        error = (np.abs(given.action - wanted.action) / np.where(half > 0.0, half, 1.0)).max(axis=1)
        level = np.maximum(
            np.abs(given.level - wanted.level), np.abs(given.expected - wanted.expected)
        )
        flags = (given.replaced != wanted.replaced) | (found.status != _OK)
        flags |= (given.level > 0.0) != (wanted.level > 0.0)
        # What is no number differs.
        beyond = ~((error <= CLOSE) & (level <= CLOSE_LEVEL))
        counts["replaced"] += int(np.count_nonzero(wanted.replaced))
        counts["infeasible"] += int(np.count_nonzero(wanted.level <= 0.0))
        counts["flags_different"] += int(np.count_nonzero(flags))
        counts["beyond"] += int(np.count_nonzero(beyond))
        counts["largest_error"] = max(counts["largest_error"], float(error.max(initial=0.0)))
        counts["largest_level_error"] = max(
            counts["largest_level_error"], float(level.max(initial=0.0))
        )
        self._add_bounds(given.action)

    def add_refused(
        self, decide: Decide, chosen: np.ndarray, states: np.ndarray, proposed: np.ndarray
    ) -> None:
        """Count what is not finite and not refused.

        Args:
            decide: the C.
            chosen: which states are to be spoilt.
            states: from which they are taken.
            proposed: likewise.
        """
        states, proposed = states[chosen].copy(), proposed[chosen].copy()
        bad = np.array([np.nan, np.inf, -np.inf])[chosen % 3]
        of_state = chosen % 4 > 0
        places = chosen % states.shape[1], chosen % proposed.shape[1]
        states[of_state, places[0][of_state]] = bad[of_state]
        proposed[~of_state, places[1][~of_state]] = bad[~of_state]
        found = decide(memories(np.ones(len(chosen)), np.ones(len(chosen))), states, proposed)
        kept = (found.status != _INVALID_INPUT) | (found.decisions.level != 0.0)
        self.found["flags_different"] += int(np.count_nonzero(kept))
        self._add_bounds(found.decisions.action)

    def _add_bounds(self, action: np.ndarray) -> None:
        inside = ((action >= self._low) & (action <= self._high)).all(axis=1)
        self.found["out_of_bounds"] += int(np.count_nonzero(~inside))
