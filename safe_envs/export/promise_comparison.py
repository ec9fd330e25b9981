"""An exported promise filter held against the filter in Python."""

from __future__ import annotations

import ctypes
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from safe_envs.errors import ConfigurationError, require_whole, shortened
from safe_envs.export.c_files import Interface
from safe_envs.export.comparison import build_library, c_compiler
from safe_envs.export.export import ExportOptions
from safe_envs.export.promise_export import (
    PromiseDecisions,
    PromiseEpisodes,
    clipped,
    decided,
    promise_sources,
    random_cases,
)
from safe_envs.files import read_bytes
from safe_envs.values.promise_filter import PromiseFilter

_MEMORY = 5


class Answers(NamedTuple):
    """What C decides: see `PromiseDecisions`; the status, and the memories afterwards (N, 5)."""

    decisions: PromiseDecisions
    status: np.ndarray
    memory: np.ndarray


Decide = Callable[[np.ndarray, np.ndarray, np.ndarray], Answers]


def memories(instants: np.ndarray, promises: np.ndarray) -> np.ndarray:
    """Return memories as the driver takes them: begun with the first instant.

    Args:
        instants: control periods that have passed, shape (N,).
        promises: p_k of the decision before, shape (N,).

    Returns:
        Shape (N, 5).
    """
    found = np.ones((len(instants), _MEMORY))
    found[:, 0], found[:, 1], found[:, 3] = instants, promises, np.inf
    found[:, 4] = instants > 0
    return found


def matching(
    directory: Path, promise_filter: PromiseFilter, options: ExportOptions
) -> tuple[Interface, dict[str, str]]:
    """Return the interface and the texts of a directory, if they are those of the filter.

    Args:
        directory: where a filter was exported.
        promise_filter: the filter.
        options: with which it was exported.

    Raises:
        ConfigurationError: It holds something else.
    """
    try:
        there = {name: read_bytes(directory / name) for name in ("filter.h", "filter.c")}
    except OSError as error:
        raise ConfigurationError(
            f"{shortened(directory)} holds no exported filter: {error.strerror}; export it first"
        ) from error
    interface, texts = promise_sources(promise_filter, options)
    if any(texts[name].encode() != content for name, content in there.items()):
        raise ConfigurationError(
            f"{shortened(directory)} holds another filter, or a changed one, which is not run;"
            " export it again"
        )
    return interface, texts


def _driver(interface: Interface) -> str:
    """Return a function that decides for a table of memories and inputs."""
    name, macro = interface.name, interface.macro
    return f"""#include "filter.h"

#include <string.h>

void decide_cases(const double *given, long count, double *found)
{{
    for (long i = 0; i < count; i++) {{
        {name}_memory memory;
        {name}_input input;
        {name}_result result;
        {name}_begin(&memory);
        memory.instant = (int)given[0];
        memory.promise = given[1];
        memory.expected = given[2];
        memory.cap = given[3];
        memory.begun = given[4] > 0;
        given += {_MEMORY};
        memcpy(&input, given, sizeof input);
        given += {macro}_STATES + {macro}_INPUTS;
        const int status = (int){name}_decide(&memory, &input, &result);
        const double numbers[] = {{memory.instant, memory.promise, memory.expected, memory.cap,
            memory.begun, result.promise, result.expected, result.replaced, status}};
        memcpy(found, numbers, sizeof numbers);
        found += sizeof numbers / sizeof *numbers;
        memcpy(found, &result.action, sizeof result.action);
        found += {macro}_INPUTS;
    }}
}}
"""


def built(folder: Path, compiler: list[str], interface: Interface, texts: dict[str, str]) -> Decide:
    """Build the C, and return it as a function of memories, states and proposed inputs.

    Args:
        folder: an empty one.
        compiler: its command.
        interface: of the filter.
        texts: of its header and its source.

    Raises:
        ConfigurationError: The compiler fails.
    """
    for name, text in (*texts.items(), ("driver.c", _driver(interface))):
        (folder / name).write_text(text)
    library = folder / "filter.so"
    build_library(compiler, [folder / "filter.c", folder / "driver.c"], library)
    function = ctypes.CDLL(str(library)).decide_cases
    function.restype = None

    def decide(memory: np.ndarray, states: np.ndarray, proposed: np.ndarray) -> Answers:
        given = np.ascontiguousarray(np.hstack([memory, states, proposed]), dtype=float)
        found = np.empty((len(given), _MEMORY + 4 + len(interface.inputs)))
        pointers = [each.ctypes.data_as(ctypes.c_void_p) for each in (given, found)]
        function(pointers[0], ctypes.c_long(len(given)), pointers[1])
        promise, expected, replaced, status = found[:, _MEMORY : _MEMORY + 4].T
        action = found[:, _MEMORY + 4 :]
        decisions = PromiseDecisions(action, promise, expected, replaced > 0.0)
        return Answers(decisions, status.astype(int), found[:, :_MEMORY])

    return decide


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
        self._low, self._high = np.array(promise_filter.problem.input_bounds, dtype=float).T
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
