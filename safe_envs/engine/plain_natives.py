"""The operations of kernels that differ between plain Python and compiled code: in plain Python.

Words are whole numbers below 2**64.

Source: J. Salmon, M. Moraes, R. Dror, D. Shaw, Parallel Random Numbers: As Easy as 1, 2, 3, SC11,
    2011.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np

_MASK = (1 << 64) - 1
_FIRST, _SECOND = 0xD2E7470EE14C6C93, 0xCA5A826395121157
_FIRST_STEP, _SECOND_STEP = 0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B
_ROUNDS = 10

Words = tuple[int, int, int, int]


def philox_block(c0: int, c1: int, c2: int, c3: int, k0: int, k1: int) -> Words:
    """Return a Philox 4x64-10 block of four words.

    Args:
        c0: first word of the counter; whole numbers are taken modulo 2**64.
        c1: second word.
        c2: third word.
        c3: fourth word.
        k0: first word of the key.
        k1: second word.
    """
    c0, c1, c2, c3, k0, k1 = (int(word) & _MASK for word in (c0, c1, c2, c3, k0, k1))
    for _ in range(_ROUNDS):
        first, second = _FIRST * c0, _SECOND * c2
        c0, c1, c2, c3 = (
            (second >> 64) ^ c1 ^ k0,
            second & _MASK,
            (first >> 64) ^ c3 ^ k1,
            first & _MASK,
        )
        k0, k1 = (k0 + _FIRST_STEP) & _MASK, (k1 + _SECOND_STEP) & _MASK
    return c0, c1, c2, c3


def uniform_of(word: int) -> float:
    """Return a word as a number in [0, 1)."""
    return (int(word) >> 11) * 2.0**-53


def single(value: float) -> float:
    """Return a number rounded to single precision."""
    try:
        return struct.unpack("f", struct.pack("f", value))[0]
    except OverflowError:
        return float("inf") if value > 0.0 else float("-inf")


def vector_view(array: np.ndarray, first: int, count: int) -> np.ndarray:
    """Return entries of an array, to be read and written.

    Compiled code checks nothing and takes no note of the view, so that it costs nothing, and must
    not outlive the array: no function returns one.

    Args:
        array: of one dimension.
        first: its first entry.
        count: number of entries.
    """
    return array[first : first + count]


def table_view(array: np.ndarray, first: int, rows: int, columns: int) -> np.ndarray:
    """Return entries of an array, row by row; see `vector_view`.

    Args:
        array: of one dimension.
        first: its first entry.
        rows: number of rows.
        columns: number of columns.
    """
    return array[first : first + rows * columns].reshape(rows, columns)


def floats_at(address: int) -> Any:
    """Return the numbers from an address of memory on, in machine code alone."""
    raise NotImplementedError


def library_sine(x: float) -> float:
    """Return the sine of an angle in rad by the C library."""
    return math.sin(x)


def library_cosine(x: float) -> float:
    """Return the cosine of an angle in rad by the C library."""
    return math.cos(x)


def library_arc_tangent(y: float, x: float) -> float:
    """Return the angle of a vector in rad by the C library.

    Args:
        y: its second component.
        x: its first component.
    """
    return math.atan2(y, x)
