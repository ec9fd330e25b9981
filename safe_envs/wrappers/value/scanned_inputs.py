"""The inputs that dynamic programs try, and boxes that cover all inputs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safe_envs.errors import ConfigurationError

_ALONG_EACH = {1: 41, 2: 13, 3: 7}
_FEW = 5
_MOST = 100_000


class ScannedInputs(NamedTuple):
    """Inputs, and boxes of inputs.

    Attributes:
        values: the inputs, shape (U, m), the ends of the bounds among them.
        ends: the same as boxes of one point, shape (1, U, m, 2).
        boxes: as many boxes that cover all inputs, shape (1, U, m, 2).
        neighbours: of each input, those next to it along one input, shape (U, 2 m), -1 for none.
    """

    values: np.ndarray
    ends: np.ndarray
    boxes: np.ndarray
    neighbours: np.ndarray


def scanned_inputs(box: Sequence[tuple[float, float]], number: int | None) -> ScannedInputs:
    """Return inputs on a grid within their bounds.

    Args:
        box: (low, high) of each input.
        number: of values along each input; None for one that suits.

    Raises:
        ConfigurationError: They are too many.
    """
    m = len(box)
    count = number or _ALONG_EACH.get(m, _FEW)
    if count**m > _MOST:
        raise ConfigurationError(
            f"inputs = {count}: so many values along each of the problem's inputs make {count**m};"
            f" at most {_MOST} are scanned"
        )
    values = _product([np.linspace(low, high, count) for low, high in box])
    cuts = [np.linspace(low, high, count + 1) for low, high in box]
    boxes = np.stack([_product([c[:-1] for c in cuts]), _product([c[1:] for c in cuts])], axis=-1)
    places = np.array(list(itertools.product(range(count), repeat=m)))
    neighbours = []
    for j, move in itertools.product(range(m), (-1, 1)):
        moved = places.copy()
        moved[:, j] += move
        inside = (moved[:, j] >= 0) & (moved[:, j] < count)
        flat = np.ravel_multi_index(tuple(np.clip(moved, 0, count - 1).T), (count,) * m)
        neighbours.append(np.where(inside, flat, -1))
    ends = np.stack([values, values], axis=-1)
    return ScannedInputs(values, ends[None], boxes[None], np.stack(neighbours, axis=1))


def _product(axes: Sequence[np.ndarray]) -> np.ndarray:
    return np.array(list(itertools.product(*axes)))
