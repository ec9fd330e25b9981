"""The chart of the smallest barrier over time."""

from __future__ import annotations

import math

import numpy as np

from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.axes import Axes, Range
from safe_envs.rendering.canvas import Box, Canvas
from safe_envs.rendering.curves import runs, thinned_minima
from safe_envs.rendering.snapshot import EpisodeSnapshot
from safe_envs.rendering.style import (
    EDGE,
    GREEN,
    GREY,
    INK,
    PANEL,
    PAPER,
    SMALL,
    UNSAFE,
    VIOLATION,
    mix,
    number,
    pretty,
)

_FIRST_STEPS = 100


class BarrierChart:
    """Draws the smallest barrier since the start of an episode.

    Args:
        problem: whose barriers are shown.
        box: of the curve; times are below it.
        heading: height at which the values are written, above the curve.
    """

    def __init__(self, problem: SafetyProblem, box: Box, heading: float) -> None:
        self._problem, self._box, self._heading = problem, box, heading

    def draw(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        """Draw the curve, its values and its axes.

        Args:
            canvas: to draw on.
            snapshot: of the episode.
        """
        times, h = thinned_minima(snapshot.times, snapshot.h)
        known = h[np.isfinite(h)]
        low, high = min(known.min(initial=0.0), 0.0), max(known.max(initial=0.0), 0.0)
        room = 0.12 * max(high - low, 1e-9)
        h = np.maximum(h, low - room)  # what has no value is at the lower end
        axes = Axes(self._box, self._period(float(times[-1])), (low - room, high + room))
        self._draw_curve(canvas, axes, times, h)
        left, top, width, height = self._box
        edge = axes.place(0.0, 0.0)[1]
        canvas.text("0", (left - 6, edge), GREY, SMALL, align=(1.0, 0.5))
        far = high if high >= -low else low
        canvas.text(number(far), (left - 6, axes.place(0.0, far)[1]), GREY, SMALL, align=(1.0, 0.5))
        below = top + height + 4
        for time, side in zip(axes.x, (0.0, 1.0), strict=True):
            at = (left + side * width, below)
            canvas.text(f"{time:.3g} s", at, GREY, SMALL - 1, align=(side, 0.0))
        self._write_values(canvas, snapshot)
        if len(snapshot.barriers) > 1:
            name = pretty(self._problem.barriers[int(np.argmin(snapshot.barriers))].name)
            middle, room = (left + width / 2, below), width - 120
            canvas.text(f"smallest: {name}", middle, GREY, SMALL - 1, align=(0.5, 0.0), widest=room)

    def _draw_curve(self, canvas: Canvas, axes: Axes, times: np.ndarray, h: np.ndarray) -> None:
        left, top, width, height = self._box
        edge = axes.place(0.0, 0.0)[1]
        canvas.fill((left, top, width, edge - top), mix(GREEN, PAPER, 0.10))
        canvas.fill((left, edge, width, top + height - edge), UNSAFE)
        canvas.line((left, edge), (left + width, edge), EDGE, 2)
        places = axes.places(times, h)
        with canvas.within(self._box):
            canvas.path(places, INK, 2)
            for run in runs(h < 0.0):
                canvas.path(places[run], VIOLATION, 3)
            canvas.disk(places[-1], 4, VIOLATION if h[-1] < 0.0 else INK)
        canvas.frame((left - 1, top - 1, width + 2, height + 2), mix(GREY, PANEL, 0.6))

    def _write_values(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        right, y = self._box[0] + self._box[2], self._heading
        width = canvas.text(
            f"least {number(snapshot.least)}", (right, y), GREY, SMALL, align=(1.0, 0.0)
        )
        now = f"now {number(float(snapshot.h[-1]))}"
        canvas.text(now, (right - width - 14, y), INK, SMALL, bold=True, align=(1.0, 0.0))

    def _period(self, now: float) -> Range:
        """Return the times that the chart shows: the horizon, or the latest part of that length.

        Without a horizon all is shown, for 100, 200, 400, ... control periods.
        """
        if self._problem.steps == 1:
            first = _FIRST_STEPS * self._problem.dt
            return 0.0, first * 2.0 ** max(0, math.ceil(math.log2(max(now, first) / first)))
        end = max(self._problem.horizon, now)
        return end - self._problem.horizon, end
