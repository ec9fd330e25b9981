"""The scene of problems with a plane: two states, with the safe set in their plane."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.axes import Axes, Range, grown
from safe_envs.rendering.canvas import Box, Canvas
from safe_envs.rendering.safe_set import LEVELS, Barriers, SafeSet, tint
from safe_envs.rendering.scenes.base import (
    Scene,
    draw_point,
    draw_trail,
    draw_violation,
    warning_color,
)
from safe_envs.rendering.snapshot import EpisodeSnapshot
from safe_envs.rendering.style import label

BOX = (76, 20, 504, 466)
"""Of a plane that fills the scene."""

_LONGEST = 4.0
"""Largest ratio of length to width of a plane that is drawn to scale."""


class StatePlane:
    """The safe set, the trail and the state in a box of a scene, with the other states as they are.

    The background is drawn once, unless a barrier depends on states outside the plane.

    Args:
        scene: that it is part of.
        names: of the states along x and y; "" for the time along x.
        box: left, top, width and height.
        chosen: indices of the barriers to show; None for all.
        equal: whether both axes have the same scale.
        shown: the ranges to begin with; by default those of the scene's `window`.
        decorate: draws more of the background.
    """

    def __init__(
        self,
        scene: Scene,
        names: tuple[str, str],
        box: Box,
        *,
        chosen: list[int] | None = None,
        equal: bool = False,
        shown: tuple[Range, Range] | None = None,
        decorate: Callable[[Canvas, Axes], None] | None = None,
    ) -> None:
        problem = scene.problem
        self._labels = [label(name, scene.unit(name)) if name else "t [s]" for name in names]
        self.x, self.y = (scene.index(name) if name else -1 for name in names)
        self._box, self._equal, self._decorate = box, equal, decorate
        self._shown = shown or scene.window(self.x, self.y)
        self._barriers = Barriers(problem, chosen)
        inside = {problem.plant.states[i] for i in (self.x, self.y) if i >= 0}
        self._changes = any(
            problem.barriers[k].expression.free_symbols - inside for k in self._barriers.chosen
        )
        self._views: dict[Axes, tuple[SafeSet | None, Canvas]] = {}

    def background(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> Axes:
        """Draw the safe set and the axes, which grow where the trail leaves them.

        Args:
            canvas: to draw on.
            snapshot: of the episode.

        Returns:
            The axes.
        """
        ranges = [
            grown(r, _values(snapshot, i))
            for r, i in zip(self._shown, (self.x, self.y), strict=True)
        ]
        axes = Axes.equal(self._box, *ranges) if self._equal else Axes(self._box, *ranges)
        if axes not in self._views:
            self._views[axes] = self._view(axes, snapshot)
        safe_set, furniture = self._views[axes]
        if safe_set is not None:
            safe_set.draw(canvas, snapshot.state)
        canvas.lay(furniture)
        return axes

    def _view(self, axes: Axes, snapshot: EpisodeSnapshot) -> tuple[SafeSet | None, Canvas]:
        safe_set = (
            SafeSet(self._barriers, axes, (self.x, self.y)) if len(self._barriers.chosen) else None
        )
        furniture = Canvas(
            (axes.box[0] + axes.box[2] + 20, axes.box[1] + axes.box[3] + 42), clear=True
        )
        if safe_set is None:
            furniture.fill(axes.box, tint(LEVELS - 1))
        elif not self._changes:
            safe_set.draw(furniture, snapshot.state)
        if self._decorate is not None:
            with furniture.within(axes.box):
                self._decorate(furniture, axes)
        axes.furnish(furniture, *self._labels, grid=False)
        return safe_set if self._changes else None, furniture

    def trail(self, canvas: Canvas, axes: Axes, snapshot: EpisodeSnapshot) -> tuple[float, float]:
        """Draw the trail and the first violation.

        Args:
            canvas: to draw on.
            axes: of the plane.
            snapshot: of the episode.

        Returns:
            The pixel of the state.
        """
        x, y = _values(snapshot, self.x), _values(snapshot, self.y)
        draw_trail(canvas, axes, x, y, snapshot.h)
        if snapshot.violated is not None:
            x_then = snapshot.violated_at if self.x < 0 else snapshot.violated[self.x]
            draw_violation(canvas, axes, (x_then, snapshot.violated[self.y]))
        return axes.place(float(x[-1]), float(y[-1]))

    def draw(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        """Draw all of it, with a point for the state.

        Args:
            canvas: to draw on.
            snapshot: of the episode.
        """
        axes = self.background(canvas, snapshot)
        at = self.trail(canvas, axes, snapshot)
        with canvas.within(axes.box):
            draw_point(canvas, at, warning_color(snapshot))


def _values(snapshot: EpisodeSnapshot, i: int) -> np.ndarray:
    """Return a state along the episode; the time for -1."""
    return snapshot.times if i < 0 else snapshot.states[:, i]


class PlaneScene(Scene):
    """Shows the plane of the problem; to scale if its axes have one unit and similar lengths."""

    def __init__(self, problem: SafetyProblem) -> None:
        super().__init__(problem)
        names = problem.plane or (self.names[0], self.names[-1])
        shown = self.window(self.index(names[0]), self.index(names[1]))
        wide, tall = (high - low for low, high in shown)
        alike = self.unit(names[0]) == self.unit(names[1]) and max(wide, tall) <= _LONGEST * min(
            wide, tall
        )
        self._plane = StatePlane(self, names, BOX, equal=alike, shown=shown)

    def draw(self, canvas: Canvas, snapshot: EpisodeSnapshot) -> None:
        """Draw the plane."""
        self._plane.draw(canvas, snapshot)
