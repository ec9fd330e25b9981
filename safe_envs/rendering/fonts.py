"""The letters of pictures."""

from __future__ import annotations

import importlib.util
from functools import lru_cache
from pathlib import Path

import pygame

from safe_envs.rendering.style import Color


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
