"""The picture of the best attainable safety: the lower envelope over its coordinates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter

from safe_envs.agents.evaluation.attainable import AttainableSafety
from safe_envs.agents.evaluation.table import best_text, describe_system
from safe_envs.agents.policies.best import BestPolicy
from safe_envs.scripts.figures.style import (
    COLORS,
    QUIET,
    STYLE,
    UNSAFE,
    WARM,
    StyledFigure,
    add_legend,
    add_title,
    expression,
    finished,
    labelled,
    mathematics,
    plain,
    runs,
    wrapped,
)
from safe_envs.scripts.options.evaluation_options import DEFAULT_SIZE, width_of

LEVEL = 0.99
"""Of the set that is marked."""

_LEVELS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 0.999, 1.0)
_SHADES = ("#F1F5F9", "#DCE8F2", "#BDD6E8", "#93BEDB", "#5E9FCB", "#2F7FB8", "#0072B2")


def plot_attainable(
    found: AttainableSafety,
    policy: BestPolicy,
    out: Path | str | None = None,
    *,
    title: str | None = None,
    size: str = DEFAULT_SIZE,
) -> StyledFigure:
    """Draw the best attainable safety over the starts.

    One coordinate gives a curve and two a plane. With more the plane of the first two is drawn,
    with each other coordinate in the middle of its range.

    Args:
        found: to draw, of `attainable_safety`.
        policy: of the same, with the table.
        out: file of the picture; its suffix is the format: .png, .pdf or .svg.
        title: name of the env; by default that of the problem.
        size: "single" or "double", in columns of a paper.

    Returns:
        The figure, which a notebook shows.

    Raises:
        ConfigurationError: The file cannot be written, or there is no such size.
    """
    width = width_of(size)
    problem, table = policy.problem, policy.table
    shape, axes = table.grid.shape, table.grid.axes
    middle = tuple(count // 2 for count in shape[2:])
    lower, upper = (
        np.asarray(rows[0], dtype=float).reshape(shape)[(..., *middle)]
        if middle
        else np.asarray(rows[0], dtype=float).reshape(shape)
        for rows in (table.lower, table.upper)
    )
    units = {state.symbol.name: state.unit for state in problem.states}
    names = [expression(coordinate, units) for coordinate in found.coordinates]
    with mpl.rc_context(STYLE):
        figure = StyledFigure(figsize=(width, 3.9 if size == "double" else 3.7))
        panel = figure.subplots()
        if len(shape) == 1:
            handles = _draw_curve(panel, axes[0].edges, lower, upper)
            panel.set(xlabel=names[0], ylabel=labelled("best attainable safety", "%"))
        else:
            edges = (axes[0].edges, axes[1].edges)
            handles = _draw_plane(figure, panel, edges, lower, upper)
            panel.set(xlabel=names[0], ylabel=names[1])
        unitless = dict.fromkeys(units, "")
        held = [
            f"{expression(name, unitless)} = {0.5 * (axis.edges[i] + axis.edges[i + 1]):.3g}"
            for name, axis, i in zip(found.coordinates[2:], axes[2:], middle, strict=True)
        ]
        heading = "Best attainable safety from each start"
        heading += f"; {', '.join(held)}" * bool(held)
        panel.set_title(wrapped(figure, heading, mpl.rcParams["axes.titlesize"], 0.75 * width))
        add_legend(figure, handles)
        said = f"from the starts {best_text(found)}" if found.lower is not None else "withheld"
        heading = plain(f"{title or problem.name}: {said}", 200)
        add_title(figure, f"{heading}\n{mathematics(describe_system(problem))}")
    return finished(figure, out)


def _draw_curve(panel: Axes, edges: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> list[Any]:
    """Draw both envelopes over the only coordinate, and the set where the lower one is high."""
    panel.stairs(upper, edges, baseline=lower, fill=True, color=COLORS[0], alpha=0.25)
    panel.stairs(lower, edges, baseline=None, color=COLORS[0], linewidth=1.2)
    panel.stairs(upper, edges, baseline=None, color=COLORS[0], linewidth=0.8, linestyle="--")
    for start, end in runs(lower >= LEVEL):
        panel.axvspan(edges[start], edges[end], color=WARM, alpha=0.15, linewidth=0)
    panel.axhline(LEVEL, color=QUIET, linewidth=0.6, linestyle=":")
    panel.set_ylim(-0.02, 1.02)
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g}"))
    return [
        Line2D([], [], color=COLORS[0], linewidth=1.2, label="lower"),
        Line2D([], [], color=COLORS[0], linewidth=0.8, linestyle="--", label="upper"),
        Patch(color=WARM, alpha=0.15, label=f"{100 * LEVEL:g} % can be had (lower)"),
    ]


def _draw_plane(
    figure: Figure,
    panel: Axes,
    edges: tuple[np.ndarray, np.ndarray],
    lower: np.ndarray,
    upper: np.ndarray,
) -> list[Any]:
    """Draw the lower envelope over a plane with level lines, and the set where it is high."""
    colors = ListedColormap(list(_SHADES))
    norm = BoundaryNorm(_LEVELS, colors.N)
    shown = np.ma.masked_where(upper <= 0.0, lower).T
    image = panel.pcolormesh(*edges, shown, cmap=colors, norm=norm, rasterized=True)
    panel.set_facecolor(UNSAFE)
    bar = figure.colorbar(image, ax=panel, shrink=0.9, ticks=_LEVELS, spacing="uniform")
    bar.ax.set_yticklabels([f"{100 * level:g} %" for level in _LEVELS])
    middles = [0.5 * (each[1:] + each[:-1]) for each in edges]
    for values, style, width in ((lower, "solid", 1.3), (upper, "dashed", 1.0)):
        if values.min() < LEVEL <= values.max() and min(values.shape) > 1:
            panel.contour(
                *middles, values.T, levels=[LEVEL], colors=WARM, linewidths=width, linestyles=style
            )
    quiet = [level for level in _LEVELS[1:-1] if lower.min() < level < lower.max()]
    if quiet and min(lower.shape) > 1:
        panel.contour(*middles, lower.T, levels=quiet, colors=QUIET, linewidths=0.4)
    return [
        Line2D([], [], color=WARM, linewidth=1.3, label=f"{100 * LEVEL:g} % can be had (lower)"),
        Line2D([], [], color=WARM, linewidth=1.0, linestyle="--", label="at most there (upper)"),
        Patch(color=UNSAFE, label="0 %"),
    ]
