"""The picture of a frontier: what a filter costs."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from safe_envs.agents.evaluation.frontier_results import Frontier, FrontierPoint
from safe_envs.agents.evaluation.rate_text import percent
from safe_envs.scripts.figures.labels import mathematics, plain
from safe_envs.scripts.figures.saving import save
from safe_envs.scripts.figures.style import (
    COLORS,
    QUIET,
    STYLE,
    WARM,
    add_legend,
    add_title,
)
from safe_envs.scripts.options.figure_options import DEFAULT_SIZE, width_of
from safe_envs.scripts.reports.evaluation_report import describe_system

_POLICIES, _FILTERS, _BEST = ("o", "v", "<", ">"), ("s", "D", "^", "P", "p", "h"), "*"
"""Marks by the kind of a point: none depends on its colour alone."""


def draw(found: Frontier, title: str, path: Path, size: str = DEFAULT_SIZE) -> None:
    """Draw the curve and the points, and write the picture whole or not at all.

    Args:
        found: the curve and the points.
        title: of the env.
        path: of the picture; its suffix is the format.
        size: "single" or "double", in columns of a paper.
    """
    with mpl.rc_context(STYLE):
        save(figure_of(found, title, size), path)


def figure_of(found: Frontier, title: str, size: str = DEFAULT_SIZE) -> Figure:
    """Return the figure of the curve and the points.

    Args:
        found: the curve and the points.
        title: of the env.
        size: as for `draw`.

    Raises:
        ConfigurationError: there is no such size.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width_of(size), 4.0 if size == "double" else 3.4))
        axes = figure.add_subplot()
        _draw_curve(axes, found)
        others, drawn = 0, dict[str, int]()
        for point in found.points:
            nominal = point.name == "nominal"
            color = WARM if nominal else COLORS[others % len(COLORS)]
            others += not nominal
            marks = {"filter": _FILTERS, "best": _BEST}.get(point.kind, _POLICIES)
            turn = drawn[point.kind] = drawn.get(point.kind, -1) + 1
            _draw_point(axes, point, color, marks[turn % len(marks)], point.name)
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
