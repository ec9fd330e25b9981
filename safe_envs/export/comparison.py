"""An exported filter held against the filter in Python."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs.errors import ConfigurationError, require_whole, shortened
from safe_envs.export.export import ExportOptions, region_of
from safe_envs.export.interface import Interface
from safe_envs.export.program import OK, exported
from safe_envs.export.reference import (
    Cases,
    Constraints,
    Decisions,
    at_ends,
    decided,
    random_cases,
    rounded,
    spoilt,
    with_other_bounds,
    without_effect,
)
from safe_envs.files import read_bytes
from safe_envs.filters.arguments import WIDEST
from safe_envs.filters.safety_filter import SafetyFilter

_KNOWN = ("cc", "gcc", "clang")
_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
_SECONDS = 300
_COMPILED = ("filter.h", "filter.c", "filter_core.c")


def c_compiler() -> list[str] | None:
    """Return the command of $CC, or of cc, gcc or clang on the path; None if there is none."""
    given = shlex.split(os.environ.get("CC", ""))
    if given and shutil.which(given[0]):
        return given
    return next(([name] for name in _KNOWN if shutil.which(name)), None)


def build_library(compiler: Sequence[str], files: Sequence[Path], library: Path) -> None:
    """Compile files to a shared library.

    Args:
        compiler: its command.
        files: sources.
        library: the file that is written.

    Raises:
        ConfigurationError: The compiler fails.
    """
    command = [*compiler, *_FLAGS, "-o", str(library), *map(str, files), "-lm"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_SECONDS, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ConfigurationError(f"the C compiler {compiler[0]} cannot be run: {error}") from error
    if done.returncode:
        message = shortened(" ".join(done.stderr.split()), 400)
        raise ConfigurationError(
            f"the C compiler {compiler[0]} fails: {message}; choose another one by CC=..."
        )


CLOSE = 1e-12
"""Part of a constraint's terms below which its margin is rounding."""
CLOSE_SINGLE = 1e-5
"""The same in single precision."""

_SHARE_SPECIAL = 100
_SHARE_BOUNDED = 0.1
_NOTHING = 1e-300
_REAL_PARTS = ("action", "pursued", "barrier", "margin", "slack")


@dataclass(frozen=True)
class CComparison:
    """How an exported filter differs from the filter in Python.

    Attributes:
        compiler: with which it was built; "" where there is none, and nothing was compared.
        states: how many were tried.
        infeasible: how many of them are infeasible.
        without_effect: how many have a constraint that says nothing of the input.
        invalid: how many are not finite, or have no finite constraint.
        largest_error: of an action, over the size of the largest input within its bounds.
        largest_relative_error: of an action, over its size.
        beyond: actions whose error, in these terms, is above 1e-12, or 1e-5 in single precision.
        flags_different: states where feasible, active or the status differ.
        flags_close: those among them where the margin that decides is rounding: below 1e-12 of
            the constraint's terms, or 1e-5 in single precision.
        out_of_bounds: actions of C outside their bounds or not finite.
        nanoseconds: processor time of a call.
    """

    compiler: str
    states: int = 0
    infeasible: int = 0
    without_effect: int = 0
    invalid: int = 0
    largest_error: float = 0.0
    largest_relative_error: float = 0.0
    beyond: int = 0
    flags_different: int = 0
    flags_close: int = 0
    out_of_bounds: int = 0
    nanoseconds: float = 0.0

    @property
    def was_made(self) -> bool:
        """Whether anything was compared."""
        return bool(self.compiler)


def compare(
    directory: Path | str,
    safety_filter: SafetyFilter,
    options: ExportOptions | None = None,
    *,
    states: int = 1_000_000,
    seed: int = 0,
) -> CComparison:
    """Build an exported filter, and hold it against the filter in Python at many states.

    Among the states are some that are not finite or at the ends of the region, some where a
    constraint says nothing of the input, and some with other input bounds. Code is compiled and run
    only if it is what the filter exports.

    Args:
        directory: where `export_filter` has written its files.
        safety_filter: the filter that was exported.
        options: with which it was.
        states: how many to try.
        seed: of the states.

    Raises:
        ConfigurationError: The directory does not hold what the filter exports, or the compiler
            fails.
    """
    require_whole("states", states, 1)
    options, safety_filter = options or ExportOptions(), safety_filter.by_constraint()
    interface, texts = _matching(Path(directory), safety_filter, options)
    compiler = c_compiler()
    if compiler is None:
        return CComparison("")
    cases = _cases(safety_filter, options, states, seed)
    if interface.single:
        cases = rounded(cases)
    with tempfile.TemporaryDirectory() as folder:
        found, nanoseconds = _run(Path(folder), compiler, interface, texts, cases)
    wanted = decided(safety_filter, cases)
    close = CLOSE_SINGLE if interface.single else CLOSE
    return _compared(
        Constraints(safety_filter), cases, wanted, found, close, " ".join(compiler), nanoseconds
    )


def _matching(
    directory: Path, safety_filter: SafetyFilter, options: ExportOptions
) -> tuple[Interface, dict[str, str]]:
    """Return the interface and the texts of a directory, if they are those of the filter."""
    try:
        there = {name: read_bytes(directory / name) for name in _COMPILED}
    except OSError as error:
        raise ConfigurationError(
            f"{shortened(directory)} holds no exported filter: {error.strerror}; export it first"
        ) from error
    for float32 in (False, True):
        interface, texts = exported(safety_filter, float32, options.name, options.units)
        if all(texts[name].encode() == content for name, content in there.items()):
            return interface, texts
    raise ConfigurationError(
        f"{shortened(directory)} holds another filter, or a changed one, which is not run; export"
        " it again"
    )


def _cases(safety_filter: SafetyFilter, options: ExportOptions, states: int, seed: int) -> Cases:
    rng, region = np.random.default_rng(seed), region_of(safety_filter, options)
    flat = without_effect(safety_filter, region, rng).at(slice(0, max(1, states // 10)))
    few = max(1, states // _SHARE_SPECIAL)
    bad = spoilt(random_cases(safety_filter, region, few, rng), rng)
    ends = at_ends(random_cases(safety_filter, region, few, rng), region, rng)
    rest = max(1, states - len(flat.states) - 2 * few)
    cases = random_cases(safety_filter, region, rest, rng)
    changed = np.flatnonzero(rng.random(rest) < _SHARE_BOUNDED)
    kept = np.setdiff1d(np.arange(rest), changed)
    return flat + bad + ends + cases.at(kept) + with_other_bounds(cases.at(changed), rng)


def _driver(interface: Interface) -> str:
    """Return a function that decides for a table of cases."""
    name, macro, real = interface.name, interface.macro, interface.real
    return f"""#include "filter.h"

#include <string.h>

void decide_cases(const {real} *given, long count, {real} *numbers, int *flags)
{{
    for (long i = 0; i < count; i++) {{
        {name}_input input;
        {name}_result result;
        memcpy(&input, given + i * (long)(sizeof input / sizeof *given), sizeof input);
        const int status = (int){name}_decide(&input, &result);
        memcpy(numbers, &result.action, sizeof result.action);
        numbers += {macro}_INPUTS;
        memcpy(numbers, &result.pursued, sizeof result.pursued);
        numbers += {macro}_INPUTS;
        memcpy(numbers, result.barrier, sizeof result.barrier);
        numbers += {macro}_CONSTRAINTS;
        memcpy(numbers, result.margin, sizeof result.margin);
        numbers += {macro}_CONSTRAINTS;
        memcpy(numbers, result.slack, sizeof result.slack);
        numbers += {macro}_CONSTRAINTS;
        for (int k = 0; k < {macro}_CONSTRAINTS; k++) {{
            *flags++ = result.active[k];
        }}
        *flags++ = result.feasible;
        *flags++ = result.cause;
        *flags++ = status;
    }}
}}
"""


def _run(
    folder: Path, compiler: list[str], interface: Interface, texts: dict[str, str], cases: Cases
) -> tuple[Decisions, float]:
    """Return what C decides, and the processor time of a call in ns."""
    for name, text in (*texts.items(), ("driver.c", _driver(interface))):
        (folder / name).write_text(text)
    library = folder / "filter.so"
    build_library(compiler, [folder / "filter.c", folder / "driver.c"], library)
    kind = np.float32 if interface.single else np.float64
    with np.errstate(over="ignore"):
        rows = np.ascontiguousarray(cases.rows(), dtype=kind)
    count, k, m = len(rows), len(interface.constraints), len(interface.inputs)
    numbers = np.empty((count, 2 * m + 3 * k), dtype=kind)
    flags = np.empty((count, k + 3), dtype=np.intc)
    function: Any = ctypes.CDLL(str(library)).decide_cases
    function.restype = None
    start = time.process_time_ns()
    pointers = [each.ctypes.data_as(ctypes.c_void_p) for each in (rows, numbers, flags)]
    function(pointers[0], ctypes.c_long(count), *pointers[1:])
    nanoseconds = (time.process_time_ns() - start) / count
    ends = np.cumsum([m, m, k, k])
    real = np.split(numbers.astype(float), ends, axis=1)
    found = Decisions.empty(count, m, k)
    for name, values in zip(_REAL_PARTS, real, strict=True):
        setattr(found, name, values)
    found.active, found.feasible = flags[:, :k] > 0, flags[:, k] > 0
    found.cause, found.status = flags[:, k + 1], flags[:, k + 2]
    return found, nanoseconds


def _compared(
    constraints: Constraints,
    cases: Cases,
    wanted: Decisions,
    found: Decisions,
    close: float,
    compiler: str,
    nanoseconds: float,
) -> CComparison:
    differ = (wanted.feasible != found.feasible) | (wanted.status != found.status)
    differ |= (wanted.active != found.active).any(axis=1)
    rows = np.flatnonzero(differ)
    near = _decided_by_rounding(constraints, cases.at(rows), wanted.at(rows), found.at(rows), close)
    same = np.flatnonzero(~differ)
    error = np.abs(found.action - wanted.action)[same]
    size = np.abs(wanted.action[same])
    largest = np.maximum(np.abs(cases.low), np.abs(cases.high))[same]
    largest = np.where(largest < WIDEST, np.maximum(largest, _NOTHING), np.maximum(size, 1.0))
    relative = error / np.where(size > 0.0, size, largest)
    inside = (found.action >= cases.low) & (found.action <= cases.high)
    a, _ = constraints.at(cases)
    valid = wanted.status == OK
    return CComparison(
        compiler,
        states=len(differ),
        infeasible=int(np.count_nonzero(valid & ~wanted.feasible)),
        without_effect=int(np.count_nonzero(valid & (a == 0.0).all(axis=2).any(axis=1))),
        invalid=int(np.count_nonzero(~valid)),
        largest_error=float((error / largest).max(initial=0.0)),
        largest_relative_error=float(relative.max(initial=0.0)),
        beyond=int(np.count_nonzero((error / largest > close).any(axis=1))),
        flags_different=len(rows),
        flags_close=int(np.count_nonzero(near)),
        out_of_bounds=int(np.count_nonzero(~inside.all(axis=1))),
        nanoseconds=nanoseconds,
    )


def _decided_by_rounding(
    constraints: Constraints, cases: Cases, wanted: Decisions, found: Decisions, close: float
) -> np.ndarray:
    """Return where the margins that decide a flag are rounding."""
    if not len(cases.states):
        return np.zeros(0, dtype=bool)
    a, b = constraints.at(cases)
    with np.errstate(all="ignore"):
        scale = np.abs(b) + (np.abs(a) * np.abs(wanted.action[:, None, :])).sum(axis=2)
        part = [np.abs(each.margin) / np.where(scale > 0, scale, 1.0) for each in (wanted, found)]
        flipped = wanted.active != found.active
        # Of an infeasible decision, what is violated beyond rounding has made it so.
        short = np.minimum(wanted.margin, found.margin) < 0.0
        judged = flipped | (short & (wanted.feasible != found.feasible)[:, None])
        near = np.where(judged, np.minimum(*part) <= close, True).all(axis=1)
    return near & (wanted.status == found.status)
