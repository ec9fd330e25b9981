"""The scene of problems without a plane: a bar for each state, over its trail if there is room."""

from __future__ import annotations

from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.axes import Axes, grown, ticks
from safe_envs.rendering.canvas import Canvas
from safe_envs.rendering.safe_set import Barriers, tint
from safe_envs.rendering.scenes.base import (
    Scene,
    draw_point,
    draw_trail,
    draw_violation,
    warning_color,
)
from safe_envs.rendering.snapshot import EpisodeSnapshot
from safe_envs.rendering.style import (
    EDGE,
    GREY,
    INK,
    LINE,
    PANEL,
    SMALL,
    UNSAFE,
    VIOLATION,
    bound,
    label,
    number,
)

_LEFT, _WIDTH, _TOP, _BOTTOM = 40, 520, 58, 532
_MOST = 10
_HIGHEST = 240.0
_WITH_ENDS, _WITH_TRAIL = 60.0, 100.0
"""Pixels between states at which there is room for the ends of the range, and for the trail."""


class BarsScene(Scene):
    """Shows each state in its range, and where it may be for h >= 0 with the others as they are.

    With up to four states, each one's trail is below its bar: the later, the higher.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        super().__init__(problem)
        self._barriers = Barriers(problem)
        self._ranges = [self.range_of(i) for i in range(min(len(self.names), _MOST))]
        self._pitch = min(_HIGHEST, (_BOTTOM - _TOP) / len(self._ranges))

    def draw(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        """Draw the bars."""
        more = len(self.names) - len(self._ranges)
        rest = f" (and {more} more)" if more else ""
        below = "; below it, its trail" if self._pitch >= _WITH_TRAIL else ""
        canvas.text(
            f"States{rest}: tinted where each is safe while the others stay{below}",
            (_LEFT, 18),
            INK,
            SMALL,
            bold=True,
        )
        for i, usual in enumerate(self._ranges):
            self._draw_bar(
                canvas,
                snapshot,
                i,
                round(_TOP + i * self._pitch),
                *grown(usual, snapshot.states[:, i]),
            )

    def _draw_bar(
        self, canvas: Canvas, snapshot: EpisodeSnapshot, i: int, top: int, low: float, high: float
    ) -> None:
        value = float(snapshot.state[i])

        def place(at: float) -> float:
            return _LEFT + _WIDTH * (min(max(at, low), high) - low) / (high - low)

        canvas.text(label(self.names[i], self.problem.states[i].unit), (_LEFT, top), INK, SMALL)
        canvas.text(
            number(value, max(abs(low), abs(high))),
            (_LEFT + _WIDTH, top),
            INK,
            SMALL,
            bold=True,
            align=(1.0, 0.0),
        )
        bar = (_LEFT, top + 20, _WIDTH, 14)
        canvas.fill(bar, UNSAFE)
        for start, end in self._barriers.intervals(snapshot.state, i, low, high):
            canvas.fill((place(start), top + 20, place(end) - place(start), 14), tint(2))
            for edge in (start, end):
                if low < edge < high:
                    canvas.line((place(edge), top + 18), (place(edge), top + 35), EDGE, 3)
        canvas.frame(bar, GREY)
        if snapshot.violated is not None:
            canvas.cross((place(float(snapshot.violated[i])), top + 27), 5, VIOLATION)
        draw_point(canvas, (place(value), top + 27), warning_color(snapshot))
        if self._pitch >= _WITH_ENDS:
            for end, side in ((low, 0.0), (high, 1.0)):
                canvas.text(
                    bound(end),
                    (_LEFT + side * _WIDTH, top + 38),
                    GREY,
                    SMALL - 2,
                    align=(side, 0.0),
                )
        if self._pitch >= _WITH_TRAIL:
            box = (_LEFT, top + 56, _WIDTH, round(self._pitch) - 72)
            now = float(snapshot.times[-1])
            axes = Axes(box, (low, high), (now - self.problem.horizon, now))
            self._draw_trail(canvas, snapshot, i, axes)

    def _draw_trail(self, canvas: Canvas, snapshot: EpisodeSnapshot, i: int, axes: Axes) -> None:
        left, top, width, height = axes.box
        canvas.fill(axes.box, PANEL)
        for tick in ticks(*axes.x, most=10):
            canvas.fill((round(axes.place(tick, 0.0)[0]), top, 1, height), LINE)
        draw_trail(canvas, axes, snapshot.states[:, i], snapshot.times, snapshot.h)
        if snapshot.violated is not None:
            draw_violation(canvas, axes, (float(snapshot.violated[i]), snapshot.violated_at))
        canvas.frame((left - 1, top - 1, width + 2, height + 2), LINE)
        canvas.text(
            f"{self.problem.horizon:g} s ago",
            (left + 4, top + height - 1),
            GREY,
            SMALL - 2,
            align=(0.0, 1.0),
        )
