"""The layers of a network in compiled programs, as kernels.

The numbers between the layers lie in the scratch array `work`, weights and biases in `data`.
"""

from __future__ import annotations

from math import expm1, isfinite, nan, tanh

import numpy as np


def set_network_inputs(inputs: tuple[float, ...], work: np.ndarray) -> None:
    """Write inputs to the beginning of the scratch array: all NaN if one is not finite.

    A saturated activation would hide it.

    Args:
        inputs: p numbers.
        work: scratch array.
    """
    sound = True
    for value in inputs:
        sound = sound and isfinite(value)
    for i in range(len(inputs)):
        work[i] = inputs[i] if sound else nan


def copy_layer_numbers(y: int, size: int, place: int, data: np.ndarray, work: np.ndarray) -> None:
    """Copy numbers of the program, the biases of a layer before all else.

    Args:
        y: where in the scratch array they are to stand.
        size: how many there are.
        place: of the first one in the data.
        data: numbers of the program.
        work: scratch array.
    """
    for i in range(size):
        work[y + i] = data[place + i]


def clear_layer(y: int, size: int, work: np.ndarray) -> None:
    """Write zeros.

    Args:
        y: where in the scratch array.
        size: how many.
        work: scratch array.
    """
    for i in range(size):
        work[y + i] = 0.0


def add_layer_products(
    x: int, count: int, y: int, size: int, place: int, data: np.ndarray, work: np.ndarray
) -> None:
    """Add the product of a row of numbers and a matrix to another row of numbers.

    The entries of the result are independent of each other in the inner loop, which is what makes
    it fast. Each is a sum in the order of the inputs; NumPy's matrix product adds in another one.

    Args:
        x: where the factors stand in the scratch array.
        count: how many there are.
        y: where the sums stand.
        size: how many there are.
        place: of the matrix (count, size) in the data, row by row.
        data: numbers of the program.
        work: scratch array.
    """
    for j in range(count):
        factor = work[x + j]
        row = place + j * size
        for i in range(size):
            work[y + i] += factor * data[row + i]


def tanh_units(y: int, size: int, work: np.ndarray) -> None:
    """Replace the numbers of a layer by their activation.

    Args:
        y: where the numbers stand in the scratch array.
        size: how many there are.
        work: scratch array.
    """
    for i in range(y, y + size):
        work[i] = tanh(work[i])


def relu_units(y: int, size: int, work: np.ndarray) -> None:
    """Replace the numbers of a layer by their activation; see `tanh_units`."""
    for i in range(y, y + size):
        work[i] = 0.0 if work[i] < 0.0 else work[i]


def leaky_relu_units(y: int, size: int, work: np.ndarray) -> None:
    """Replace the numbers of a layer by their activation; see `tanh_units`."""
    for i in range(y, y + size):
        work[i] = 0.01 * work[i] if work[i] < 0.0 else work[i]


def elu_units(y: int, size: int, work: np.ndarray) -> None:
    """Replace the numbers of a layer by their activation; see `tanh_units`."""
    for i in range(y, y + size):
        work[i] = expm1(work[i]) if work[i] < 0.0 else work[i]


def silu_units(y: int, size: int, work: np.ndarray) -> None:
    """Replace the numbers of a layer by their activation; see `tanh_units`."""
    for i in range(y, y + size):
        work[i] = 0.5 * work[i] * (1.0 + tanh(0.5 * work[i]))


def tanh_slopes(y: int, s: int, size: int, work: np.ndarray) -> None:
    """Multiply numbers by the slopes of an activation.

    Args:
        y: where the activated values stand in the scratch array.
        s: where the numbers stand.
        size: how many there are.
        work: scratch array.
    """
    for i in range(size):
        work[s + i] *= 1.0 - work[y + i] * work[y + i]


def relu_slopes(y: int, s: int, size: int, work: np.ndarray) -> None:
    """Multiply numbers by the slopes of an activation; see `tanh_slopes`."""
    for i in range(size):
        # A value that is NaN makes the slope NaN.
        work[s + i] *= 1.0 if work[y + i] > 0.0 else work[y + i] * 0.0
