"""The panel beside the scene: time, what the filter does, the inputs, and the smallest barrier over
time."""

from __future__ import annotations

import math

import numpy as np

from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.rendering.axes import Axes, Range
from safe_envs.rendering.canvas import Canvas
from safe_envs.rendering.scenes.base import runs
from safe_envs.rendering.snapshot import EpisodeSnapshot
from safe_envs.rendering.style import (
    EDGE,
    EXECUTED,
    GREEN,
    GREY,
    HATCH,
    INFEASIBLE,
    INK,
    INTERVENING,
    LARGE,
    LINE,
    NORMAL,
    PANEL,
    PAPER,
    SCENE,
    SIZE,
    SMALL,
    UNSAFE,
    VIOLATION,
    Color,
    bound,
    label,
    mix,
    number,
    pretty,
)

_LEFT, _RIGHT = SCENE[2] + 20, SIZE[0] - 20
_WIDTH = _RIGHT - _LEFT
_BARS = (148, 348)
_MOST_BARS = 5
_BOTTOM = 480
_LEGEND = 512
_FIRST_STEPS = 100


class Panel:
    """Draws the panel.

    Args:
        problem: whose inputs and barriers are shown.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self._problem = problem
        # Over somebody else's env without a limit of time, the problem's horizon is a single
        # control period.
        self._endless = problem.steps == 1
        shown = problem.inputs[:_MOST_BARS]
        pitch = min(58.0, (_BARS[1] - _BARS[0] - 26) / len(shown))
        self._rows = [
            (variable, _BARS[0] + 26 + round(j * pitch)) for j, variable in enumerate(shown)
        ]
        self._ranged = pitch >= 50.0
        below = _BARS[0] + 26 + round(len(shown) * pitch) + 10
        self._heading = below
        self._box = (_LEFT + 56, below + 28, _WIDTH - 56, _BOTTOM - below - 28)
        self._background = Canvas(SIZE)
        canvas = self._background
        canvas.fill((SCENE[2], 0, SIZE[0] - SCENE[2], SIZE[1]), PANEL)
        canvas.line((SCENE[2], 0), (SCENE[2], SIZE[1]), LINE)
        canvas.text(problem.name, (_LEFT, 14), INK, LARGE, bold=True, widest=_WIDTH)
        more = len(problem.inputs) - len(shown)
        canvas.text(
            "Action" + (f" (and {more} more)" if more else ""),
            (_LEFT, _BARS[0]),
            INK,
            NORMAL,
            bold=True,
        )
        for variable, top in self._rows:
            self._track(variable, top)
        canvas.text(
            "Smallest h" if len(problem.barriers) > 1 else "h",
            (_LEFT, below),
            INK,
            NORMAL,
            bold=True,
        )
        self._legend()

    def draw(self, canvas: Canvas, moment: EpisodeSnapshot, caption: str) -> None:
        """Draw the panel, and blank paper for the scene."""
        canvas.lay(self._background)
        if caption:
            canvas.text(caption, (_LEFT, 42), GREY, NORMAL, widest=_WIDTH)
        time = float(moment.times[-1])
        canvas.text(f"t = {time:.2f} s", (_LEFT, 68), INK, NORMAL)
        if not self._endless:
            canvas.text(
                f"of {self._problem.duration:g} s", (_RIGHT, 68), GREY, NORMAL, align=(1.0, 0.0)
            )
            canvas.fill((_LEFT, 91, _WIDTH, 3), LINE)
            canvas.fill((_LEFT, 91, _WIDTH * min(time / self._problem.duration, 1.0), 3), GREY)
        self._status(canvas, moment)
        self._actions(canvas, moment)
        self._chart(canvas, moment)

    def _status(self, canvas: Canvas, moment: EpisodeSnapshot) -> None:
        half = _WIDTH // 2 - 4
        if moment.infeasible:
            filtered = ("infeasible", INFEASIBLE, True)
        elif moment.intervening:
            filtered = ("intervening", INTERVENING, True)
        elif moment.decision is not None:
            filtered = ("action unchanged", GREEN, False)
        else:
            filtered = (
                ("no filter", GREY, False)
                if moment.executed is not None
                else ("no step yet", GREY, False)
            )
        h = float(moment.h[-1])
        safe = (
            ("violation", VIOLATION, True)
            if h < 0.0
            else ("safe now, was not", GREEN, False)
            if moment.violated is not None
            else None
        )
        for (text, color, loud), left in (
            (filtered, _LEFT),
            (safe or ("safe", GREEN, False), _LEFT + half + 8),
        ):
            box = (left, 104, half, 28)
            canvas.fill(box, color if loud else mix(color, PANEL, 0.12), 6)
            canvas.frame(box, color, 1, 6)
            ink = INK if color == INTERVENING else PAPER
            canvas.text(
                text,
                (left + half / 2, 118),
                ink if loud else mix(color, INK, 0.6),
                NORMAL,
                bold=loud,
                align=(0.5, 0.5),
            )

    def _track(self, variable: Variable, top: int) -> None:
        """The empty bar of an input, with its name and its range."""
        canvas = self._background
        canvas.text(label(variable.symbol.name, variable.unit), (_LEFT, top), INK, SMALL)
        if self._ranged:
            for value, side in ((variable.low, 0.0), (variable.high, 1.0)):
                canvas.text(
                    bound(value),
                    (_LEFT + side * _WIDTH, top + 36),
                    GREY,
                    SMALL - 2,
                    align=(side, 0.0),
                )
        canvas.fill((_LEFT, top + 20, _WIDTH, 12), PAPER, 2)
        canvas.frame((_LEFT, top + 20, _WIDTH, 12), mix(GREY, PANEL, 0.6), 1, 2)

    def _actions(self, canvas: Canvas, moment: EpisodeSnapshot) -> None:
        executed, decision = moment.executed, moment.decision
        if executed is None:
            return
        color: Color = (
            INFEASIBLE if moment.infeasible else INTERVENING if moment.intervening else EXECUTED
        )
        for j, (variable, top) in enumerate(self._rows):
            rest = _on_track(variable, min(max(0.0, variable.low), variable.high))
            here = _on_track(variable, executed[j])
            canvas.fill((min(rest, here), top + 21, max(abs(here - rest), 2.0), 10), color)
            canvas.line((rest, top + 17), (rest, top + 34), INK)
            canvas.fill((here - 1, top + 18, 3, 16), INK)
            right, scale = _RIGHT, max(-variable.low, variable.high)
            if decision is not None:
                place = _on_track(
                    variable, min(max(decision.nominal[j], variable.low), variable.high)
                )
                canvas.diamond((place, top + 26), 7, None, INK)
                right -= (
                    canvas.text(
                        number(decision.nominal[j], scale),
                        (right, top),
                        INK,
                        SMALL,
                        align=(1.0, 0.0),
                    )
                    + 10
                )
                canvas.diamond((right, top + 8), 4, None, INK, 1)
                right -= 16
            right -= (
                canvas.text(
                    number(executed[j], scale),
                    (right, top),
                    INK,
                    SMALL,
                    bold=True,
                    align=(1.0, 0.0),
                )
                + 14
            )
            canvas.fill((right, top + 3, 9, 9), color)

    def _chart(self, canvas: Canvas, moment: EpisodeSnapshot) -> None:
        times, h = _thinned(moment.times, moment.h)
        low, high = min(float(h.min()), 0.0), max(float(h.max()), 0.0)
        span = max(high - low, 1e-9)
        axes = Axes(
            self._box, self._period(float(times[-1])), (low - 0.12 * span, high + 0.12 * span)
        )
        left, top, width, height = self._box
        edge = axes.place(0.0, 0.0)[1]
        canvas.fill((left, top, width, edge - top), mix(GREEN, PAPER, 0.10))
        canvas.fill((left, edge, width, top + height - edge), UNSAFE)
        canvas.line((left, edge), (left + width, edge), EDGE, 2)
        places = axes.places(times, h)
        canvas.within(self._box)
        canvas.path(places, INK, 2)
        for run in runs(h < 0.0):
            canvas.path(places[run], VIOLATION, 3)
        canvas.disk(places[-1], 4, VIOLATION if h[-1] < 0.0 else INK)
        canvas.within(None)
        canvas.frame((left - 1, top - 1, width + 2, height + 2), mix(GREY, PANEL, 0.6))
        canvas.text("0", (left - 6, edge), GREY, SMALL, align=(1.0, 0.5))
        far = high if high >= -low else low
        canvas.text(number(far), (left - 6, axes.place(0.0, far)[1]), GREY, SMALL, align=(1.0, 0.5))
        for time, side in zip(axes.x, (0.0, 1.0), strict=True):
            canvas.text(
                f"{time:.3g} s",
                (left + side * width, top + height + 4),
                GREY,
                SMALL - 1,
                align=(side, 0.0),
            )
        now = number(float(moment.h[-1]))
        right = canvas.text(
            f"least {number(moment.least)}",
            (_RIGHT, self._heading + 2),
            GREY,
            SMALL,
            align=(1.0, 0.0),
        )
        canvas.text(
            f"now {now}",
            (_RIGHT - right - 14, self._heading + 2),
            INK,
            SMALL,
            bold=True,
            align=(1.0, 0.0),
        )
        if len(moment.barriers) > 1:
            name = self._problem.barriers[int(np.argmin(moment.barriers))].name
            middle, room = left + width / 2, width - 120
            canvas.text(
                f"smallest: {pretty(name)}",
                (middle, top + height + 4),
                GREY,
                SMALL - 1,
                align=(0.5, 0.0),
                widest=room,
            )

    def _period(self, now: float) -> Range:
        """The times that the chart shows: the horizon, or the last one; without a horizon all, for
        100, 200, 400, ... control periods."""
        if self._endless:
            first = _FIRST_STEPS * self._problem.dt
            return 0.0, first * 2.0 ** max(0, math.ceil(math.log2(max(now, first) / first)))
        end = max(self._problem.horizon, now)
        return end - self._problem.horizon, end

    def _legend(self) -> None:
        canvas, y = self._background, _LEGEND
        canvas.fill((_LEFT, y + 4, 10, 10), EXECUTED)
        x = _LEFT + 16 + canvas.text("executed", (_LEFT + 16, y), INK, SMALL) + 16
        canvas.diamond((x, y + 8), 5, None, INK)
        x += 11 + canvas.text("nominal", (x + 11, y), INK, SMALL) + 16
        canvas.fill((x, y + 2, 18, 13), UNSAFE)
        canvas.within((x, y + 2, 18, 13))
        for offset in range(-12, 18, 6):
            canvas.line((x + offset, y + 15), (x + offset + 13, y + 2), HATCH, 2)
        canvas.within(None)
        canvas.frame((x, y + 2, 18, 13), EDGE)
        canvas.text("h < 0", (x + 24, y), INK, SMALL)


def _on_track(variable: Variable, value: float) -> float:
    return _LEFT + _WIDTH * (value - variable.low) / (variable.high - variable.low)


def _thinned(times: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most about two points a pixel, with the smallest h of each group, so that no violation is
    lost."""
    stride = 1 + len(h) // 400
    if stride == 1:
        return times, h
    starts = np.arange(0, len(h), stride)
    return times[np.minimum(starts + stride - 1, len(h) - 1)], np.minimum.reduceat(h, starts)
