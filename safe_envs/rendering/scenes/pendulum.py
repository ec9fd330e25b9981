"""The scene of a pendulum: the rod with its safe angles, and the plane of angle and speed."""

from __future__ import annotations

import math

import numpy as np

from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.canvas import Box, Canvas
from safe_envs.rendering.safe_set import Barriers, tint
from safe_envs.rendering.scenes.base import Scene, warning_color
from safe_envs.rendering.scenes.plane import StatePlane
from safe_envs.rendering.snapshot import EpisodeSnapshot
from safe_envs.rendering.style import EDGE, GREY, HATCH, INK, PAPER, SMALL, UNSAFE, mix, number

_ROD: Box = (76, 30, 504, 178)
_PLANE: Box = (76, 244, 504, 242)


class PendulumScene(Scene):
    """Shows the angle theta from the upright, clockwise.

    The parameter l, if there is one, is the length of the rod in m.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        super().__init__(problem)
        self._angle = self.index("theta")
        self._reach = self.range_of(self._angle)
        self._barriers = Barriers(problem)
        self._plane = StatePlane(self, ("theta", "thetadot"), _PLANE)
        self._length = problem.plant.parameter_values.get("l")

    def draw(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        """Draw the rod and the plane."""
        self._draw_rod(canvas, snapshot)
        self._plane.draw(canvas, snapshot)

    def _draw_rod(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        left, top, width, height = _ROD
        pivot, length = (left + width / 2, top + height - 26.0), height - 44.0
        theta = float(snapshot.state[self._angle])

        def at(angle: float, radius: float) -> tuple[float, float]:
            return pivot[0] + radius * math.sin(angle), pivot[1] - radius * math.cos(angle)

        def sector(low: float, high: float) -> list[tuple[float, float]]:
            return [pivot, *(at(a, length) for a in np.linspace(low, high, 41).tolist())]

        low, high = max(self._reach[0], -math.pi), min(self._reach[1], math.pi)
        canvas.shape(sector(low, high), UNSAFE, HATCH)
        for angle in np.arange(low, high, math.radians(4.0)).tolist():
            canvas.line(at(angle, 0.15 * length), at(angle, length), HATCH)
        for start, end in self._barriers.intervals(snapshot.state, self._angle, low, high):
            canvas.shape(sector(start, end), tint(1), EDGE, 2)
            # Each number is on the unsafe side of its line, so that close ones are apart.
            for angle, side in ((start, 1.0), (end, 0.0)):
                if low < angle < high:
                    outer = at(angle, length + 22)
                    canvas.text(number(angle), outer, EDGE, SMALL, align=(side, 0.5))
        canvas.dashes(np.array([pivot, at(0.0, length + 10)]), GREY)
        base = pivot[1] + 12
        canvas.line((pivot[0] - 150, base), (pivot[0] + 150, base), INK, 2)
        for x in range(-148, 150, 12):
            canvas.line((pivot[0] + x, base + 9), (pivot[0] + x + 9, base), GREY)
        canvas.fill((pivot[0] - 14, pivot[1], 28, 12), GREY, 3)
        color = warning_color(snapshot)
        canvas.line(pivot, at(theta, length), PAPER, 11)
        canvas.line(pivot, at(theta, length), INK, 6)
        canvas.disk(at(theta, length), 12, PAPER)
        canvas.disk(at(theta, length), 11, color, INK, 1)
        canvas.disk(pivot, 5, PAPER, INK, 2)
        size = "" if self._length is None else f"l = {self._length:g} m"
        canvas.text(size, (left, top + height - 34), GREY, SMALL)
        canvas.text(f"θ = {number(theta, 1.0)} rad", (left, top - 8), INK, SMALL, bold=True)
        canvas.text(
            "safe at this speed",
            (left + width, top - 8),
            mix(EDGE, INK, 0.7),
            SMALL,
            align=(1.0, 0.0),
        )
        canvas.fill((left + width - 142, top - 6, 14, 12), tint(1))
        canvas.frame((left + width - 142, top - 6, 14, 12), EDGE)
