"""What the figures of several chapters share."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes

from safe_envs.scripts.figures.style import UNSAFE

SHADED: dict[str, Any] = {"color": UNSAFE, "alpha": 0.35, "linewidth": 0, "zorder": 0}
"""Style of unsafe areas."""


def draw_interval(
    axes: Axes, x: Any, ends: Any, color: str, alpha: float, dashes: str = "-", **line: Any
) -> None:
    """Draw a curve with its band: lower ends, values and upper ends, shape (3, K), over x (K,)."""
    low, middle, high = ends
    axes.fill_between(x, low, high, color=color, alpha=alpha, linewidth=0)
    axes.plot(x, middle, dashes, color=color, **line)
