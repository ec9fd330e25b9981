"""An exported promise filter, built as a library that Python calls."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import ConfigurationError, shortened
from safe_envs.wrappers.export.c_compiler import build_library
from safe_envs.wrappers.export.export import ExportOptions
from safe_envs.wrappers.export.interface import Interface
from safe_envs.wrappers.export.promise_export import promise_sources
from safe_envs.wrappers.export.promise_reference import (
    PromiseDecisions,
)
from safe_envs.wrappers.value.promise_filter import PromiseFilter

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
