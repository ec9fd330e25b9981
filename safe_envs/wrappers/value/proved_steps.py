"""Proved lower bounds of the expected value after a step, from boxes of states and inputs.

The images of boxes come from interval arithmetic that is rounded outwards. Of each the least value
of the cells that it touches counts, with proved lower bounds of the noise's probabilities for
values in [0, 1], and upper ones for values in [-1, 0].
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.interval_arithmetic import IntervalArithmetic
from safe_envs.dynamics.intervals import Interval
from safe_envs.wrappers.value.grid import Grid
from safe_envs.wrappers.value.noise_boxes import NoiseBoxes
from safe_envs.wrappers.value.normal_bounds import ERROR, normal_above, normal_below
from safe_envs.wrappers.value.step_images import Step, StepImages
from safe_envs.wrappers.value.windows import Windows, windows_of

_UNIT = 2.0**-52
_LARGEST = 1e199
"""Effects of inputs are cut beyond it."""


class ProvedWeights:
    """Probabilities of boxes of noise.

    Args:
        noise: the boxes.

    Attributes:
        below: at most the probability of each, shape (W,).
        above: at least that.
        rest: at least the probability of the noise in none of them.
    """

    def __init__(self, noise: NoiseBoxes) -> None:
        self.below = np.ones(noise.low.shape[1])
        self.above = np.ones(noise.low.shape[1])
        for low, high in zip(noise.low, noise.high, strict=True):
            down, up = 1.0 - 2.0 * _UNIT, 1.0 + 2.0 * _UNIT
            least = np.maximum(normal_below(high) - normal_above(low), 0.0) * down
            most = (normal_above(high) - normal_below(low)) * up
            self.below, self.above = self.below * least * down, self.above * most * up
        self.rest = 0.0
        if len(noise.low):
            total = float(self.below.sum()) * (1.0 - (len(self.below) + 4) * _UNIT)
            self.rest = max(0.0, 1.0 - total) + ERROR

    def expected(self, values: np.ndarray) -> np.ndarray:
        """Return lower bounds of the mean of values, all in [0, 1], or all in [-1, 0].

        Args:
            values: shape (B, R, W).

        Returns:
            The least over R, shape (B,).
        """
        if not len(values):
            return np.zeros(0)
        if values.shape[2] == 1 and self.below[0] == self.above[0] == 1.0:
            return values[:, :, 0].min(axis=1)
        slack = (values.shape[2] + 4) * _UNIT
        up = np.maximum(values, 0.0) @ self.below * (1.0 - slack)
        down = np.minimum(values, 0.0) @ self.above * (1.0 + slack)
        missed = self.rest if values.min() < 0.0 else 0.0
        found = up + down - missed
        return (found - np.abs(found) * _UNIT - 1e-300).min(axis=1)


class ProvedImages:
    """The cells of the means that the next states of boxes touch.

    Args:
        step: of the problem.
        means: grid of the means.
        low: least coordinates of the boxes, n arrays (B,).
        high: largest coordinates.
        inputs: boxes of inputs, shape (U, m, 2), or (B, U, m, 2) with others for each box, from
            which they are taken by number.
        widening: of images along each axis.
    """

    def __init__(
        self,
        step: Step,
        means: Grid,
        ends: tuple[Sequence[np.ndarray], Sequence[np.ndarray]],
        inputs: np.ndarray,
        widening: Sequence[float],
    ) -> None:
        self._means, self._inputs, self._widening = means, inputs, widening
        self._affine = step.is_affine
        given = inputs if inputs.ndim == 4 else inputs[None]
        self._images: StepImages = step.images(*ends, given)
        self.shape = (self._images.images.shape[2], self._images.images.shape[3])

    def windows(self, numbers: np.ndarray, chosen: np.ndarray) -> Windows:
        """Return the windows of boxes under inputs, of B R W images.

        Args:
            numbers: numbers of the boxes, shape (B,).
            chosen: number of the input of each, shape (B,).
        """
        images, effects = self._images
        n = images.shape[4]
        own = images[numbers, 0] if self._affine else images[numbers, chosen]
        low, high = own[..., 0], own[..., 1]
        if self._affine:
            low, high = self._moved(low, high, effects[numbers], self._inputs_of(numbers, chosen))
        if any(self._widening):
            strip = np.asarray(self._widening)
            low = low - (strip + 2.0 * _UNIT * np.abs(low))
            high = high + (strip + 2.0 * _UNIT * np.abs(high))
        return windows_of(self._means, low.reshape(-1, n), high.reshape(-1, n))

    def _inputs_of(self, numbers: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        own = self._inputs.ndim == 4
        return self._inputs[numbers, chosen] if own else self._inputs[chosen]

    @staticmethod
    def _moved(
        low: np.ndarray, high: np.ndarray, effects: np.ndarray, inputs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends of images (B, R, W, n) with what inputs (B, m, 2) add."""
        ops = IntervalArithmetic()
        found = Interval(low, high)
        for j in range(inputs.shape[1]):
            effect = Interval(effects[:, :, None, :, j, 0], effects[:, :, None, :, j, 1])
            given = Interval(*np.moveaxis(inputs[:, None, None, None, j], -1, 0))
            found = ops.add(found, ops.multiply(effect, given))
        cut: Any = (np.abs(effects) >= _LARGEST).any(axis=(3, 4))
        cut = cut[:, :, None, :]
        return np.where(cut, -np.inf, found.low), np.where(cut, np.inf, found.high)
