"""The panel next to the scene: time, filter, safety, inputs, and the smallest barrier over time."""

from __future__ import annotations

import math

import numpy as np

from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.rendering import style
from safe_envs.rendering.axes import Axes, Range
from safe_envs.rendering.canvas import Box, Canvas, runs, thinned_minima
from safe_envs.rendering.scenes.base import warning_color
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
        """Return the times that the chart shows: the horizon, or the latest part of that length."""
        # Without a horizon all is shown, for 100, 200, 400, ... control periods.
        if self._problem.steps == 1:
            first = _FIRST_STEPS * self._problem.dt
            return 0.0, first * 2.0 ** max(0, math.ceil(math.log2(max(now, first) / first)))
        end = max(self._problem.horizon, now)
        return end - self._problem.horizon, end


_LEFT, _RIGHT = style.SCENE[2] + 20, style.SIZE[0] - 20
_WIDTH = _RIGHT - _LEFT
_BARS = (148, 348)
_MOST_BARS = 5
_BOTTOM = 480
_LEGEND = 512


class Panel:
    """Draws the panel.

    Args:
        problem: whose inputs and barriers are shown.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self._problem = problem
        # Over a third-party env without a limit of time, the problem's horizon is a single control
        # period.
        self._endless = problem.steps == 1
        shown = problem.inputs[:_MOST_BARS]
        top = _BARS[0] + 26
        pitch = min(58.0, (_BARS[1] - top) / len(shown))
        self._tracks = [(variable, top + round(j * pitch)) for j, variable in enumerate(shown)]
        self._ranged = pitch >= 50.0
        below = top + round(len(shown) * pitch) + 10
        box = (_LEFT + 56, below + 28, _WIDTH - 56, _BOTTOM - below - 28)
        self._chart = BarrierChart(problem, box, below + 2)
        self._background = Canvas(style.SIZE)
        canvas = self._background
        canvas.fill((style.SCENE[2], 0, style.SIZE[0] - style.SCENE[2], style.SIZE[1]), style.PANEL)
        canvas.line((style.SCENE[2], 0), (style.SCENE[2], style.SIZE[1]), style.LINE)
        canvas.text(problem.name, (_LEFT, 14), style.INK, style.LARGE, bold=True, widest=_WIDTH)
        more = len(problem.inputs) - len(shown)
        action = "Action" + (f" (and {more} more)" if more else "")
        canvas.text(action, (_LEFT, _BARS[0]), style.INK, style.NORMAL, bold=True)
        for variable, top in self._tracks:
            self._draw_track(variable, top)
        title = "Smallest h" if len(problem.barriers) > 1 else "h"
        canvas.text(title, (_LEFT, below), style.INK, style.NORMAL, bold=True)
        self._draw_legend()

    def draw(self, canvas: Canvas, snapshot: EpisodeSnapshot, caption: str) -> None:
        """Draw the panel, and blank paper for the scene.

        Args:
            canvas: to draw on.
            snapshot: of the episode.
            caption: below the name of the problem; may be empty.
        """
        canvas.lay(self._background)
        if caption:
            canvas.text(caption, (_LEFT, 42), style.GREY, style.NORMAL, widest=_WIDTH)
        time, duration = float(snapshot.times[-1]), self._problem.duration
        canvas.text(f"t = {time:.2f} s", (_LEFT, 68), style.INK, style.NORMAL)
        if not self._endless:
            canvas.text(
                f"of {duration:g} s", (_RIGHT, 68), style.GREY, style.NORMAL, align=(1.0, 0.0)
            )
            canvas.fill((_LEFT, 91, _WIDTH, 3), style.LINE)
            canvas.fill((_LEFT, 91, _WIDTH * min(time / duration, 1.0), 3), style.GREY)
        half = _WIDTH // 2 - 4
        _draw_status(canvas, (_LEFT, 104, half, 28), *_filter_status(snapshot))
        _draw_status(canvas, (_LEFT + half + 8, 104, half, 28), *_safety_status(snapshot))
        self._draw_actions(canvas, snapshot)
        self._chart.draw(canvas, snapshot)

    def _draw_track(self, variable: Variable, top: int) -> None:
        """Draw the empty bar of an input, with its name and its range."""
        canvas = self._background
        canvas.text(
            style.label(variable.symbol.name, variable.unit), (_LEFT, top), style.INK, style.SMALL
        )
        if self._ranged:
            for value, side in ((variable.low, 0.0), (variable.high, 1.0)):
                at = (_LEFT + side * _WIDTH, top + 36)
                canvas.text(style.bound(value), at, style.GREY, style.SMALL - 2, align=(side, 0.0))
        canvas.fill((_LEFT, top + 20, _WIDTH, 12), style.PAPER, 2)
        canvas.frame((_LEFT, top + 20, _WIDTH, 12), style.mix(style.GREY, style.PANEL, 0.6), 1, 2)

    def _draw_actions(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        executed, decision = snapshot.executed, snapshot.decision
        if executed is None:
            return
        color = warning_color(snapshot)
        for j, (variable, top) in enumerate(self._tracks):
            rest, here = _on_track(variable, 0.0), _on_track(variable, executed[j], beyond=True)
            canvas.fill((min(rest, here), top + 21, max(abs(here - rest), 2.0), 10), color)
            canvas.line((rest, top + 17), (rest, top + 34), style.INK)
            canvas.fill((here - 1, top + 18, 3, 16), style.INK)
            right, scale = float(_RIGHT), max(-variable.low, variable.high)
            if decision is not None:
                nominal = decision.nominal[j]
                canvas.diamond((_on_track(variable, nominal), top + 26), 7, None, style.INK)
                text = style.number(nominal, scale)
                right -= (
                    canvas.text(text, (right, top), style.INK, style.SMALL, align=(1.0, 0.0)) + 10
                )
                canvas.diamond((right, top + 8), 4, None, style.INK, 1)
                right -= 16
            text = style.number(executed[j], scale)
            width = canvas.text(
                text, (right, top), style.INK, style.SMALL, bold=True, align=(1.0, 0.0)
            )
            canvas.fill((right - width - 14, top + 3, 9, 9), color)

    def _draw_legend(self) -> None:
        canvas, y = self._background, _LEGEND
        canvas.fill((_LEFT, y + 4, 10, 10), style.EXECUTED)
        x = _LEFT + 16 + canvas.text("executed", (_LEFT + 16, y), style.INK, style.SMALL) + 16
        canvas.diamond((x, y + 8), 5, None, style.INK)
        x += 11 + canvas.text("nominal", (x + 11, y), style.INK, style.SMALL) + 16
        canvas.fill((x, y + 2, 18, 13), style.UNSAFE)
        with canvas.within((x, y + 2, 18, 13)):
            for offset in range(-12, 18, 6):
                canvas.line((x + offset, y + 15), (x + offset + 13, y + 2), style.HATCH, 2)
        canvas.frame((x, y + 2, 18, 13), style.EDGE)
        canvas.text("h < 0", (x + 24, y), style.INK, style.SMALL)


def _filter_status(snapshot: EpisodeSnapshot) -> tuple[str, style.Color, bool]:
    """Return a text, its colour, and whether it is a warning."""
    if snapshot.infeasible:
        return "infeasible", style.INFEASIBLE, True
    if snapshot.intervening:
        return "intervening", style.INTERVENING, True
    if snapshot.decision is not None:
        return "action unchanged", style.GREEN, False
    return "no step yet" if snapshot.executed is None else "no filter", style.GREY, False


def _safety_status(snapshot: EpisodeSnapshot) -> tuple[str, style.Color, bool]:
    """Return a text, its colour, and whether it is a warning."""
    if snapshot.h[-1] < 0.0:
        return "violation", style.VIOLATION, True
    return "safe" if snapshot.violated is None else "safe now, was not", style.GREEN, False


def _draw_status(canvas: Canvas, box: Box, text: str, color: style.Color, loud: bool) -> None:
    left, top, width, height = box
    canvas.fill(box, color if loud else style.mix(color, style.PANEL, 0.12), 6)
    canvas.frame(box, color, 1, 6)
    ink = (
        style.mix(color, style.INK, 0.6)
        if not loud
        else style.INK
        if color == style.INTERVENING
        else style.PAPER
    )
    middle = (left + width / 2, top + height / 2)
    canvas.text(text, middle, ink, style.NORMAL, bold=loud, align=(0.5, 0.5))


def _on_track(variable: Variable, value: float, beyond: bool = False) -> float:
    """Return the place of a value along the bar of an input, at its end unless `beyond` it."""
    inside = value if beyond else min(max(value, variable.low), variable.high)
    return _LEFT + _WIDTH * (inside - variable.low) / (variable.high - variable.low)
