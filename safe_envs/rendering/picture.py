"""The picture of an instant of an episode: the scene of the problem, and the panel beside it."""

from __future__ import annotations

import numpy as np
import pygame

from safe_envs.problem import SafetyProblem
from safe_envs.rendering.canvas import Canvas
from safe_envs.rendering.history import Moment
from safe_envs.rendering.panel import Panel
from safe_envs.rendering.scenes import make_scene
from safe_envs.rendering.style import SIZE


class Picture:
    """Draws instants of a problem's episodes; it holds no episode, so that one object serves any number of envs.

    Args:
        problem: that is drawn.

    Raises:
        ConfigurationError: there is no scene of the problem's name for it.
    """

    def __init__(self, problem: SafetyProblem) -> None:
        self._canvas = Canvas(SIZE)
        self._panel = Panel(problem)
        self._scene = make_scene(problem)

    def draw(self, moment: Moment, caption: str = "") -> pygame.Surface:
        """Draw an instant; the surface is drawn over by the next call."""
        self._panel.draw(self._canvas, moment, caption)
        self._scene.draw(self._canvas, moment)
        return self._canvas.surface

    def frame(self, moment: Moment, caption: str = "") -> np.ndarray:
        """Draw an instant; uint8 of shape (height, width, 3)."""
        self.draw(moment, caption)
        return self._canvas.pixels()
