"""The texts of a frame of an env, and the frame without them."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
import pygame

from safe_envs.rendering.canvas import Canvas, cut, text_surface
from safe_envs.rendering.scenes import road
from safe_envs.rendering.style import PAPER
from tests.readable import Written


def frame_texts(make: Callable[[], Any]) -> tuple[list[Written], np.ndarray, list[str]]:
    """The texts of a frame, the frame without them, and which of them are covered.

    Args:
        make: returns an env that has never been drawn, at some state.
    """
    drawn: list[tuple[str, Any, Any, Any]] = []

    def frame(*, with_texts: bool) -> np.ndarray:
        methods = {name: getattr(Canvas, name) for name in ("text", "label")}

        def replaced(name: str) -> Callable[..., Any]:
            def write(self: Canvas, text: str, at: Any, *rest: Any, **how: Any) -> Any:
                if not with_texts:
                    # Only its width is of use.
                    return methods[name](Canvas((1, 1)), text, at, *rest, **how)
                if text.strip():
                    drawn.append((name, self.surface.get_clip(), (text, at, *rest), how))
                return methods[name](self, text, at, *rest, **how)

            return write

        # Its drawings are kept for all envs of the process.
        road._furniture.cache_clear()
        with mock.patch.multiple(Canvas, text=replaced("text"), label=replaced("label")):
            shown = make().render()
        road._furniture.cache_clear()
        return shown

    shown = frame(with_texts=True)
    found = [_written(shown, *each) for each in drawn]
    covered = [f"{text.text!r} is covered" for text, seen in found if not seen]
    return [text for text, _ in found], frame(with_texts=False), covered


def _written(
    frame: np.ndarray, name: str, clip: pygame.Rect, given: tuple[Any, ...], how: dict[str, Any]
) -> tuple[Written, bool]:
    bound = inspect.signature(getattr(Canvas, name)).bind(None, *given, **how)
    bound.apply_defaults()
    options = bound.arguments
    text, size, color = (options[key] for key in ("text", "size", "color"))
    bold, widest = options.get("bold", False), options.get("widest")
    line = text if widest is None else cut(text, size, bold, widest)
    letters = text_surface(line, size, bold, color, options.get("turned", False))
    alpha = pygame.surfarray.array_alpha(letters).T
    left, top = (
        round(place - share * side)
        for place, share, side in zip(
            options["at"], options["align"], letters.get_size(), strict=True
        )
    )
    # The box of the ink: a line of text is higher than its letters.
    rows, columns = np.nonzero(alpha)
    ink = alpha[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    box = pygame.Rect(left + columns.min(), top + rows.min(), *ink.shape[::-1])
    height, width = frame.shape[:2]
    shown = box.clip(pygame.Rect(0, 0, width, height))
    y, x = np.mgrid[shown.top : shown.bottom, shown.left : shown.right]
    pixels = (y * width + x).ravel()
    halo = PAPER if name == "label" else None
    inside, seen = bool(clip.contains(box)), True
    if inside:
        letters_seen = frame[box.top : box.bottom, box.left : box.right][ink >= 250].astype(int)
        seen = bool((abs(letters_seen - np.array(color)) <= 40).all())
    return Written(text, pixels, color, halo, size, inside), seen
