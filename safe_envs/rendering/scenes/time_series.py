"""The scene of a single state: its course over time, next to the line that it moves on."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from safe_envs.dynamics.codegen import compile_function
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.rendering.axes import Axes, Range
from safe_envs.rendering.canvas import Box, Canvas
from safe_envs.rendering.safe_set import Barriers, SafeSet
from safe_envs.rendering.scenes.base import Scene, draw_point, warning_color
from safe_envs.rendering.scenes.plane import StatePlane
from safe_envs.rendering.snapshot import EpisodeSnapshot
from safe_envs.rendering.style import GOAL, GREY, INK, SCENE, SMALL, mix

_CHART: Box = (76, 20, 384, 466)
_LINE: Box = (484, 20, 96, 466)


def reference_of(problem: SafetyProblem, name: str) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return the reference of a state over time: a feature with its name and "_ref".

    Args:
        problem: with the features.
        name: of the state.

    Returns:
        A function of times in s; None if there is no such feature of the time alone.
    """
    for feature in problem.features:
        if feature.name == f"{name}_ref" and feature.expression.free_symbols <= {TIME}:
            compiled = compile_function((TIME,), [feature.expression], "arrays")
            return lambda times: np.broadcast_to(compiled(times)[0], times.shape)
    return None


class TimeSeriesScene(Scene):
    """Shows a state over time at the left, and on its line at the right, at the same height.

    Args:
        problem: that is drawn.
        name: of the state.
    """

    def __init__(self, problem: SafetyProblem, name: str) -> None:
        super().__init__(problem)
        self._state = self.index(name)
        self._reference = reference_of(problem, name)
        self._chart = StatePlane(
            self,
            ("", name),
            _CHART,
            shown=((0.0, problem.horizon), self.range_of(self._state)),
            decorate=self._draw_reference,
        )
        self._barriers = Barriers(problem)
        self._lines: dict[Range, Canvas] = {}

    def draw(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        """Draw both."""
        axes = self._chart.background(canvas, snapshot)
        line = Axes(_LINE, (0.0, 1.0), axes.y)
        canvas.lay(self._line(line, snapshot))
        if self._reference is not None:
            wanted = line.place(0.5, float(self._reference(snapshot.times[-1:])[0]))[1]
            with canvas.within(_LINE):
                canvas.dashes(
                    np.array([(_LINE[0], wanted), (_LINE[0] + _LINE[2], wanted)]), GOAL, 2
                )
        at = self._chart.trail(canvas, axes, snapshot)
        middle = (_LINE[0] + _LINE[2] / 2, at[1])
        with canvas.within(SCENE):
            canvas.dashes(np.array([at, middle]), GREY, 1, 8.0)
        with canvas.within(axes.box):
            draw_point(canvas, at, warning_color(snapshot))
        with canvas.within(_LINE):
            self.draw_marker(canvas, middle, snapshot)

    def draw_marker(
        self, canvas: Canvas, at: tuple[float, float], snapshot: EpisodeSnapshot
    ) -> None:
        """Draw what moves on the line.

        Args:
            canvas: to draw on.
            at: pixel of the state.
            snapshot: of the episode.
        """
        draw_point(canvas, at, warning_color(snapshot))

    def _draw_reference(self, canvas: Canvas, axes: Axes) -> None:
        if self._reference is not None:
            times = np.linspace(*axes.x, 200)
            places = axes.places(times, self._reference(times))
            canvas.dashes(places, GOAL, 2)
            top = places[np.argmin(places[:, 1])]
            canvas.label("reference", (top[0], top[1] - 4), mix(GOAL, INK, 0.45))

    def _line(self, axes: Axes, snapshot: EpisodeSnapshot) -> Canvas:
        """Return the line with the safe set, drawn once if no barrier depends on other states."""
        state = self.problem.plant.states[self._state]
        fixed = all(b.expression.free_symbols <= {state} for b in self.problem.barriers)
        if fixed and axes.y in self._lines:
            return self._lines[axes.y]
        drawn = self._lines[axes.y] = Canvas((600, 540), clear=True)
        SafeSet(self._barriers, axes, (-1, self._state)).draw(drawn, snapshot.state)
        left, top, width, height = axes.box
        middle = left + width / 2
        drawn.line((middle, top), (middle, top + height), mix(INK, (255, 255, 255), 0.4), 1)
        drawn.frame((left - 1, top - 1, width + 2, height + 2), GREY)
        drawn.text("now", (middle, top + height + 4), GREY, SMALL, align=(0.5, 0.0))
        return drawn


class LineScene(TimeSeriesScene):
    """Shows the first state of a problem."""

    def __init__(self, problem: SafetyProblem) -> None:
        super().__init__(problem, problem.states[0].symbol.name)
