"""The letters of pictures."""

from __future__ import annotations

import importlib.util
import itertools
import math
from functools import lru_cache
from pathlib import Path

import pygame

from safe_envs.rendering.style import Color

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
