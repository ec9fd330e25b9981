"""The picture of an env of the leaderboard: return against chance of a violation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from safe_envs.agents.training.leaderboard import LeaderboardEntry
from safe_envs.agents.training.study import StudyRow
from safe_envs.scripts.figures.style import (
    COLORS,
    STYLE,
    WARM,
    add_legend,
    save,
    scale_violations,
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


def draw(
    title: str,
    entries: Sequence[LeaderboardEntry],
    rows: Sequence[StudyRow],
    variants: Sequence[str],
    path: Path,
) -> None:
    """Draw the agents of an env, and write the picture whole or not at all.

    Args:
        title: name of the env.
        entries: its variants.
        rows: all agents of them.
        variants: of the leaderboard: a variant looks alike on all envs.
        path: of the picture; its suffix is the format.
    """
    with mpl.rc_context(STYLE):
        # One column, which is about as wide as a phone: letters keep their size there.
        figure = Figure(figsize=(WIDTHS["single"], 3.3))
        axes = figure.add_subplot()
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
        scale_violations(axes, [1.0 - row.safety_rate for row in rows])
        axes.margins(y=0.06)
        axes.set(ylabel="mean return", title=title)
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
