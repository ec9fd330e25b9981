"""What the figures of several chapters have in common."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from matplotlib.axes import Axes

from safe_envs.scripts.figures.style import UNSAFE

SHADED: dict[str, Any] = {"color": UNSAFE, "alpha": 0.35, "linewidth": 0, "zorder": 0}
"""Style of unsafe areas."""


def draw_lines(
    axes: Axes,
    data: Mapping[str, Any],
    lines: Iterable[tuple[str, str, str, float, str]],
    x: str,
    y: str,
) -> None:
    """Draw curves of an outcome's data.

    Args:
        axes: where.
        data: curves by name, each with its columns.
        lines: name of a curve, colour, dashes, width in points and label of each line.
        x: column across.
        y: column upwards.
    """
    for name, color, dashes, width, label in lines:
        curve = data[name]
        axes.plot(curve[x], curve[y], dashes, color=color, linewidth=width, label=label)


def draw_interval(
    axes: Axes, x: Any, ends: Any, color: str, alpha: float, dashes: str = "-", **line: Any
) -> None:
    """Draw a curve with the band of its interval.

    Args:
        axes: where.
        x: across, shape (K,).
        ends: lower ends, values and upper ends, shape (3, K).
        color: of both.
        alpha: opacity of the band.
        dashes: of the curve.
        line: further style of the curve.
    """
    low, middle, high = ends
    axes.fill_between(x, low, high, color=color, alpha=alpha, linewidth=0)
    axes.plot(x, middle, dashes, color=color, **line)
