"""The scenes of a quadrotor: its altitude over time, or its position and attitude from the side."""

from __future__ import annotations

import math

import numpy as np
import pygame

from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.axes import Axes
from safe_envs.rendering.canvas import Canvas, text_size
from safe_envs.rendering.safe_set import Barriers, barriers_in
from safe_envs.rendering.scenes.base import Scene, warning_color
from safe_envs.rendering.scenes.plane import BOX, StatePlane
from safe_envs.rendering.scenes.time_series import TimeSeriesScene, reference_of
from safe_envs.rendering.snapshot import EpisodeSnapshot
from safe_envs.rendering.style import (
    EDGE,
    GOAL,
    GREEN,
    GREY,
    INK,
    PAPER,
    SMALL,
    UNSAFE,
    VIOLATION,
    Color,
    mix,
    number,
)

_ARM = 30.0
_ELEVATION = math.radians(14)
_DIAL = (512, 76, 48)


def rotation(phi: float, theta: float, psi: float) -> np.ndarray:
    """Return the rotation from body to world: yaw after pitch after roll.

    Args:
        phi: roll in rad.
        theta: pitch in rad.
        psi: yaw in rad.

    Returns:
        Shape (3, 3); the last column is the direction of the thrust.
    """
    (a, b), (c, d), (e, f) = ((math.cos(angle), math.sin(angle)) for angle in (phi, theta, psi))
    return np.array(
        [
            [c * e, d * e * b - f * a, d * e * a + f * b],
            [c * f, d * f * b + e * a, d * f * a - e * b],
            [-d, c * b, c * a],
        ]
    )


def draw_quadrotor(
    canvas: Canvas, at: tuple[float, float], attitude: np.ndarray, color: Color
) -> None:
    """Draw the symbol of a quadrotor, of a fixed size, seen along y from a little above.

    Args:
        canvas: to draw on.
        at: pixel of its centre.
        attitude: rotation from body to world, shape (3, 3).
        color: of its body.
    """

    def seen(points: np.ndarray) -> np.ndarray:
        world = points @ attitude.T
        height = world[:, 2] * math.cos(_ELEVATION) + world[:, 1] * math.sin(_ELEVATION)
        return np.stack([at[0] + world[:, 0], at[1] - height], axis=1)

    angles = np.linspace(0.0, 2 * math.pi, 19)[:-1]
    ring = 0.42 * _ARM * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    hubs = _ARM * np.array([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
    for one, other in ((0, 2), (1, 3)):
        ends = seen(hubs[[one, other]])
        canvas.line(ends[0], ends[1], PAPER, 8)
        canvas.line(ends[0], ends[1], INK, 4)
    for hub in hubs[np.argsort(-(hubs @ attitude.T)[:, 1])]:
        canvas.shape(seen(ring + hub + (0.0, 0.0, 5.0)), mix(color, PAPER, 0.55), INK, 1)
    canvas.disk(seen(np.zeros((1, 3)))[0], 7, color, INK, 1)


class AltitudeScene(TimeSeriesScene):
    """Shows the altitude z over time, with a level quadrotor at the right."""

    def __init__(self, problem: SafetyProblem) -> None:
        super().__init__(problem, "z")

    def draw_marker(
        self, canvas: Canvas, at: tuple[float, float], snapshot: EpisodeSnapshot
    ) -> None:
        """Draw the quadrotor."""
        draw_quadrotor(canvas, at, np.eye(3), warning_color(snapshot))


class SideView(Scene):
    """Shows the plane of x and z to scale, the quadrotor, enlarged, and a dial of its tilt.

    The plane shows the barriers that depend on the position alone, and the dial those that depend
    on roll and pitch alone.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        super().__init__(problem)
        place = [self.index(name) for name in ("x", "y", "z")]
        self._angles = [self.index(name) for name in ("phi", "theta", "psi")]
        shown = self.range_of(place[0]), self.range_of(place[2])
        self._plane = StatePlane(
            self, ("x", "z"), BOX, chosen=barriers_in(problem, place), equal=True, shown=shown
        )
        self._references = [reference_of(problem, name) for name in ("x", "z")]
        tilts = barriers_in(problem, self._angles[:2])
        self._limits: list[tuple[float, float]] = []
        if tilts:
            reach = self.range_of(self._angles[1])
            self._limits = Barriers(problem, tilts).intervals(
                np.zeros(len(self.names)), self._angles[1], *reach
            )

    def draw(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        """Draw the quadrotor and its reference."""
        axes = self._plane.background(canvas, snapshot)
        with canvas.within(axes.box):
            named = self._draw_reference(canvas, axes, snapshot)
            at = self._plane.trail(canvas, axes, snapshot)
            attitude = rotation(*(float(snapshot.state[i]) for i in self._angles))
            draw_quadrotor(canvas, at, attitude, warning_color(snapshot))
            self._draw_dial(canvas, attitude)
            if named is not None:
                _name_reference(canvas, axes, named, at)

    def _draw_reference(
        self, canvas: Canvas, axes: Axes, snapshot: EpisodeSnapshot
    ) -> tuple[float, float] | None:
        """Draw the reference; return the pixel next to which its name belongs."""
        now = snapshot.times[-1:]
        x, z = (
            None if reference is None else float(reference(now)[0])
            for reference in self._references
        )
        if z is None:
            return None
        at = axes.place(0.0 if x is None else x, z)
        if x is None:
            canvas.dashes(
                np.array([(axes.box[0], at[1]), (axes.box[0] + axes.box[2], at[1])]), GOAL, 2
            )
            return axes.box[0] + 46.0, at[1]
        canvas.disk(at, 11, None, PAPER, 5)
        canvas.disk(at, 10, None, GOAL, 3)
        canvas.disk(at, 2, INK)
        return at

    def _draw_dial(self, canvas: Canvas, attitude: np.ndarray) -> None:
        """Draw the angle between thrust and vertical, to the side of the thrust that is seen."""
        x, y, radius = _DIAL
        up = attitude[:, 2]
        tilt = math.copysign(math.acos(min(max(float(up[2]), -1.0), 1.0)), float(up[0]))
        safe = not self._limits or any(low <= tilt <= high for low, high in self._limits)
        canvas.fill((x - radius - 8, y - radius - 6, 2 * radius + 16, radius + 36), PAPER, 6)
        canvas.frame((x - radius - 8, y - radius - 6, 2 * radius + 16, radius + 36), GREY, 1, 6)
        canvas.shape(
            _sector((x, y), radius, -math.pi / 2, math.pi / 2),
            UNSAFE if self._limits else mix(GREEN, PAPER, 0.1),
            GREY,
        )
        for low, high in self._limits:
            canvas.shape(_sector((x, y), radius, low, high), mix(GREEN, PAPER, 0.2), EDGE, 2)
        canvas.line((x, y), (x, y - radius), GREY)
        tip = x + radius * math.sin(tilt), y - radius * math.cos(tilt)
        canvas.arrow((x, y), tip, INK if safe else VIOLATION, 3, 9.0)
        canvas.text(f"tilt {number(abs(tilt))} rad", (x, y + 6), INK, SMALL, align=(0.5, 0.0))


def _name_reference(
    canvas: Canvas, axes: Axes, at: tuple[float, float], quadrotor: tuple[float, float]
) -> None:
    """Write the name of the reference where nothing covers it and it covers nothing."""
    width, height = text_size("reference", SMALL)
    left, top, across, down = axes.box
    x, y, radius = _DIAL
    dial = pygame.Rect(x - radius - 8, y - radius - 6, 2 * radius + 16, radius + 36)
    body = pygame.Rect(0, 0, 2 * _ARM + 14, 2 * _ARM + 14)
    body.center = round(quadrotor[0]), round(quadrotor[1])
    inside = pygame.Rect(left, top, across, down)
    side, away = width / 2 + 16, _ARM + 24
    steps = [(0, -22), (0, 22), (-side, 0), (side, 0)]
    steps += [(0, -away), (0, away), (-side - away, 0), (side + away, 0)]
    places = []
    for right, below in steps:
        box = pygame.Rect(0, 0, width + 4, height + 4)
        box.center = round(at[0] + right), round(at[1] + below)
        places.append(box)
    free = (
        box
        for box in places
        if inside.contains(box) and not box.colliderect(dial) and not box.colliderect(body)
    )
    place = next(free, places[0].clamp(inside)).center
    ink = mix(GOAL, INK, 0.45)
    canvas.label("reference", place, ink, SMALL, (0.5, 0.5))


def _sector(
    center: tuple[float, float], radius: float, low: float, high: float
) -> list[tuple[float, float]]:
    """Return the corners of a sector between two angles from the vertical, clockwise."""
    angles = np.linspace(low, high, 25).tolist()
    return [
        center,
        *((center[0] + radius * math.sin(a), center[1] - radius * math.cos(a)) for a in angles),
    ]
