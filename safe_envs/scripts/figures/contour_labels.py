"""Values on contour lines, at places where they cover nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure

from safe_envs.scripts.figures.style import SMALL

_APART = 2.0
_ROOM = 3.0
"""In pixels, between points of what is drawn, and around a value."""

_TRIED = 80
_FORM = "%.3g"


def write_levels(figure: Figure, axes: Axes, lines: ContourSet) -> None:
    """Write the value of each contour line into it, where nothing else is drawn.

    Args:
        figure: complete, since the places depend on its layout.
        axes: of the contour lines.
        lines: the contour lines; one without room for its value gets none.
    """
    figure.draw_without_rendering()
    curves = [_pixels(axes, segments) for segments in lines.allsegs]
    others = [_drawn(axes, lines)]
    places = []
    for i, (level, own) in enumerate(zip(lines.levels, curves, strict=True)):
        rest = [*others, *(curve for k, curve in enumerate(curves) if k != i)]
        found = _free_place(axes, own, np.concatenate(rest), _extent(axes, _FORM % level))
        if found is not None:
            place, corners = found
            places.append(axes.transData.inverted().transform(place))
            others.append(corners)
    if places:
        style: Any = {"fontsize": SMALL, "fmt": _FORM, "colors": "black", "inline_spacing": 4}
        axes.clabel(lines, manual=places, **style)


def _pixels(axes: Axes, segments: Sequence[Any]) -> np.ndarray:
    """Return points close to each other along curves, shape (k, 2)."""
    parts = [np.empty((0, 2))]
    for segment in segments:
        if len(segment) < 2:
            continue
        points = axes.transData.transform(segment)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        stops = np.arange(0.0, along[-1], _APART)
        parts.append(np.stack([np.interp(stops, along, column) for column in points.T], axis=1))
    return np.concatenate(parts)


def _drawn(axes: Axes, lines: ContourSet) -> np.ndarray:
    """Return points of all lines, marks and edges of areas but those of contour lines."""
    segments = [np.column_stack(line.get_data(orig=False)) for line in axes.lines]
    marks = [axes.transData.transform(np.asarray(each, dtype=float)) for each in segments]
    for collection in axes.collections:
        if collection is not lines and isinstance(collection, Collection):
            for path in collection.get_paths():
                segments += path.to_polygons(closed_only=False)
    return np.concatenate([*marks, _pixels(axes, segments)])


def _extent(axes: Axes, text: str) -> np.ndarray:
    """Return half of the width and height of a value with the room around it."""
    probe = axes.text(0.0, 0.0, text, fontsize=SMALL)
    box = probe.get_window_extent()
    probe.remove()
    return 0.5 * np.array([box.width, box.height]) + _ROOM


def _free_place(
    axes: Axes, own: np.ndarray, others: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the place on a contour line that is furthest from what is drawn.

    Args:
        axes: that the value is to be inside of.
        own: points of the contour line, shape (k, 2).
        others: points of everything else, shape (m, 2).
        half: of the width and the height of the value.

    Returns:
        The place and points that fill the value's box; None if it has no room.
    """
    best, margin = None, 1.0
    inside = axes.bbox.padded(-float(half.max()))
    for k in range(3, len(own) - 3, max(1, len(own) // _TRIED)):
        if not inside.contains(*own[k]):
            continue
        along = own[k + 3] - own[k - 3]
        length = float(np.hypot(*along))
        if length < 3.0 * _APART:
            continue
        turn = np.array([[along[0], along[1]], [-along[1], along[0]]]) / length
        away = np.abs((others - own[k]) @ turn.T) / half
        room = float(away.max(axis=1).min(initial=np.inf))
        if room > margin:
            grid = np.stack(np.meshgrid(*(np.linspace(-h, h, 9) for h in half)), axis=-1)
            best, margin = (own[k], own[k] + grid.reshape(-1, 2) @ turn), room
    return best
