"""Anti-aliased lines, shapes and texts on a surface in memory; no display is needed."""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pygame

from safe_envs.rendering.style import INK, NORMAL, PAPER, Color

Point = Sequence[float]
Box = tuple[int, int, int, int]

_FAR = 20_000.0
"""Points further away are drawn at this distance: the coordinates of a surface are 16-bit numbers.
"""

_BRUSHES = {
    1: ((0.0, 0.0),),
    2: ((0.0, -0.5), (0.43, 0.25), (-0.43, 0.25)),
    3: ((0.0, -0.9), (0.9, 0.0), (0.0, 0.9), (-0.9, 0.0), (0.0, 0.0)),
}
"""Offsets of the thin lines that make a line of 1, 2 or 3 pixels."""


def _font(size: int, bold: bool) -> pygame.font.Font:
    """DejaVu Sans, which has all the letters and comes with matplotlib: the same picture on every
    machine.
    """
    font = _loaded_font(size, bold)
    try:
        font.get_height()
    except pygame.error:
        # Gymnasium's own envs quit pygame when they close, after which no font that was loaded
        # before can be used.
        _loaded_font.cache_clear()
        font = _loaded_font(size, bold)
    return font


@lru_cache(maxsize=16)
def _loaded_font(size: int, bold: bool) -> pygame.font.Font:
    pygame.font.init()
    spec = importlib.util.find_spec("matplotlib")
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    path = Path(spec.origin or "").parent / "mpl-data" / "fonts" / "ttf" / name if spec else Path()
    return pygame.font.Font(str(path) if path.is_file() else None, size)


@lru_cache(maxsize=1024)
def _text(text: str, size: int, bold: bool, color: Color, turned: bool) -> pygame.Surface:
    surface = _font(size, bold).render(text, True, color)
    return pygame.transform.rotate(surface, 90) if turned else surface


def _apart(points: np.ndarray) -> np.ndarray:
    """Indices of points that lie about a pixel and a half apart along a path, the first and the
    last among them.
    """
    steps = np.floor(np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))]) / 1.5)
    return np.unique(np.concatenate([[0], np.flatnonzero(np.diff(steps)) + 1, [len(points) - 1]]))


class Canvas:
    """Drawing on a surface, in pixels from its left upper corner.

    Attributes:
        surface: that is drawn on.

    Args:
        size: width and height in pixels.
        clear: begin with nothing, to be laid over something else, in place of paper.
    """

    def __init__(self, size: tuple[int, int], clear: bool = False) -> None:
        self.surface = pygame.Surface(size, pygame.SRCALPHA if clear else 0, 32)
        self.surface.fill((0, 0, 0, 0) if clear else PAPER)

    def lay(self, other: Canvas, at: tuple[int, int] = (0, 0)) -> None:
        """Lay another canvas over this one."""
        self.surface.blit(other.surface, at)

    def photograph(self, pixels: np.ndarray, box: Box) -> None:
        """Show a picture, uint8 of shape (height, width, 3), as large as it fits into a box."""
        left, top, width, height = box
        shown = pygame.surfarray.make_surface(pixels.swapaxes(0, 1))
        scale = min(width / shown.get_width(), height / shown.get_height())
        size = max(1, round(scale * shown.get_width())), max(1, round(scale * shown.get_height()))
        self.surface.blit(
            pygame.transform.smoothscale(shown, size),
            (left + (width - size[0]) // 2, top + (height - size[1]) // 2),
        )

    def within(self, box: Box | None) -> None:
        """Draw only inside a box from now on; None for everywhere."""
        self.surface.set_clip(box)

    def fill(self, box: Sequence[float], color: Color, rounded: int = 0) -> None:
        """Fill a rectangle of left, top, width and height."""
        pygame.draw.rect(
            self.surface, color, pygame.Rect([round(v) for v in box]), border_radius=rounded
        )

    def frame(self, box: Sequence[float], color: Color, width: int = 1, rounded: int = 0) -> None:
        """Draw the outline of a rectangle."""
        pygame.draw.rect(
            self.surface, color, pygame.Rect([round(v) for v in box]), width, border_radius=rounded
        )

    def line(self, start: Point, end: Point, color: Color, width: int = 1) -> None:
        """Draw a straight line."""
        length = math.dist(start, end)
        if not all(-_FAR < v < _FAR for v in (*start, *end)) or length < 1e-6:
            return
        left, top, thick = min(start[0], end[0]), min(start[1], end[1]), 0.5 * (width - 1)
        if start[1] == end[1]:
            self.fill((left, top - thick, length, width), color)
            return
        if start[0] == end[0]:
            self.fill((left - thick, top, width, length), color)
            return
        across = (start[1] - end[1]) / length, (end[0] - start[0]) / length
        # Side by side, half a pixel apart: a polygon has no smooth edges, and lines a whole pixel
        # apart have gaps.
        for k in range(1 - width, width):
            x, y = (0.5 * k * step for step in across)
            pygame.draw.aaline(
                self.surface, color, (start[0] + x, start[1] + y), (end[0] + x, end[1] + y)
            )

    def path(self, points: np.ndarray, color: Color, width: int = 1) -> None:
        """Draw lines through points, shape (k, 2), up to 3 pixels wide."""
        if len(points) < 2:
            return
        points = np.clip(points, -_FAR, _FAR)
        if len(points) > 200:
            points = points[_apart(points)]
        # Wide lines of the library have gaps at their corners: a brush of thin ones has none.
        for offset in _BRUSHES[min(width, 3)]:
            through = (points + offset).tolist()
            # Of two points the library's `aalines` looks at a third, so that its picture is a
            # matter of chance.
            if len(through) == 2:
                pygame.draw.aaline(self.surface, color, *through)
            else:
                pygame.draw.aalines(self.surface, color, False, through)

    def dashes(
        self, points: np.ndarray, color: Color, width: int = 1, period: float = 12.0
    ) -> None:
        """Draw a dashed line through points, shape (k, 2)."""
        if len(points) < 2:
            return
        points = np.clip(points, -_FAR, _FAR)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        stops = np.arange(0.0, along[-1], period / 2)
        places = np.stack(
            [np.interp(stops, along, points[:, i]) for i in range(2)], axis=1
        ).tolist()
        for start, end in zip(places[::2], places[1::2], strict=False):
            self.line(start, end, color, width)

    def shape(
        self, points: Any, fill: Color | None, outline: Color | None = None, width: int = 1
    ) -> None:
        """Draw a polygon with smooth edges."""
        vertices = np.clip(np.asarray(points, dtype=float), -_FAR, _FAR)
        if fill is not None:
            pygame.draw.polygon(self.surface, fill, vertices.tolist())
        self.path(np.concatenate([vertices, vertices[:1]]), outline or fill or INK, width)

    def disk(
        self,
        center: Point,
        radius: float,
        fill: Color | None,
        outline: Color | None = None,
        width: int = 2,
    ) -> None:
        """Draw a circle, filled or not."""
        if not all(-_FAR < v < _FAR for v in (*center, radius)):
            return
        if fill is not None:
            pygame.draw.aacircle(self.surface, fill, center, radius)
        if outline is not None:
            pygame.draw.aacircle(self.surface, outline, center, radius, width)

    def diamond(
        self, center: Point, size: float, fill: Color | None, outline: Color, width: int = 2
    ) -> None:
        """Draw a square that stands on a corner."""
        x, y = center
        self.shape(
            [(x, y - size), (x + size, y), (x, y + size), (x - size, y)], fill, outline, width
        )

    def cross(self, center: Point, size: float, color: Color, width: int = 3) -> None:
        """Draw an X."""
        x, y = center
        for side in (-size, size):
            self.line((x - size, y - side), (x + size, y + side), color, width)

    def arrow(
        self, start: Point, end: Point, color: Color, width: int = 2, head: float = 7.0
    ) -> None:
        """Draw an arrow."""
        length = math.dist(start, end)
        if length < 1.0:
            return
        along = (end[0] - start[0]) / length, (end[1] - start[1]) / length
        base = end[0] - head * along[0], end[1] - head * along[1]
        self.line(start, base, color, width)
        sides = [
            (base[0] + s * along[1], base[1] - s * along[0]) for s in (0.55 * head, -0.55 * head)
        ]
        self.shape([end, *sides], color)

    def text(
        self,
        text: str,
        at: Point,
        color: Color = INK,
        size: int = NORMAL,
        *,
        bold: bool = False,
        align: tuple[float, float] = (0.0, 0.0),
        turned: bool = False,
        widest: int | None = None,
    ) -> int:
        """Write a line.

        Args:
            text: to write.
            at: place of the point of the text that `align` says.
            color: of the letters.
            size: of the letters.
            bold: whether they are bold.
            align: (0, 0) is the left upper corner of the text, (1, 1) the right lower one.
            turned: write from below to above.
            widest: in pixels; a longer text is cut.

        Returns:
            The width of what was written.
        """
        if widest is not None and _font(size, bold).size(text)[0] > widest:
            while text and _font(size, bold).size(text + "…")[0] > widest:
                text = text[:-1]
            text += "…"
        surface = _text(text, size, bold, color, turned)
        width, height = surface.get_size()
        self.surface.blit(
            surface, (round(at[0] - align[0] * width), round(at[1] - align[1] * height))
        )
        return width

    def pixels(self) -> np.ndarray:
        """What was drawn, uint8 of shape (height, width, 3), in memory of its own."""
        width, height = self.surface.get_size()
        packed = pygame.surfarray.pixels2d(self.surface).T.view(np.uint8)
        pixels = np.empty((height, width, 3), dtype=np.uint8)
        # Channel by channel: many times quicker than the conversions of the library.
        for channel, shift in enumerate(self.surface.get_shifts()[:3]):
            pixels[..., channel] = packed[:, _byte(shift) :: 4]
        return pixels


def _byte(shift: int) -> int:
    """Where in the memory of a pixel a channel is."""
    return shift // 8 if sys.byteorder == "little" else 3 - shift // 8
