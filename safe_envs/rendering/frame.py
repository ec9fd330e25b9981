"""The picture of an instant of an episode: the scene of the problem, and the panel next to it."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import pygame

from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.canvas import Box, Canvas
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
            _photograph(self._canvas, shot, SCENE)
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


def _photograph(canvas: Canvas, pixels: np.ndarray, box: Box) -> None:
    """Show a picture as large as it fits into a box.

    Args:
        canvas: to draw on.
        pixels: uint8 of shape (height, width, 3).
        box: left, top, width and height.
    """
    left, top, width, height = box
    shown = pygame.surfarray.make_surface(pixels.swapaxes(0, 1))
    scale = min(width / shown.get_width(), height / shown.get_height())
    size = max(1, round(scale * shown.get_width())), max(1, round(scale * shown.get_height()))
    canvas.surface.blit(
        pygame.transform.smoothscale(shown, size),
        (left + (width - size[0]) // 2, top + (height - size[1]) // 2),
    )
