"""A vehicle seen from above, with obstacles and a goal, to scale."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.regions import GOAL
from safe_envs.rendering.axes import Axes
from safe_envs.rendering.canvas import Canvas
from safe_envs.rendering.safe_set import LEVELS, STEP, tint
from safe_envs.rendering.scenes.base import Scene, warning_color
from safe_envs.rendering.scenes.plane import BOX, StatePlane
from safe_envs.rendering.snapshot import EpisodeSnapshot
from safe_envs.rendering.style import GOAL as GOAL_COLOR
from safe_envs.rendering.style import GREY, INK, PAPER, SMALL, VIOLATION, mix

_LENGTH = 15.0
_MOVED = 2.0
"""Pixels that an obstacle has to have moved for two outlines of it to be told apart."""


@dataclass(frozen=True)
class Circle:
    """A circle, whose middle may move with the states.

    Attributes:
        radius: in the unit of the coordinates.
        encloses: whether what is safe is inside.
        middle: its coordinates, a compiled function of the components of the states.
    """

    radius: float
    encloses: bool
    middle: Callable[..., Any]

    def middles(self, states: np.ndarray) -> np.ndarray:
        """Return its middle at states (k, n), shape (k, 2)."""
        return np.stack(np.broadcast_arrays(*self.middle(*states.T), states[:, 0])[:2], axis=-1)


def circle_of(
    problem: SafetyProblem, expression: sp.Expr, x: sp.Symbol, y: sp.Symbol
) -> Circle | None:
    """Return the circle on which an expression vanishes in the plane of two coordinates.

    Args:
        problem: with the states.
        expression: of the states.
        x: coordinate to the right.
        y: coordinate upwards.

    Returns:
        The circle; None if the expression vanishes on another curve.
    """
    if not expression.is_polynomial(x, y):
        return None
    polynomial = sp.Poly(expression, x, y)
    square, mixed, other = (polynomial.coeff_monomial(term) for term in (x**2, x * y, y**2))
    if polynomial.total_degree() != 2 or not (
        square.is_number and other.is_number and mixed.is_number
    ):
        return None
    if float(square) != float(other) or float(mixed) != 0.0:
        return None
    middle = [-polynomial.coeff_monomial(s) / (2 * square) for s in (x, y)]
    area = middle[0] ** 2 + middle[1] ** 2 - polynomial.coeff_monomial(1) / square
    # Constant up to cos^2 + sin^2 and rounding: numbers decide it more reliably than sympy.
    (areas,) = compile_function(problem.plant.states, [area], "arrays")(
        *np.random.default_rng(0).uniform(-3, 3, (problem.plant.n, 8))
    )
    if not np.ptp(areas) <= 1e-9 * np.max(areas):
        return None
    return Circle(
        math.sqrt(float(np.max(areas))),
        bool(square < 0),
        compile_function(problem.plant.states, middle, "arrays"),
    )


class TopView(Scene):
    """Shows the plane of x and y; a triangle points along theta.

    Vehicles are points, so that the triangle has a fixed size in pixels. Obstacles are circles
    inside of which a barrier is negative, drawn with their recent paths; after a violation, also
    where they were then. The goal is a disk, and a region the outline of one, where they are round.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        super().__init__(problem)
        self._heading = self.index("theta")
        x, y = (problem.plant.states[self.index(name)] for name in ("x", "y"))
        circles = [circle_of(problem, barrier.expression, x, y) for barrier in problem.barriers]
        self._obstacles = [
            circle for circle in circles if circle is not None and not circle.encloses
        ]
        named = problem.regions if problem.goal is None else {**problem.regions, GOAL: problem.goal}
        disks = {name: circle_of(problem, expression, x, y) for name, expression in named.items()}
        self._disks = {name: disk for name, disk in disks.items() if disk is not None}
        self._rings = len(self._obstacles) == len(circles)
        self._plane = StatePlane(
            self, ("x", "y"), BOX, chosen=[] if self._rings else None, equal=True
        )

    def draw(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        """Draw the vehicle and its surroundings."""
        axes = self._plane.background(canvas, snapshot)
        with canvas.within(axes.box):
            self._draw_obstacles(canvas, axes, snapshot)
            self._draw_hit(canvas, axes, snapshot)
            for name, disk in self._disks.items():
                self._draw_region(canvas, axes, snapshot, name, disk)
            at = self._plane.trail(canvas, axes, snapshot)
            draw_vehicle(canvas, at, float(snapshot.state[self._heading]), snapshot)

    def _draw_region(
        self, canvas: Canvas, axes: Axes, snapshot: EpisodeSnapshot, name: str, disk: Circle
    ) -> None:
        """Draw the goal, or the outline of another region, with its name."""
        at = axes.place(*disk.middles(snapshot.states[-1:])[0])
        radius = disk.radius * axes.scale[0]
        if name == GOAL:
            canvas.disk(at, radius, mix(GOAL_COLOR, PAPER, 0.35), GOAL_COLOR, 2)
            canvas.disk(at, 2, INK)
        else:
            canvas.disk(at, radius, None, GREY, 1)
        above = at[0], at[1] - radius - 3
        canvas.label(name, above)

    def _draw_obstacles(self, canvas: Canvas, axes: Axes, snapshot: EpisodeSnapshot) -> None:
        paths = [
            axes.places(*obstacle.middles(snapshot.states[-60:]).T) for obstacle in self._obstacles
        ]
        sizes = [obstacle.radius * axes.scale[0] for obstacle in self._obstacles]
        if self._rings:
            # The same as a field of h, and much faster.
            for level in reversed(range(LEVELS - 1)):
                for path, size in zip(paths, sizes, strict=True):
                    canvas.disk(path[-1], size + STEP * (level + 1), tint(level))
        for obstacle, path, size in zip(self._obstacles, paths, sizes, strict=True):
            canvas.dashes(path, GREY, 1, 8.0)
            middle = path[-1]
            canvas.disk(middle, size, mix(VIOLATION, PAPER, 0.45), VIOLATION, 2)
            canvas.disk(middle, 2, INK)
            if size >= 14.0:
                canvas.line(middle, (middle[0] + size, middle[1]), INK)
                beside = middle[0] + size + 5, middle[1]
                radius = f"r = {obstacle.radius:g} m"
                canvas.label(radius, beside, INK, SMALL - 2, (0.0, 0.5))

    def _draw_hit(self, canvas: Canvas, axes: Axes, snapshot: EpisodeSnapshot) -> None:
        """Outline the obstacles that the vehicle hit at the first violation, as they were then."""
        if snapshot.violated is None:
            return
        vehicle = snapshot.violated[[self.index("x"), self.index("y")]]
        for obstacle in self._obstacles:
            then, now = obstacle.middles(np.stack([snapshot.violated, snapshot.state]))
            if (
                math.dist(then, vehicle) > obstacle.radius
                or math.dist(then, now) * axes.scale[0] < _MOVED
            ):
                continue
            at, size, color = (
                axes.place(*then),
                obstacle.radius * axes.scale[0],
                mix(VIOLATION, PAPER, 0.6),
            )
            canvas.disk(at, size, None, color, 2)
            # On the far side of the vehicle, whose trail and mark are on the near one.
            up = vehicle[1] < then[1]
            edge = at[1] - size - 2 if up else at[1] + size + 2
            canvas.label(
                f"at {snapshot.violated_at:.2f} s",
                (at[0], edge),
                mix(VIOLATION, INK, 0.6),
                SMALL,
                (0.5, float(up)),
            )


def draw_vehicle(
    canvas: Canvas, at: tuple[float, float], heading: float, snapshot: EpisodeSnapshot
) -> None:
    """Draw a triangle that points along a heading, and a line ahead of it.

    Args:
        canvas: to draw on.
        at: pixel of the vehicle.
        heading: in rad, from the axis to the right.
        snapshot: of the episode, for the colour.
    """
    ahead = math.cos(heading), -math.sin(heading)
    aside = -ahead[1], ahead[0]
    canvas.line(at, (at[0] + 2.2 * _LENGTH * ahead[0], at[1] + 2.2 * _LENGTH * ahead[1]), INK)
    outline = [(1.0, 0.0), (-0.6, 0.6), (-0.3, 0.0), (-0.6, -0.6)]
    for size, fill, edge in ((_LENGTH + 3, PAPER, PAPER), (_LENGTH, warning_color(snapshot), INK)):
        corners = [
            (
                at[0] + size * (a * ahead[0] + b * aside[0]),
                at[1] + size * (a * ahead[1] + b * aside[1]),
            )
            for a, b in outline
        ]
        canvas.shape(corners, fill, edge)
