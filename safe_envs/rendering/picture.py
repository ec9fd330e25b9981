"""What is shown of an env: the picture of an instant, and the window for it."""

from __future__ import annotations

from functools import cached_property
from weakref import WeakSet

import numpy as np
import pygame

from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.canvas import Box, Canvas
from safe_envs.rendering.panel import Panel
from safe_envs.rendering.scenes import make_scene
from safe_envs.rendering.scenes.base import Scene
from safe_envs.rendering.snapshot import EpisodeSnapshot
from safe_envs.rendering.style import SCENE, SIZE

_OPEN: WeakSet[Window] = WeakSet()


class Window:
    """Shows pictures in real time, each object in a window of its own.

    Args:
        size: width and height in pixels.
        title: of the window.
        fps: pictures a second.

    Raises:
        ConfigurationError: there is no display.
    """

    def __init__(self, size: tuple[int, int], title: str, fps: int) -> None:
        self._size, self._title, self._fps = size, title, fps
        self._clock = pygame.time.Clock()
        self._window = self._opened()
        _OPEN.add(self)

    def _opened(self) -> pygame.Window:
        try:
            pygame.display.init()
            window = pygame.Window(self._title, self._size)
            window.get_surface()
        except pygame.error as error:
            raise ConfigurationError(
                f'no window can be opened ({error}); make the env with render_mode="rgb_array",'
                " which needs no display"
            ) from error
        return window

    def show(self, surface: pygame.Surface) -> None:
        """Show a picture once the time of the previous one is over."""
        try:
            self._show(surface)
        except pygame.error:
            # Gymnasium's own envs quit the display when they close, and with it all windows.
            if not pygame.display.get_init():
                _forget_all()
            self._window = self._opened()
            self._show(surface)

    def _show(self, surface: pygame.Surface) -> None:
        self._window.get_surface().blit(surface, (0, 0))
        pygame.event.pump()
        self._clock.tick(self._fps)
        self._window.flip()

    def close(self) -> None:
        """Close the window, and after the last one the display, unless other code uses it."""
        self._window.destroy()
        _OPEN.discard(self)
        if not _OPEN and pygame.display.get_init() and pygame.display.get_surface() is None:
            pygame.display.quit()


def _forget_all() -> None:
    """Destroy the windows that ended with the display."""
    # SDL may give a new window the address of an old one: destroying the old one later would end
    # the new one.
    for each in _OPEN:
        each._window.destroy()


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
    """Show a picture as large as it fits into a box."""
    left, top, width, height = box
    shown = pygame.surfarray.make_surface(pixels.swapaxes(0, 1))
    scale = min(width / shown.get_width(), height / shown.get_height())
    size = max(1, round(scale * shown.get_width())), max(1, round(scale * shown.get_height()))
    canvas.surface.blit(
        pygame.transform.smoothscale(shown, size),
        (left + (width - size[0]) // 2, top + (height - size[1]) // 2),
    )
