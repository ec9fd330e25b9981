"""How many threads a computation may take."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_SIDE_BY_SIDE: ContextVar[bool] = ContextVar("computations run side by side", default=False)


def available_threads() -> int:
    """Return the processors that this process may use; 1 within `one_thread`."""
    if _SIDE_BY_SIDE.get():
        return 1
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def one_thread() -> Iterator[None]:
    """Let computations take one thread, where others like them run side by side."""
    token = _SIDE_BY_SIDE.set(True)
    try:
        yield
    finally:
        _SIDE_BY_SIDE.reset(token)
