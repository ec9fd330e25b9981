"""The scene of a car behind its lead: the road to scale, and actual and required gap over time."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.axes import Axes
from safe_envs.rendering.canvas import Box, Canvas, thinned
from safe_envs.rendering.safe_set import STEP, Barriers, tint
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
    HATCH,
    INK,
    LINE,
    PAPER,
    SMALL,
    UNSAFE,
    VIOLATION,
    Color,
    label,
    mix,
    number,
)

_ROAD: Box = (90, 84, 420, 64)
_CHART: Box = (76, 232, 504, 254)
_CAR = (46, 20)
_SHORTEST = 25.0
_HALVINGS = 24
_MOST = 250


class Road(Scene):
    """Shows the own speed and the gap, which are the plane of the problem.

    Distances on the road are to scale, from bumper to bumper; the cars are symbols of a fixed size.
    The required gap is that at which the smallest barrier vanishes at the present speeds.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        super().__init__(problem)
        speed, gap = problem.plane or ("v", "z")
        self._speed, self._gap = self.index(speed), self.index(gap)
        self._barriers = Barriers(problem)
        self._lead = self._other_speed()

    def _other_speed(self) -> int | float | None:
        """Return the lead's speed: another state of the same unit, or else the parameter v_f."""
        unit = self.problem.states[self._speed].unit
        others = [
            i for i, s in enumerate(self.problem.states) if s.unit == unit and i != self._speed
        ]
        return others[0] if others else self.problem.plant.parameter_values.get("v_f")

    def required(self, states: np.ndarray) -> np.ndarray:
        """Return the gap at which the smallest barrier vanishes at states (k, n), by bisection."""
        low, high = (np.full(len(states), bound) for bound in self.range_of(self._gap))
        columns = [states[:, i] for i in range(states.shape[1])]
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            columns[self._gap] = middle
            safe = self._barriers(columns).min(axis=0) >= 0.0
            low, high = np.where(safe, low, middle), np.where(safe, middle, high)
        return 0.5 * (low + high)

    def draw(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        """Draw the road and the chart."""
        kept = thinned(len(snapshot.times), _MOST)
        required = self.required(snapshot.states[kept])
        self._draw_road(canvas, snapshot, float(required[-1]))
        self._draw_chart(canvas, snapshot, kept, required)

    def _draw_road(self, canvas: Canvas, snapshot: EpisodeSnapshot, required: float) -> None:
        _, top, _, height = _ROAD
        gap = float(snapshot.state[self._gap])
        axes = Axes(_ROAD, (0.0, _reach(max(gap, required))), (0.0, 1.0))
        canvas.text("Road, to scale", (76, 18), INK, SMALL, bold=True)
        canvas.fill((10, top, 580, height), (228, 230, 234))
        own, edge, lead = (axes.place(v, 0.0)[0] for v in (0.0, required, gap))
        lane = (top + 12, height - 24)
        canvas.fill((own, lane[0], edge - own, lane[1]), UNSAFE)
        with canvas.within((round(own), lane[0], max(round(edge - own), 0), lane[1])):
            for x in np.arange(own - lane[1], edge, 10.0).tolist():
                canvas.line((x, lane[0] + lane[1]), (x + lane[1], lane[0]), HATCH, 2)
        for level in range(4):
            start = edge + level * STEP / 2
            if start < lead:
                canvas.fill((start, lane[0], lead - start, lane[1]), tint(level))
        for y in (top + 4, top + height - 5):
            canvas.line((10, y), (590, y), PAPER, 3)
        canvas.line((edge, top - 4), (edge, top + height + 4), EDGE, 3)
        _draw_car(canvas, (own - _CAR[0] / 2, top + height / 2), warning_color(snapshot))
        _draw_car(canvas, (lead + _CAR[0] / 2, top + height / 2), GREY)
        self._draw_dimension(
            canvas,
            own,
            lead,
            top - 12,
            f"gap {number(gap)} m",
            INK if gap >= required else VIOLATION,
            True,
        )
        self._draw_dimension(
            canvas, own, edge, top + height + 14, f"required {number(required)} m", EDGE, False
        )
        self._draw_speeds(canvas, snapshot)

    def _draw_dimension(
        self,
        canvas: Canvas,
        start: float,
        end: float,
        y: float,
        text: str,
        color: Color,
        above: bool,
    ) -> None:
        middle = 0.5 * (start + end)
        canvas.arrow((middle, y), (start, y), color)
        canvas.arrow((middle, y), (end, y), color)
        at = (max(middle, start + 60), y - 4 if above else y + 4)
        canvas.text(
            text, at, mix(color, INK, 0.7), SMALL, bold=True, align=(0.5, 1.0 if above else 0.0)
        )

    def _draw_speeds(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        y = _ROAD[1] + _ROAD[3] + 34
        speed = float(snapshot.state[self._speed])
        canvas.text(f"own {number(speed)} m/s", (14, y), INK, SMALL)
        if self._lead is not None:
            other = float(snapshot.state[self._lead]) if isinstance(self._lead, int) else self._lead
            canvas.text(f"lead {number(other)} m/s", (586, y), INK, SMALL, align=(1.0, 0.0))

    def _draw_chart(
        self, canvas: Canvas, snapshot: EpisodeSnapshot, kept: np.ndarray, required: np.ndarray
    ) -> None:
        times, gaps = snapshot.times[kept], snapshot.states[kept, self._gap]
        end = max(self.problem.horizon, float(times[-1]))
        axes = Axes(
            _CHART,
            (end - self.problem.horizon, end),
            (0.0, _reach(max(float(gaps.max()), float(required.max())))),
        )
        canvas.fill(_CHART, PAPER)
        with canvas.within(_CHART):
            edge = axes.places(times, required)
            if len(edge) > 1:
                bottom, top = _CHART[1] + _CHART[3], _CHART[1]
                canvas.shape([(edge[0, 0], top), *edge, (edge[-1, 0], top)], tint(1))
                canvas.shape([(edge[0, 0], bottom), *edge, (edge[-1, 0], bottom)], UNSAFE)
        canvas.lay(_furniture(axes, label(self.names[self._gap], "m")))
        with canvas.within(_CHART):
            canvas.path(edge, EDGE, 3)
            ahead = np.array([edge[-1], (_CHART[0] + _CHART[2], edge[-1, 1])])
            canvas.dashes(ahead, EDGE, 1)
            canvas.text(
                "required now",
                (ahead[1, 0] - 6, edge[-1, 1] - 3),
                mix(EDGE, INK, 0.7),
                SMALL,
                align=(1.0, 1.0),
            )
        draw_trail(canvas, axes, snapshot.times, snapshot.states[:, self._gap], snapshot.h)
        if snapshot.violated is not None:
            draw_violation(
                canvas, axes, (snapshot.violated_at, float(snapshot.violated[self._gap]))
            )
        with canvas.within(_CHART):
            draw_point(
                canvas, axes.place(float(times[-1]), float(gaps[-1])), warning_color(snapshot)
            )


@lru_cache(maxsize=8)
def _furniture(axes: Axes, y_label: str) -> Canvas:
    """Return the grid of the chart. Few are kept: after the horizon each step has another one."""
    drawn = Canvas((600, 540), clear=True)
    axes.furnish(drawn, "t [s]", y_label)
    return drawn


def _reach(distance: float) -> float:
    """Return the first of 25, 50, 100, ... that is longer than a distance, with some room."""
    return _SHORTEST * 2.0 ** max(0, math.ceil(math.log2(max(1.1 * distance, 1.0) / _SHORTEST)))


def _draw_car(canvas: Canvas, center: tuple[float, float], color: Color) -> None:
    """Draw the symbol of a car that drives to the right, seen from above."""
    (x, y), (length, width) = center, _CAR
    left, top = x - length / 2, y - width / 2
    for wheel in (left + 7, left + length - 16):
        canvas.fill((wheel, top - 2, 9, width + 4), INK, 2)
    canvas.fill((left, top, length, width), color, 6)
    canvas.fill((left + 8, top + 3, 22, width - 6), mix(PAPER, color, 0.55), 4)
    canvas.fill((left + 24, top + 3, 7, width - 6), mix(INK, color, 0.55), 2)
    canvas.frame((left, top, length, width), INK, 1, 6)
    canvas.line((left + length - 2, top + 4), (left + length - 2, top + width - 5), LINE, 2)
