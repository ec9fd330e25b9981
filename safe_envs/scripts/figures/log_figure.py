"""The picture of a decision log: inputs, barriers and slacks over time."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib as mpl

from safe_envs.errors import ConfigurationError
from safe_envs.scripts.figures.labels import plain
from safe_envs.scripts.figures.log_panels import LogPanels, note
from safe_envs.scripts.figures.saving import StyledFigure, finished
from safe_envs.scripts.figures.style import (
    STYLE,
    add_legend,
    add_title,
)
from safe_envs.scripts.options.figure_options import DEFAULT_SIZE, width_of
from safe_envs.wrappers.decision_log import DecisionLog

_HEIGHT = 1.0
_LINE = 0.16
"""In inches, of a panel and of a line of the legend."""

_COLUMN = 8


def plot_log(
    log: DecisionLog | Path | str,
    out: Path | str | None = None,
    *,
    start: float | None = None,
    end: float | None = None,
    title: str | None = None,
    size: str = DEFAULT_SIZE,
) -> StyledFigure:
    """Draw the nominal and the executed inputs, h and slacks of a log over time.

    Periods in which a constraint changed the input are shaded, infeasible ones hatched. The
    smallest h is always within its panel; others may leave it at the top, where the panel says so.
    The legend has what can be seen. Slacks have a panel where there are some.

    Args:
        log: the log, or its file as `DecisionLog.read` takes it.
        out: file of the picture; its suffix is the format: .png, .pdf or .svg.
        start: first time to show, in s; by default that of the log.
        end: last time to show, in s; by default that of the log.
        title: of the picture; counts by default.
        size: "single" or "double", in columns of a paper.

    Returns:
        The figure, which a notebook shows.

    Raises:
        ConfigurationError: The file cannot be read or written, or there is nothing to draw.
    """
    whole = log if isinstance(log, DecisionLog) else DecisionLog.read(log)
    log = whole if start is None and end is None else whole.between(start, end)
    if not len(log):
        raise ConfigurationError(
            f"nothing to draw between start = {start} and end = {end}: the log has {len(whole)}"
            f" periods{f' from {whole.t[0]:g} to {whole.t[-1]:g} s' if len(whole) else ''}"
        )
    drawn, width = LogPanels(log), width_of(size)
    with mpl.rc_context(STYLE):
        figure = StyledFigure()
        panels = list(figure.subplots(drawn.count, 1, sharex=True, squeeze=False)[:, 0])
        drawn.draw(panels)
        drawn.note_cuts(panels)
        figure.align_ylabels(panels)
        left, right = drawn.handles(panels), drawn.barrier_handles(panels)
        # A few barriers have a column of their own.
        if len(right) <= _COLUMN:
            left += [note(" ")] * (len(right) - len(left))
        lines = max(len(left), math.ceil((len(left) + len(right)) / 2))
        figure.set_size_inches(width, 0.7 + _HEIGHT * drawn.count + _LINE * lines)
        add_legend(figure, [*left, *right], 2)
        said = str(log).partition("; ")[::2] if title is None else str(title).splitlines()
        add_title(figure, "\n".join([plain(each, 200) for each in said if each]))
    return finished(figure, out)
