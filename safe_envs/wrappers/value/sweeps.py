"""Sweeps of the Bellman operator over the cells of a grid, in threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from safe_envs.compiled.formulas import Source
from safe_envs.compiled.program import Functions, Program, is_available
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers.value import bellman_arrays
from safe_envs.wrappers.value.bellman_kernel import expected_values, sweep_lower, sweep_upper
from safe_envs.wrappers.value.expected_value_kernel import AXES
from safe_envs.wrappers.value.spending_kernel import kept_values

_PARTS = 8
"""Parts for each thread, so that all threads end at about the same time."""


def bellman_functions() -> Functions:
    """Return the entry points of `bellman_kernel`, compiled where Numba is installed."""
    entries = (expected_values, sweep_lower, sweep_upper, kept_values)
    if is_available():
        try:
            return Program("dynamic programs", entries, Source("")).compiled()
        except NotCompilableError:
            pass
    return {entry.__name__: getattr(bellman_arrays, entry.__name__) for entry in entries}


def threads() -> int:
    """Return the number of threads of a sweep."""
    return os.cpu_count() or 1


def in_parts(pool: ThreadPoolExecutor, count: int, sweep: Callable[[int, int, Any], None]) -> None:
    """Call a sweep for ranges that cover a number of cells, side by side.

    Args:
        pool: of threads.
        count: number of cells.
        sweep: takes the first cell, the one to end before, and a scratch array.
    """
    size = max(1, -(-count // (_PARTS * threads())))
    parts = [(first, min(first + size, count)) for first in range(0, count, size)]
    for done in [pool.submit(sweep, *part, np.zeros(2 * AXES)) for part in parts]:
        done.result()
