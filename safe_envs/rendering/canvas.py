"""Anti-aliased lines, shapes and texts on a surface in memory; no display is needed."""

from __future__ import annotations

import importlib.util
import itertools
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pygame

from safe_envs.rendering.style import INK, NORMAL, PAPER, SMALL, Color

HALO = 2
"""Pixels of a halo around the letters."""


def _font(size: int, bold: bool) -> pygame.font.Font:
    """Return DejaVu Sans, which comes with matplotlib: pictures are the same on every machine."""
    font = _loaded_font(size, bold)
    try:
        font.get_height()
    except pygame.error:
        # Gymnasium's own envs quit pygame when they close: fonts loaded before become unusable.
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
def text_surface(text: str, size: int, bold: bool, color: Color, turned: bool) -> pygame.Surface:
    """Return a text as a surface with a transparent background.

    Args:
        text: a line.
        size: of the letters.
        bold: whether they are bold.
        color: of the letters.
        turned: whether it runs upwards.

    Returns:
        A surface of the size of the text.
    """
    surface = _font(size, bold).render(text, True, color)
    return pygame.transform.rotate(surface, 90) if turned else surface


@lru_cache(maxsize=256)
def haloed_surface(text: str, size: int, color: Color, halo: Color) -> pygame.Surface:
    """Return a text with a halo around its letters.

    Args:
        text: a line.
        size: of the letters.
        color: of the letters.
        halo: colour around them.

    Returns:
        A surface of the size of the text, with room for the halo on all sides.
    """
    letters, around = (text_surface(text, size, False, each, False) for each in (color, halo))
    width, height = letters.get_size()
    surface = pygame.Surface((width + 2 * HALO, height + 2 * HALO), pygame.SRCALPHA, 32)
    for x, y in itertools.product(range(2 * HALO + 1), repeat=2):
        if math.hypot(x - HALO, y - HALO) <= HALO + 0.5:
            surface.blit(around, (x, y))
    surface.blit(letters, (HALO, HALO))
    return surface


def text_size(text: str, size: int) -> tuple[int, int]:
    """Return the width and height in pixels of a line of text.

    Args:
        text: the line.
        size: of the letters.
    """
    return _font(size, False).size(text)


def cut(text: str, size: int, bold: bool, widest: int) -> str:
    """Return a text with its end cut off where it is too wide.

    Args:
        text: a line.
        size: of the letters.
        bold: whether they are bold.
        widest: most pixels.

    Returns:
        The text itself, or its beginning with an ellipsis.
    """
    font = _font(size, bold)
    if font.size(text)[0] <= widest:
        return text
    while text and font.size(text + "…")[0] > widest:
        text = text[:-1]
    return text + "…"


_APART = 1.5
_MOST_POINTS = 1000
_MOST_IN_CHART = 400

BRUSHES = {
    1: ((0.0, 0.0),),
    2: ((0.0, -0.5), (0.43, 0.25), (-0.43, 0.25)),
    3: ((0.0, -0.9), (0.9, 0.0), (0.0, 0.9), (-0.9, 0.0), (0.0, 0.0)),
}
"""Offsets of the thin lines that make a line of 1, 2 or 3 pixels."""


def apart(points: np.ndarray) -> np.ndarray:
    """Return indices of points about 1.5 pixels apart along a path, with the first and the last."""
    steps = np.floor(_lengths(points) / _APART)
    return np.unique(np.concatenate([[0], np.flatnonzero(np.diff(steps)) + 1, [len(points) - 1]]))


def dash_ends(points: np.ndarray, period: float) -> list[tuple[list[float], list[float]]]:
    """Return the ends of each dash of a dashed path.

    Args:
        points: of the path, shape (k, 2).
        period: length of a dash and a gap.

    Returns:
        Pairs of points (x, y).
    """
    along = _lengths(points)
    stops = np.arange(0.0, along[-1], period / 2)
    places = np.stack([np.interp(stops, along, points[:, i]) for i in range(2)], axis=1).tolist()
    return list(zip(places[::2], places[1::2], strict=False))


def _lengths(points: np.ndarray) -> np.ndarray:
    """Return the length of a path up to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def thinned(count: int, most: int = _MOST_POINTS) -> np.ndarray:
    """Return indices of the points of a trail to draw, with the last one.

    Args:
        count: of the points of the trail.
        most: indices.

    Returns:
        Ascending indices.
    """
    # A power of two: points once drawn stay as the trail grows.
    stride = 1 << max(0, (count - 1) // most).bit_length()
    kept = np.arange(0, count, stride)
    return kept if kept[-1] == count - 1 else np.append(kept, count - 1)


def runs(flags: np.ndarray) -> list[slice]:
    """Return where flags are set, each run with the point before it, to be drawn as a line."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [slice(max(int(a) - 1, 0), int(b)) for a, b in edges.reshape(-1, 2)]


def thinned_minima(times: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return fewer points of a curve, with the smallest value of each group of points.

    Args:
        times: shape (k,).
        h: values, shape (k,).

    Returns:
        Times and values of at most about two points for each pixel of a chart.
    """
    stride = 1 + len(h) // _MOST_IN_CHART
    if stride == 1:
        return times, h
    starts = np.arange(0, len(h), stride)
    return times[np.minimum(starts + stride - 1, len(h) - 1)], np.minimum.reduceat(h, starts)


Point = Sequence[float]
Box = tuple[int, int, int, int]

_FAR = 20_000.0
"""Points further away are drawn at this distance: a surface has 16-bit coordinates."""


class Canvas:
    """Drawing on a surface, in pixels from its left upper corner.

    Attributes:
        surface: that is drawn on.

    Args:
        size: width and height in pixels.
        clear: begin with a transparent surface, to be laid over another, in place of paper.
    """

    def __init__(self, size: tuple[int, int], clear: bool = False) -> None:
        self.surface = pygame.Surface(size, pygame.SRCALPHA if clear else 0, 32)
        self.surface.fill((0, 0, 0, 0) if clear else PAPER)

    def lay(self, other: Canvas) -> None:
        """Lay another canvas over this one."""
        self.surface.blit(other.surface, (0, 0))

    @contextmanager
    def within(self, box: Box) -> Iterator[None]:
        """Restrict drawing to a box."""
        before = self.surface.get_clip()
        self.surface.set_clip(box)
        yield
        self.surface.set_clip(before)

    def fill(self, box: Sequence[float], color: Color, rounded: int = 0) -> None:
        """Fill a rectangle.

        Args:
            box: left, top, width and height.
            color: of the area.
            rounded: radius of the corners.
        """
        self.frame(box, color, 0, rounded)

    def frame(self, box: Sequence[float], color: Color, width: int = 1, rounded: int = 0) -> None:
        """Draw the outline of a rectangle.

        Args:
            box: left, top, width and height.
            color: of the line.
            width: of the line; 0 fills the rectangle.
            rounded: radius of the corners.
        """
        pygame.draw.rect(
            self.surface, color, pygame.Rect([round(v) for v in box]), width, border_radius=rounded
        )

    def line(self, start: Point, end: Point, color: Color, width: int = 1) -> None:
        """Draw a straight line.

        Args:
            start: (x, y).
            end: (x, y).
            color: of the line.
            width: of the line.
        """
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
        # Half a pixel apart: with a whole one there are gaps, and a polygon has no smooth edges.
        for k in range(1 - width, width):
            x, y = (0.5 * k * step for step in across)
            pygame.draw.aaline(
                self.surface, color, (start[0] + x, start[1] + y), (end[0] + x, end[1] + y)
            )

    def path(self, points: np.ndarray, color: Color, width: int = 1) -> None:
        """Draw lines through points.

        Args:
            points: shape (k, 2).
            color: of the lines.
            width: of the lines, 3 at most.
        """
        if len(points) < 2:
            return
        points = np.clip(points, -_FAR, _FAR)
        if len(points) > 200:
            points = points[apart(points)]
        # Wide lines of the library have gaps at their corners: a brush of thin ones has none.
        for offset in BRUSHES[min(width, 3)]:
            through = (points + offset).tolist()
            # Given two points, the library's `aalines` reads a third one out of bounds.
            if len(through) == 2:
                pygame.draw.aaline(self.surface, color, *through)
            else:
                pygame.draw.aalines(self.surface, color, False, through)

    def dashes(
        self, points: np.ndarray, color: Color, width: int = 1, period: float = 12.0
    ) -> None:
        """Draw a dashed line through points.

        Args:
            points: shape (k, 2).
            color: of the dashes.
            width: of the dashes.
            period: length of a dash and a gap.
        """
        if len(points) < 2:
            return
        points = np.clip(points, -_FAR, _FAR)
        for start, end in dash_ends(points, period):
            self.line(start, end, color, width)

    def shape(
        self, points: Any, fill: Color | None, outline: Color | None = None, width: int = 1
    ) -> None:
        """Draw a polygon with smooth edges.

        Args:
            points: the corners, shape (k, 2).
            fill: colour of the area; None for none.
            outline: colour of the edge; by default that of the area.
            width: of the edge.
        """
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
        """Draw a circle.

        Args:
            center: (x, y).
            radius: of the circle.
            fill: colour of the area; None for none.
            outline: colour of the edge; None for none.
            width: of the edge.
        """
        if not all(-_FAR < v < _FAR for v in (*center, radius)):
            return
        if fill is not None:
            pygame.draw.aacircle(self.surface, fill, center, radius)
        if outline is not None:
            pygame.draw.aacircle(self.surface, outline, center, radius, width)

    def diamond(
        self, center: Point, size: float, fill: Color | None, outline: Color, width: int = 2
    ) -> None:
        """Draw a square that stands on a corner.

        Args:
            center: (x, y).
            size: from the center to a corner.
            fill: colour of the area; None for none.
            outline: colour of the edge.
            width: of the edge.
        """
        x, y = center
        corners = [(x, y - size), (x + size, y), (x, y + size), (x - size, y)]
        self.shape(corners, fill, outline, width)

    def cross(self, center: Point, size: float, color: Color, width: int = 3) -> None:
        """Draw an X.

        Args:
            center: (x, y).
            size: half of its width and height.
            color: of the lines.
            width: of the lines.
        """
        x, y = center
        for side in (-size, size):
            self.line((x - size, y - side), (x + size, y + side), color, width)

    def arrow(
        self, start: Point, end: Point, color: Color, width: int = 2, head: float = 7.0
    ) -> None:
        """Draw an arrow.

        Args:
            start: (x, y).
            end: (x, y) of the tip.
            color: of the arrow.
            width: of the line.
            head: length of the head.
        """
        length = math.dist(start, end)
        if length < 1.0:
            return
        along = (end[0] - start[0]) / length, (end[1] - start[1]) / length
        base = end[0] - head * along[0], end[1] - head * along[1]
        self.line(start, base, color, width)
        x, y = 0.55 * head * along[1], 0.55 * head * along[0]
        sides = [(base[0] + x, base[1] - y), (base[0] - x, base[1] + y)]
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
            turned: write upwards.
            widest: most pixels; a longer text is cut.

        Returns:
            The width of what was written.
        """
        if widest is not None:
            text = cut(text, size, bold, widest)
        surface = text_surface(text, size, bold, color, turned)
        width, height = surface.get_size()
        self.surface.blit(
            surface, (round(at[0] - align[0] * width), round(at[1] - align[1] * height))
        )
        return width

    def label(
        self,
        text: str,
        at: Point,
        color: Color = INK,
        size: int = SMALL,
        align: tuple[float, float] = (0.5, 1.0),
    ) -> None:
        """Write a line with a halo of paper, which sets it off from what moves below it.

        Args:
            text: to write.
            at: as for `text`.
            color: of the letters.
            size: of the letters.
            align: as for `text`.
        """
        surface = haloed_surface(text, size, color, PAPER)
        width, height = (side - 2 * HALO for side in surface.get_size())
        left, top = round(at[0] - align[0] * width), round(at[1] - align[1] * height)
        self.surface.blit(surface, (left - HALO, top - HALO))

    def pixels(self) -> np.ndarray:
        """Return a copy of what was drawn, uint8 of shape (height, width, 3)."""
        width, height = self.surface.get_size()
        packed = pygame.surfarray.pixels2d(self.surface).T.view(np.uint8)
        pixels = np.empty((height, width, 3), dtype=np.uint8)
        # Channel by channel: many times faster than the conversions of the library.
        for channel, shift in enumerate(self.surface.get_shifts()[:3]):
            byte = shift // 8 if sys.byteorder == "little" else 3 - shift // 8
            pixels[..., channel] = packed[:, byte::4]
        return pixels
