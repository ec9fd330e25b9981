"""Panels of a decision log: each input, the barriers, and the slacks over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from safe_envs.errors import shortened
from safe_envs.scripts.figures.style import COLORS, QUIET, UNSAFE, WARM
from safe_envs.wrappers.decision_log import DecisionLog

_DASHES = ("solid", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (6, 1.5, 1.5, 1.5)))
_LONG = 15
"""Characters that the label of a panel has no room for."""

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
    """Colours of the lines; those of the barriers take turns.

    Attributes:
        nominal: of proposed inputs.
        executed: of executed inputs.
        barriers: of h and slacks.
    """

    nominal: str = WARM
    executed: str = COLORS[0]
    barriers: tuple[str, ...] = (COLORS[1], COLORS[2], COLORS[3], COLORS[5])

    def barrier(self, i: int) -> dict[str, Any]:
        """Return colour and dashes of a barrier; both differ, for print in grey."""
        turn, place = divmod(i, len(self.barriers))
        return {"color": self.barriers[place], "linestyle": _DASHES[(place + turn) % len(_DASHES)]}


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
        t = self._t = log.t
        # The last period is taken to be as long as usual.
        last = t[-1] + (np.median(np.diff(t)) if len(t) > 1 else 1.0)
        self._ends = np.append(t[1:], last)
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
        panels[-1].set_xlabel("time (s)")

    def handles(self) -> list[Any]:
        """Return entries of a legend: the inputs, and what is marked."""
        found: list[Any] = [
            Line2D([], [], color=self._colors.nominal, **_PROPOSED, label="nominal input"),
            Line2D([], [], color=self._colors.executed, linewidth=1.6, label="executed input"),
            Line2D([], [], **_BOUNDS, label="input bounds"),
            Patch(**_INTERVENTION, label="intervention"),
        ]
        if not self._log.feasible.all():
            found.append(Patch(**_INFEASIBLE, label="infeasible"))
        return found

    def barrier_handles(self) -> list[Any]:
        """Return entries of a legend for the barriers, with the smallest value of each."""
        h, names = self._log.section("h"), self._log.columns.barriers
        return [
            Line2D(
                [],
                [],
                **self._colors.barrier(i),
                linewidth=1.6,
                label=f"{name if name.startswith('h') else f'h {name}'}, min {low:.3g}",
            )
            for i, (name, low) in enumerate(zip(map(plain, names), h.min(axis=0), strict=True))
        ]

    def _draw_input(self, panel: Axes, j: int) -> None:
        nominal, action, low, high = (
            self._log.section(name)[:, j] for name in ("nominal", "action", "low", "high")
        )
        steps: Any = {"drawstyle": "steps-post"}
        panel.plot(self._t, nominal, color=self._colors.nominal, **_PROPOSED, **steps)
        panel.plot(self._t, action, color=self._colors.executed, linewidth=1.6, **steps)
        for bound in (low, high):
            panel.plot(self._t, bound, **_BOUNDS, **steps)
        smallest, largest = min(nominal.min(), action.min()), max(nominal.max(), action.max())
        span = (high - low).max()
        width = largest - smallest or (span if np.isfinite(span) else 1.0)
        # Bounds far away would squeeze the inputs into a line.
        bottom = min([smallest, *low[low > smallest - width]])
        top = max([largest, *high[high < largest + width]])
        room = 0.08 * (top - bottom or width)
        panel.set(ylim=(bottom - room, top + room), ylabel=self._label(j))

    def _draw_barriers(self, panel: Axes) -> None:
        h = self._log.section("h")
        for i in range(h.shape[1]):
            panel.plot(self._t, h[:, i], **self._colors.barrier(i), linewidth=1.6)
        smallest = min(h.min(), 0.0)
        # The smallest h is always seen; others, of another scale perhaps, leave the panel.
        top = max(h.min(axis=1).max(), 0.0)
        room = 0.06 * max(top - smallest, 1e-12)
        bottom = smallest - 2.0 * room
        # Whoever compares panels may move their lower end.
        panel.axhspan(
            bottom - 1e3 * (top - bottom), 0.0, color=UNSAFE, alpha=0.5, linewidth=0, zorder=0
        )
        panel.axhline(0.0, color="black", linewidth=1.0)
        units = {self._unit(name) for name in self._log.columns.barriers}
        unit = units.pop() if len(units) == 1 else ""
        panel.set(ylim=(bottom, top + room), ylabel=f"h{unit}")

    def _draw_slacks(self, panel: Axes) -> None:
        slack = self._log.section("slack")
        for i in range(slack.shape[1]):
            panel.plot(self._t, slack[:, i], **self._colors.barrier(i), drawstyle="steps-post")
        panel.set(ylim=(0.0, 1.08 * slack.max() or 1.0), ylabel="slack")

    def _mark(self, panel: Axes) -> None:
        """Shade the periods with interventions, and hatch the infeasible ones."""
        infeasible = ~self._log.feasible
        intervened = self._log.intervention & ~infeasible
        for flags, style in ((intervened, _INTERVENTION), (infeasible, _INFEASIBLE)):
            spans = [(self._t[i], self._ends[k - 1]) for i, k in _runs(flags)]
            corners = [[(a, 0.0), (b, 0.0), (b, 1.0), (a, 1.0)] for a, b in spans]
            marks = PolyCollection(
                corners, transform=panel.get_xaxis_transform(), zorder=0, **style
            )
            panel.add_collection(marks, autolim=False)

    def _label(self, j: int) -> str:
        name = self._log.columns.inputs[j]
        label = plain(name) + self._unit(name)
        return label if len(label) < _LONG else label.replace(" (", "\n(", 1)

    def _unit(self, name: str) -> str:
        unit = self._log.columns.units.get(name, "").replace("^2", "²").replace("^3", "³")
        return f" ({plain(unit)})" if unit else ""


def plain(text: str, most: int = 40) -> str:
    """Return a text without what would be read as mathematics; it may come from a file.

    Args:
        text: a name, say.
        most: characters, about.
    """
    return shortened(text, most).replace("$", r"\$")


def _runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and the one after the last place of each run of True."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return list(zip(ends[::2].tolist(), ends[1::2].tolist(), strict=True))
