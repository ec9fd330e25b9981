"""Whether what is written in a picture can be read, by the pixels below it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np

UNIFORM = 1.6
"""Largest contrast of two pixels below a text: a grid has less, a line or an edge more."""

LEGIBLE = 4.5
"""Least contrast of letters to what is below them. Source: WCAG 2.2, 1.4.3."""


@dataclass(frozen=True)
class Written:
    """A text of a picture.

    Attributes:
        text: as given.
        pixels: flat indices of the pixels of its box, in ascending order.
        color: of the letters, from 0 to 255.
        halo: colour of the outline around the letters; None without one.
        size: of the letters, in points or pixels.
        inside: whether its box is within the picture.
    """

    text: str
    pixels: np.ndarray
    color: tuple[int, int, int]
    halo: tuple[int, int, int] | None
    size: float
    inside: bool


def luminance(pixels: Any) -> np.ndarray:
    """Relative luminance of sRGB pixels (..., 3) from 0 to 255. Source: WCAG 2.2."""
    channels = np.asarray(pixels, dtype=float) / 255.0
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return linear @ np.array([0.2126, 0.7152, 0.0722])


def contrast(one: Any, other: Any) -> Any:
    """Contrast ratio of luminances, from 1 to 21. Source: WCAG 2.2."""
    return (np.maximum(one, other) + 0.05) / (np.minimum(one, other) + 0.05)


def unreadable(texts: list[Written], background: np.ndarray) -> list[str]:
    """What is wrong with texts on a picture that was drawn without them.

    Args:
        texts: of the picture.
        background: the picture without texts, uint8 of shape (height, width, 3).
    """
    found, lights = [], luminance(background).ravel()
    for each in texts:
        if not each.inside:
            found.append(f"{each.text!r} is cut off")
        below = lights[each.pixels]
        if not below.size:
            continue
        if each.halo is None:
            across = contrast(below.max(), below.min())
            if across > UNIFORM:
                found.append(f"{each.text!r} is on a line or an edge (contrast {across:.2f})")
            least = contrast(luminance(each.color), below).min()
        else:
            least = contrast(luminance(each.color), luminance(each.halo))
        if least < LEGIBLE:
            found.append(f"{each.text!r} is hard to tell from what is below (contrast {least:.2f})")
    for one, other in itertools.combinations(texts, 2):
        a, b = one.pixels, other.pixels
        if a.size and b.size and a[0] <= b[-1] and b[0] <= a[-1] and np.intersect1d(a, b).size:
            found.append(f"{one.text!r} overlaps {other.text!r}")
    return found


def figure_texts(figure: Any, dpi: int = 150) -> tuple[list[Written], np.ndarray]:
    """The texts that are drawn in a figure of Matplotlib, and the figure without them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    drawn: list[Text] = []
    draw = Text.draw

    def kept(self: Text, renderer: Any) -> None:
        if self.get_visible() and self.get_text().strip():
            drawn.append(self)
        draw(self, renderer)

    # A first time for the layout, in which texts are drawn nowhere.
    canvas.draw()
    figure.set_layout_engine("none")
    with mock.patch.object(Text, "draw", kept):
        canvas.draw()
    texts = [_written(text, canvas) for text in drawn]
    with mock.patch.object(Text, "draw", return_value=None):
        canvas.draw()
    return texts, np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _written(text: Any, canvas: Any) -> Written:
    from matplotlib.colors import to_rgb

    width, height = canvas.get_width_height()
    turned = text.get_rotation() % 90.0
    box = text.get_window_extent()
    left, right = (int(np.clip(edge, 0, width)) for edge in (box.x0 - 1, box.x1 + 2))
    top, low = (int(np.clip(height - edge, 0, height)) for edge in (box.y1 + 1, box.y0 - 2))
    y, x = np.mgrid[top:low, left:right] + 0.5
    across, up = x - 0.5 * (box.x0 + box.x1), height - y - 0.5 * (box.y0 + box.y1)
    half = np.array([box.width, box.height]) / 2
    if turned:
        angle = text.get_rotation()
        text.set_rotation(0.0)
        flat = text.get_window_extent()
        text.set_rotation(angle)
        half = np.array([flat.width, flat.height]) / 2
        cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        across, up = cos * across + sin * up, cos * up - sin * across
    # Half a pixel of anti-aliasing is none of it.
    within = (abs(across) < half[0] - 0.5) & (abs(up) < half[1] - 0.5)
    pixels = (np.floor(y) * width + np.floor(x)).astype(int)[within]
    effects = [e for e in text.get_path_effects() if "foreground" in getattr(e, "_gc", {})]
    halo = _bytes(to_rgb(effects[0]._gc["foreground"])) if effects else None
    inside = box.x0 >= -0.5 and box.y0 >= -0.5 and box.x1 <= width + 0.5 and box.y1 <= height + 0.5
    color = _bytes(to_rgb(text.get_color()))
    return Written(text.get_text(), pixels, color, halo, text.get_fontsize(), inside)


def _bytes(color: Any) -> tuple[int, int, int]:
    r, g, b = (round(255 * channel) for channel in color)
    return r, g, b
