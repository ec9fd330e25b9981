"""The picture of a decision log: inputs, barriers and slacks over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from safe_envs.errors import ConfigurationError
from safe_envs.filters.decision_log import DecisionLog
from safe_envs.scripts.figures.style import (
    COLORS,
    DASHES,
    QUIET,
    SMALL,
    STYLE,
    UNSAFE,
    WARM,
    StyledFigure,
    add_legend,
    add_title,
    finished,
    labelled,
    plain,
    quantity,
    runs,
    symbol,
)
from safe_envs.scripts.options.evaluation_options import DEFAULT_SIZE, width_of

_DASHES = DASHES[:4]
_WIDTHS = (1.3, 0.7)
_LONG = 9
"""Characters that the label of a panel has no room for."""

_MOST = 1e100
"""Larger numbers are drawn as this one: Matplotlib computes with their squares."""

_PROPOSED: dict[str, Any] = {"linewidth": 1.0, "linestyle": (0, (4, 1))}
_BOUNDS: dict[str, Any] = {"color": QUIET, "linewidth": 0.9, "linestyle": ":"}
_INTERVENTION: dict[str, Any] = {"facecolor": "#56B4E9", "alpha": 0.25, "linewidth": 0}
_INFEASIBLE: dict[str, Any] = {
    "facecolor": "#F0E442",
    "edgecolor": "#8C7A00",
    "alpha": 0.7,
    "linewidth": 0,
    "hatch": "////",
}


@dataclass(frozen=True)
class LogColors:
    """Colours of the lines; those of the barriers take turns, and then dashes and widths.

    Attributes:
        nominal: of proposed inputs.
        executed: of executed inputs.
        barriers: of h and slacks.
    """

    nominal: str = WARM
    executed: str = COLORS[0]
    barriers: tuple[str, ...] = (COLORS[1], COLORS[2], COLORS[3], COLORS[5])

    @property
    def distinct(self) -> int:
        """Number of barriers whose lines all differ."""
        return len(self.barriers) * len(_DASHES) * len(_WIDTHS)

    def barrier(self, i: int) -> dict[str, Any]:
        """Return colour, dashes and width of a barrier; the first few differ in print, too."""
        turn, place = divmod(i, len(self.barriers))
        width = _WIDTHS[turn // len(_DASHES) % len(_WIDTHS)]
        return {
            "color": self.barriers[place],
            "linestyle": _DASHES[(place + turn) % len(_DASHES)],
            "linewidth": width,
        }

    def legend(self, labels: Mapping[int, str]) -> list[Any]:
        """Return entries of a legend for barriers.

        Args:
            labels: by index.
        """
        found = [Line2D([], [], **self.barrier(i), label=text) for i, text in labels.items()]
        if any(i >= self.distinct for i in labels):
            found.append(note(f"lines repeat after {self.distinct}"))
        return found


class LogPanels:
    """Draws a log that is not empty.

    Args:
        log: to draw.
        colors: of the lines.

    Attributes:
        slack: whether some slack is not 0, so that there is a panel for slacks.
        barrier_panel: index of the panel of h, after those of the inputs.
        count: number of panels.
    """

    def __init__(self, log: DecisionLog, colors: LogColors | None = None) -> None:
        self._log, self._colors = log, colors or LogColors()
        t = self._t = np.clip(log.t, -_MOST, _MOST)
        # The last period is taken to be as long as usual.
        usual = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
        self._ends = np.append(t[1:], t[-1] + max(usual or 1.0, 1e-9 * abs(t[-1])))
        self._h = self._numbers("h")
        self.slack = bool(log.section("slack").any())
        self.barrier_panel = len(log.columns.inputs)
        self.count = self.barrier_panel + 1 + self.slack

    def draw(self, panels: Sequence[Axes]) -> None:
        """Draw inputs, h, and slacks where there is a panel for them.

        Args:
            panels: one above the other.
        """
        for panel in panels:
            self._mark(panel)
            panel.set_xlim(self._t[0], self._ends[-1])
        for j, panel in enumerate(panels[: self.barrier_panel]):
            self._draw_input(panel, j)
        self._draw_barriers(panels[self.barrier_panel])
        for panel in panels[self.barrier_panel + 1 :]:
            self._draw_slacks(panel)
        panels[-1].set_xlabel(labelled("time", "s"))

    def handles(self, panels: Sequence[Axes]) -> list[Any]:
        """Return entries of a legend: the inputs, and what is marked, as far as it can be seen.

        Args:
            panels: that were drawn, with their limits.
        """
        log, colors = self._log, self._colors
        found: list[Any] = [
            Line2D([], [], color=colors.executed, linewidth=1.3, label="executed input")
        ]
        if (log.section("nominal") != log.section("action")).any():
            found.insert(
                0, Line2D([], [], color=colors.nominal, **_PROPOSED, label="nominal input")
            )
        limits = np.array([panel.get_ylim() for panel in panels[: self.barrier_panel]])
        bounds = np.stack([log.section("low"), log.section("high")])
        if ((bounds >= limits[:, 0]) & (bounds <= limits[:, 1])).any():
            found.append(Line2D([], [], **_BOUNDS, label="input bounds"))
        if (log.intervention & log.feasible).any():
            found.append(Patch(**_INTERVENTION, label="intervention"))
        if not log.feasible.all():
            found.append(Patch(**_INFEASIBLE, label="infeasible"))
        return found

    def seen(self, panels: Sequence[Axes]) -> list[int]:
        """Return the barriers of which something can be seen.

        Args:
            panels: that were drawn, with their limits.
        """
        low, high = panels[self.barrier_panel].get_ylim()
        found = ((self._h >= low) & (self._h <= high)).any(axis=0)
        slacks = self._log.section("slack").any(axis=0)
        return np.flatnonzero(found | slacks).tolist()

    def barrier_handles(self, panels: Sequence[Axes]) -> list[Any]:
        """Return entries of a legend for the barriers, with the smallest value of each.

        Args:
            panels: that were drawn, with their limits.
        """
        names, seen = self._log.columns.barriers, self.seen(panels)
        lowest = self._log.section("h").min(axis=0)
        labels = {i: f"{_barrier_text(names[i])}, min {lowest[i]:.3g}" for i in seen}
        found = self._colors.legend(labels)
        if len(seen) < len(names):
            found.append(note(f"outside the panel: {len(names) - len(seen)} more"))
        return found

    def note_cuts(self, panels: Sequence[Axes]) -> None:
        """Say in the panel of h where it is cut off, if anything lies beyond.

        Args:
            panels: that were drawn, with their limits.
        """
        panel = panels[self.barrier_panel]
        low, high = panel.get_ylim()
        cuts = [
            f"{end:.2g}" for end, cut in ((low, self._h < low), (high, self._h > high)) if cut.any()
        ]
        if cuts:
            text = f"$h$ cut off at {' and '.join(cuts)}"
            panel.set_title(text, loc="right", fontsize=SMALL, color=QUIET, pad=2)

    def _numbers(self, section: str) -> np.ndarray:
        """Return the columns of a section, without what cannot be drawn."""
        values = self._log.section(section)
        return np.where(np.isfinite(values), np.clip(values, -_MOST, _MOST), np.nan)

    def _draw_input(self, panel: Axes, j: int) -> None:
        nominal, action, low, high = (
            self._numbers(name)[:, j] for name in ("nominal", "action", "low", "high")
        )
        steps: Any = {"drawstyle": "steps-post"}
        panel.plot(self._t, nominal, color=self._colors.nominal, **_PROPOSED, **steps)
        panel.plot(self._t, action, color=self._colors.executed, linewidth=1.3, **steps)
        for bound in (low, high):
            panel.plot(self._t, bound, **_BOUNDS, **steps)
        smallest, largest = _range(nominal, action)
        down, up = _range(high - low)
        width = largest - smallest or max(-down, up) or 1.0
        # Bounds far away would squeeze the inputs into a line.
        bottom = min([smallest, *low[low > smallest - width]])
        top = max([largest, *high[high < largest + width]])
        room = _room(0.08 * (top - bottom or width), bottom, top)
        panel.set(ylim=(bottom - room, top + room), ylabel=self._label(j))

    def _draw_barriers(self, panel: Axes) -> None:
        for i, values in enumerate(self._h.T):
            panel.plot(self._t, values, **self._colors.barrier(i))
        bottom, _ = _range(self._h, [0.0])
        # The smallest h is always seen; others, of another scale perhaps, leave the panel.
        _, top = _range(np.fmin.reduce(self._h, axis=1), [0.0])
        room = _room(0.06 * (top - bottom), bottom, top)
        bottom -= 2.0 * room
        # Whoever compares panels may move their lower end.
        panel.axhspan(
            bottom - 1e3 * (top - bottom), 0.0, color=UNSAFE, alpha=0.5, linewidth=0, zorder=0
        )
        panel.axhline(0.0, color="black", linewidth=1.0)
        units = {self._log.columns.units.get(name, "") for name in self._log.columns.barriers}
        unit = units.pop() if len(units) == 1 else ""
        panel.set(ylim=(bottom, top + room), ylabel=quantity("h", unit))

    def _draw_slacks(self, panel: Axes) -> None:
        slack = self._numbers("slack")
        for i, values in enumerate(slack.T):
            panel.plot(self._t, values, **self._colors.barrier(i), drawstyle="steps-post")
        panel.set(ylim=(0.0, 1.08 * _range(slack, [0.0])[1] or 1.0), ylabel="slack")

    def _mark(self, panel: Axes) -> None:
        """Shade the periods with interventions, and hatch the infeasible ones."""
        infeasible = ~self._log.feasible
        intervened = self._log.intervention & ~infeasible
        for flags, style in ((intervened, _INTERVENTION), (infeasible, _INFEASIBLE)):
            spans = [(self._t[i], self._ends[k - 1]) for i, k in runs(flags)]
            corners = [[(a, 0.0), (b, 0.0), (b, 1.0), (a, 1.0)] for a, b in spans]
            marks = PolyCollection(
                corners, transform=panel.get_xaxis_transform(), zorder=0, **style
            )
            panel.add_collection(marks, autolim=False)

    def _label(self, j: int) -> str:
        name = self._log.columns.inputs[j]
        unit = self._log.columns.units.get(name, "")
        label = quantity(name, unit)
        return label.replace(" [", "\n[", 1) if len(f"{name} {unit}") > _LONG else label


def _barrier_text(name: str) -> str:
    """Return h with the name of a barrier, unless that begins with h as h_1 does."""
    return symbol(name) if name.startswith("h") else f"$h$ {plain(name)}"


def note(text: str) -> Any:
    """Return a line of text for a legend.

    Args:
        text: to say.
    """
    return Line2D([], [], linewidth=0, label=text)


def _range(*values: Any) -> tuple[float, float]:
    """Return the smallest and the largest number, without nan; zeros where there is none."""
    found = np.concatenate([np.ravel(each) for each in values])
    found = found[~np.isnan(found)]
    return (float(found.min()), float(found.max())) if found.size else (0.0, 0.0)


def _room(wanted: float, bottom: float, top: float) -> float:
    """Return room below and above a range, as much as floats need at least."""
    return max(wanted, 1e-6 * max(abs(bottom), abs(top)), 1e-12)


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
