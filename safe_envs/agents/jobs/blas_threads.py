"""A limit on the threads of BLAS, which slow down small networks on a busy machine."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any

from threadpoolctl import ThreadpoolController

_BRING_A_BLAS = ("numpy", "scipy.linalg", "torch")


def limited(threads: int = 1) -> AbstractContextManager[Any]:
    """Limit the number of threads of every BLAS that is loaded by now."""
    return _controller(tuple(name in sys.modules for name in _BRING_A_BLAS)).limit(
        limits=threads, user_api="blas"
    )


@lru_cache
def _controller(loaded: tuple[bool, ...]) -> ThreadpoolController:
    """Find the libraries of this process once per set, since that outlasts many simulations."""
    return ThreadpoolController()
