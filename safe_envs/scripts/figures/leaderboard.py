"""The picture of an env of the leaderboard: return against chance of a violation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from safe_envs.agents.training.leaderboard import LeaderboardEntry
from safe_envs.agents.training.study import StudyRow
from safe_envs.scripts.figures.style import (
    COLORS,
    STYLE,
    WARM,
    add_legend,
    save,
)
from safe_envs.scripts.options.evaluation_options import WIDTHS

_LOOKS = (
    ("#000000", "X"),
    (WARM, "o"),
    (COLORS[2], "D"),
    (COLORS[0], "s"),
    (COLORS[1], "^"),
    (COLORS[3], "P"),
    (COLORS[4], "v"),
)
"""Colours and markers in the order of the variants; none depends on its colour alone."""

_LEAST = 1e-4
_MARGIN = 0.06
"""Of the range of the returns, below and above it."""


def draw(
    title: str,
    entries: Sequence[LeaderboardEntry],
    rows: Sequence[StudyRow],
    frontier: Mapping[str, list[float]] | None,
    variants: Sequence[str],
    path: Path,
) -> None:
    """Draw the agents of an env, and write the picture whole or not at all.

    Args:
        title: name of the env.
        entries: its variants.
        rows: all agents of them.
        frontier: "violations" and "returns" of the curve; None where there is none.
        variants: of the leaderboard: a variant looks alike on all envs.
        path: of the picture; its suffix is the format.
    """
    with mpl.rc_context(STYLE):
        # One column, which is about as wide as a phone: letters keep their size there.
        figure = Figure(figsize=(WIDTHS["single"], 3.3))
        axes = figure.add_subplot()
        low, high = _range_of_returns(entries, rows, frontier)
        if frontier is not None:
            axes.plot(
                frontier["violations"],
                np.clip(frontier["returns"], low, None),
                color="#000000",
                linewidth=1.2,
                label="largest return, computed",
                zorder=1,
            )
        for entry in entries:
            color, marker = _LOOKS[variants.index(entry.variant) % len(_LOOKS)]
            of_variant = [row for row in rows if row.variant == entry.variant]
            axes.plot(
                [1.0 - row.safety_rate for row in of_variant],
                [row.return_mean for row in of_variant],
                marker,
                color=color,
                markersize=2.8,
                alpha=0.45,
                markeredgewidth=0,
                zorder=2,
            )
            _draw_entry(axes, entry, color, marker)
        _scale(axes, entries, rows, frontier)
        axes.set_ylim(low, high)
        axes.set(xlabel="episodes with a violation", ylabel="mean return", title=title)
        axes.grid(alpha=0.25, linewidth=0.6)
        add_legend(figure, axes.get_legend_handles_labels()[0], most=2)
        save(figure, path)


def _draw_entry(axes: Axes, entry: LeaderboardEntry, color: str, marker: str) -> None:
    safety, returns = entry.safety, entry.returns
    axes.errorbar(
        1.0 - safety.value,
        returns.value,
        xerr=[[safety.high - safety.value], [safety.value - safety.low]],
        yerr=[[returns.value - returns.low], [returns.high - returns.value]],
        color=color,
        marker=marker,
        markersize=6,
        markerfacecolor="none",  # what lies below is seen
        markeredgewidth=1.1,
        elinewidth=0.9,
        linestyle="none",
        label=entry.variant,
        zorder=3,
    )


def _range_of_returns(
    entries: Sequence[LeaderboardEntry],
    rows: Sequence[StudyRow],
    frontier: Mapping[str, list[float]] | None,
) -> tuple[float, float]:
    """Return the range of the axis of returns: what agents have, and the curve above them."""
    names = {entry.variant for entry in entries}
    found = [row.return_mean for row in rows if row.variant in names]
    top = max([*found, *(frontier["returns"] if frontier is not None else ())])
    margin = _MARGIN * (top - min(found)) or 1.0
    return min(found) - margin, top + margin


def _scale(
    axes: Axes,
    entries: Sequence[LeaderboardEntry],
    rows: Sequence[StudyRow],
    frontier: Mapping[str, list[float]] | None,
) -> None:
    """Show chances of all sizes, and 0."""
    names = {entry.variant for entry in entries}
    found = [1.0 - row.safety_rate for row in rows if row.variant in names]
    found += list(frontier["violations"][:1]) if frontier is not None else []
    least = min((chance for chance in found if chance > _LEAST), default=0.1)
    threshold = 10.0 ** min(math.floor(math.log10(least)), -1)
    axes.set_xscale("symlog", linthresh=threshold)
    axes.set_xlim(-0.15 * threshold, 1.6)
    exponents = range(round(math.log10(threshold)), 1)
    axes.set_xticks([0.0, *(10.0**k for k in exponents)])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100.0 * value:g} %"))
    axes.xaxis.set_minor_locator(NullLocator())
