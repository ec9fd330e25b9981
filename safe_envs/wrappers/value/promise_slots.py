"""Functions that are generated for each promise filter: declarations, which its kernels import."""

from __future__ import annotations

import numpy as np


def promise_point(x: tuple[float, ...], data: np.ndarray, work: np.ndarray) -> None:
    """Put the coordinates of a state into the scratch array; each program has its own.

    Args:
        x: components of the state.
        data: numbers of the program.
        work: scratch array.
    """
    raise NotImplementedError


def promise_images(k: int, data: np.ndarray, work: np.ndarray) -> None:
    """Put into the scratch array where a step leads; each program has its own.

    Args:
        k: the control instant.
        data: numbers of the program.
        work: scratch array.
    """
    raise NotImplementedError


def promise_is_safe(x: tuple[float, ...], k: int, data: np.ndarray, work: np.ndarray) -> bool:
    """Return whether a state is safe, and in the workspace where leaving it is a violation.

    Args:
        x: components of the state.
        k: the control instant.
        data: numbers of the program.
        work: scratch array with the coordinates.
    """
    raise NotImplementedError


def promise_has_barriers(x: tuple[float, ...], data: np.ndarray) -> bool:
    """Return whether all barriers of a state are positive; each program has its own.

    Args:
        x: components of the state.
        data: numbers of the program.
    """
    raise NotImplementedError


def promise_is_assumed(x: tuple[float, ...], k: int, data: np.ndarray) -> bool:
    """Return whether states that are known in advance are what the tables assume.

    Args:
        x: components of the state.
        k: the control instant.
        data: numbers of the program.
    """
    raise NotImplementedError
