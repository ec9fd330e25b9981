"""Axes: a box of a picture that shows a range of each of two coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from safe_envs.rendering.canvas import Box, Canvas
from safe_envs.rendering.style import GREY, INK, LINE, SMALL

Range = tuple[float, float]


def nice_step(span: float, most: int) -> float:
    """Return the smallest of ..., 1, 2, 5, 10, ... that divides a span into few parts.

    Args:
        span: to divide, above 0.
        most: parts.

    Returns:
        The length of a part.
    """
    rough = span / most
    decade = 10.0 ** math.floor(math.log10(rough))
    return next(m * decade for m in (1.0, 2.0, 5.0, 10.0) if m * decade >= 0.999999 * rough)


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Return round numbers at equal distances in a range.

    Args:
        low: end of the range.
        high: other end.
        most: parts into which they divide the range.

    Returns:
        The numbers, in ascending order.
    """
    step = nice_step(high - low, most)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [step * i for i in range(first, last + 1)]


def grown(shown: Range, values: np.ndarray) -> Range:
    """Return a range widened by a power of 2 around its middle, to contain all finite values.

    Args:
        shown: the range.
        values: of any shape.

    Returns:
        The range itself where it contains them already.
    """
    middle, half = 0.5 * (shown[0] + shown[1]), 0.5 * (shown[1] - shown[0])
    far = np.abs(values[np.isfinite(values)] - middle).max(initial=0.0)
    if far <= half:
        return shown
    half *= 2.0 ** math.ceil(math.log2(far / half))
    return middle - half, middle + half


@dataclass(frozen=True)
class Axes:
    """A box with a range along each side; y points upwards.

    Attributes:
        box: left, top, width and height in pixels.
        x: range from left to right.
        y: range from bottom to top.
    """

    box: Box
    x: Range
    y: Range

    @classmethod
    def equal(cls, box: Box, x: Range, y: Range) -> Axes:
        """Make axes with the same scale along both sides, by widening a range to fill the box.

        Args:
            box: left, top, width and height in pixels.
            x: range from left to right.
            y: range from bottom to top.

        Returns:
            The axes.
        """
        scale = min(box[2] / (x[1] - x[0]), box[3] / (y[1] - y[0]))
        ranges = [
            (0.5 * (low + high), 0.5 * side / scale)
            for (low, high), side in ((x, box[2]), (y, box[3]))
        ]
        wide, tall = ((middle - half, middle + half) for middle, half in ranges)
        return cls(box, wide, tall)

    @property
    def scale(self) -> tuple[float, float]:
        """Pixels per unit, along x and y."""
        return self.box[2] / (self.x[1] - self.x[0]), self.box[3] / (self.y[1] - self.y[0])

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Return the pixel of a point.

        Args:
            x: coordinate to the right.
            y: coordinate upwards.

        Returns:
            Pixels from the left and from the top of the picture.
        """
        (left, top, _, height), (right, up) = self.box, self.scale
        return left + right * (x - self.x[0]), top + height - up * (y - self.y[0])

    def places(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the pixels of points.

        Args:
            x: coordinates to the right, shape (k,).
            y: coordinates upwards, shape (k,).

        Returns:
            As for `place`, shape (k, 2).
        """
        return np.stack(self.place(x, y), axis=-1)  # pyright: ignore[reportArgumentType, reportCallIssue]  (arithmetic of arrays)

    def furnish(self, canvas: Canvas, x_label: str, y_label: str, grid: bool = True) -> None:
        """Draw the grid, the ticks with their numbers, the frame and the labels.

        Args:
            canvas: to draw on.
            x_label: below the box.
            y_label: to its left.
            grid: whether there is one.
        """
        left, top, width, height = self.box
        bottom = top + height
        for tick in ticks(*self.x, most=max(2, width // 80)):
            px = round(self.place(tick, 0.0)[0])
            if grid:
                canvas.fill((px, top, 1, height), LINE)
            canvas.text(_tick_text(tick), (px, bottom + 4), GREY, SMALL, align=(0.5, 0.0))
        for tick in ticks(*self.y, most=max(2, height // 55)):
            py = round(self.place(0.0, tick)[1])
            if grid:
                canvas.fill((left, py, width, 1), LINE)
            canvas.text(_tick_text(tick), (left - 6, py), GREY, SMALL, align=(1.0, 0.5))
        canvas.frame((left - 1, top - 1, width + 2, height + 2), GREY)
        canvas.text(x_label, (left + width / 2, bottom + 21), INK, SMALL, align=(0.5, 0.0))
        canvas.text(
            y_label, (left - 56, top + height / 2), INK, SMALL, align=(0.0, 0.5), turned=True
        )


def _tick_text(tick: float) -> str:
    return f"{tick:.6g}".replace("-", "\u2212")
