"""The picture of a frontier: what a filter costs."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullLocator

from safe_envs.agents.evaluation.frontier import Frontier, FrontierPoint
from safe_envs.agents.evaluation.statistics import percent
from safe_envs.agents.evaluation.table import describe_system
from safe_envs.scripts.figures.style import (
    COLORS,
    QUIET,
    STYLE,
    WARM,
    StyledFigure,
    add_legend,
    add_title,
    finished,
    mark_of,
    mathematics,
    plain,
)
from safe_envs.scripts.options.evaluation_options import DEFAULT_SIZE, width_of

_POLICIES, _FILTERS, _BEST = ("o", "v", "<", ">"), ("s", "D", "^", "P", "p", "h"), "*"
"""Marks by the kind of a point: none depends on its colour alone."""


def plot_frontier(
    found: Frontier,
    out: Path | str | None = None,
    *,
    title: str | None = None,
    size: str = DEFAULT_SIZE,
) -> StyledFigure:
    """Draw what safety costs: the largest return over the chance of a violation, and the points.

    Args:
        found: the curve and the points.
        out: file of the picture; its suffix is the format: .png, .pdf or .svg.
        title: name of the env; by default that of the problem.
        size: "single" or "double", in columns of a paper.

    Returns:
        The figure, which a notebook shows.

    Raises:
        ConfigurationError: The file cannot be written, or there is no such size.
    """
    return finished(figure_of(found, title or found.problem.name, size), out)


def figure_of(found: Frontier, title: str, size: str = DEFAULT_SIZE) -> StyledFigure:
    """Return the figure of the curve and the points.

    Args:
        found: the curve and the points.
        title: of the env.
        size: as for `plot_frontier`.

    Raises:
        ConfigurationError: there is no such size.
    """
    with mpl.rc_context(STYLE):
        figure = StyledFigure(figsize=(width_of(size), 4.0 if size == "double" else 3.4))
        axes = figure.add_subplot()
        _draw_curve(axes, found)
        others, drawn = 0, dict[str, int]()
        for point in found.points:
            nominal = point.name == "nominal"
            color = WARM if nominal else COLORS[others % len(COLORS)]
            others += not nominal
            marks = {"filter": _FILTERS, "best": _BEST}.get(point.kind, _POLICIES)
            turn = drawn[point.kind] = drawn.get(point.kind, -1) + 1
            _draw_point(axes, point, color, mark_of(turn, marks), point.name)
        for i, point in enumerate(found.attained):
            label = None if i else "policies of the curve, simulated"
            _draw_point(axes, point, QUIET, ".", label)
        _scale(axes, found)
        axes.set(xlabel="episodes with a violation", ylabel="mean return")
        axes.grid(alpha=0.25, linewidth=0.6)
        add_legend(figure, axes.get_legend_handles_labels()[0])
        described = mathematics(describe_system(found.problem))
        add_title(figure, f"{plain(title, 200)}: what safety costs\n{described}")
    return figure


def _draw_curve(axes: Axes, found: Frontier) -> None:
    lows = [p.return_low for p in (*found.points, *found.attained)]
    bottom = min([*lows, found.curve()[1].min()])
    chances, returns = found.curve(bottom=bottom)
    axes.plot(chances, returns, color="black", linewidth=1.3, label="largest return, computed")
    axes.fill_between(chances, bottom, returns, color="#56B4E9", alpha=0.08, linewidth=0)


def _draw_point(
    axes: Axes, point: FrontierPoint, color: str, marker: str, label: str | None
) -> None:
    axes.errorbar(
        point.violation_rate,
        point.return_mean,
        xerr=[
            [max(point.violation_rate - point.violation_low, 0.0)],
            [max(point.violation_high - point.violation_rate, 0.0)],
        ],
        yerr=[
            [point.return_mean - point.return_low],
            [point.return_high - point.return_mean],
        ],
        color=color,
        marker=marker,
        markersize=8 if marker == _BEST else 4.5,
        elinewidth=0.8,
        linestyle="none",
        label=label,
    )


def _scale(axes: Axes, found: Frontier) -> None:
    """Show chances of all sizes, and 0."""
    points = (*found.points, *found.attained)
    small = [p.violation_high for p in points] + [max(found.values.least_violations, 1e-6)]
    threshold = max(min(small), 1e-6)
    axes.set_xscale("symlog", linthresh=threshold)
    axes.set_xlim(-0.1 * threshold, 1.1)
    ticks = [10.0**k for k in range(-6, 1) if 10.0**k >= threshold]
    axes.set_xticks([0.0, *ticks])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: percent(value)))
    axes.xaxis.set_minor_locator(NullLocator())
