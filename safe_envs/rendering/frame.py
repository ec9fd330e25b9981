"""The picture of an instant of an episode: the scene of the problem, and the panel next to it."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import pygame

from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.canvas import Canvas
from safe_envs.rendering.panel import Panel
from safe_envs.rendering.scenes import make_scene
from safe_envs.rendering.scenes.base import Scene
from safe_envs.rendering.snapshot import EpisodeSnapshot
from safe_envs.rendering.style import SCENE, SIZE


class Picture:
    """Draws instants of a problem's episodes; one object serves any number of envs.

    Args:
        problem: that is drawn. Its scene is looked up when it is first shown.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self._canvas = Canvas(SIZE)
        self._panel = Panel(problem)
        self._problem = problem

    @cached_property
    def _scene(self) -> Scene:
        return make_scene(self._problem)

    def draw(
        self, snapshot: EpisodeSnapshot, caption: str = "", shot: np.ndarray | None = None
    ) -> pygame.Surface:
        """Draw an instant.

        Args:
            snapshot: what is drawn.
            caption: in the panel.
            shot: frame of a third-party env, uint8 of shape (height, width, 3), to show in place of
                the scene.

        Returns:
            A surface that the next call overwrites.
        """
        self._panel.draw(self._canvas, snapshot, caption)
        if shot is None:
            self._scene.draw(self._canvas, snapshot)
        else:
            self._canvas.photograph(shot, SCENE)
        return self._canvas.surface

    def frame(
        self, snapshot: EpisodeSnapshot, caption: str = "", shot: np.ndarray | None = None
    ) -> np.ndarray:
        """Draw an instant as an array.

        Args:
            snapshot: as for `draw`.
            caption: as for `draw`.
            shot: as for `draw`.

        Returns:
            Pixels, uint8 of shape (height, width, 3).
        """
        self.draw(snapshot, caption, shot)
        return self._canvas.pixels()
