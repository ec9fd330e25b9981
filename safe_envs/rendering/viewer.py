"""The viewer of an env: the history of its episodes, and the picture or window that shows them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any
from weakref import WeakSet

import gymnasium as gym
import numpy as np
import pygame

from safe_envs.errors import ConfigurationError, install_extra
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.canvas import Box, Canvas
from safe_envs.rendering.panel import Panel
from safe_envs.rendering.scenes import make_scene
from safe_envs.rendering.scenes.base import Scene
from safe_envs.rendering.snapshot import DrawnDecision, EpisodeSnapshot, History
from safe_envs.rendering.style import SCENE, SIZE

Rows = Any
"""A sequence or an array with an entry for each env."""

RENDER_MODES = ("human", "rgb_array")
"""What a scalar env can be made with, besides None; a vector env only with the last."""


_MOST_FRAMES = 1_000_000
"""A second of the shortest control periods has more than can be counted."""


def frames_a_second(problem: SafetyProblem) -> int:
    """Frame rate at which a picture of each control period makes a film in real time."""
    return max(1, round(min(1 / problem.dt, _MOST_FRAMES)))


def open_viewer(
    problem: SafetyProblem, mode: str | None, num_envs: int | None = None
) -> Viewer | None:
    """Return the viewer of an env, or None if it is not to be drawn.

    Args:
        problem: of the env.
        mode: of rendering.
        num_envs: size of the batch of a vector env; None for a scalar env.

    Raises:
        ConfigurationError: there is no such mode, or not for such an env.
    """
    allowed = RENDER_MODES if num_envs is None else RENDER_MODES[1:]
    if mode is None:
        return None
    if mode not in allowed:
        reason = (
            "a window shows one env, so make a scalar one for it; " if mode in RENDER_MODES else ""
        )
        raise ConfigurationError(
            f"render_mode = {mode!r}; {reason}allowed: None, {', '.join(map(repr, allowed))}"
        )
    return Viewer(problem, mode, num_envs or 1)


def require_pygame() -> None:
    """Check that pygame-ce can be imported.

    Raises:
        gymnasium.error.DependencyNotInstalled: it is missing, or the other pygame is in its place.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    # Else it takes the signals of the whole program, and processes forked from it cannot be ended.
    os.environ.setdefault("SDL_NO_SIGNAL_HANDLERS", "1")
    try:
        import pygame
    except ImportError as error:
        raise gym.error.DependencyNotInstalled(
            f"drawing needs pygame-ce: {install_extra('render')}"
        ) from error
    if not hasattr(pygame.draw, "aacircle"):
        # Two distributions share the name of the import, and each overwrites files of the other.
        raise gym.error.DependencyNotInstalled(
            "drawing needs pygame-ce 2.5 or newer, and what is imported is pygame"
            f" {pygame.version.ver}: pip uninstall pygame pygame-ce, and then"
            f" {install_extra('render')}"
        )


class Viewer:
    """Records the episodes of a batch of envs, and draws them on request.

    Attributes:
        caption: a text in the panel, such as the name of a filter.

    Args:
        problem: of the envs.
        mode: "rgb_array", or "human" to draw each recorded state to a window in real time.
        num_envs: size of the batch.
    """

    def __init__(self, problem: SafetyProblem, mode: str, num_envs: int) -> None:
        self.caption = ""
        self._problem = problem
        self._live = mode == "human"
        self._histories = [History(problem) for _ in range(num_envs)]
        self._decisions: list[DrawnDecision | None] = [None] * num_envs
        self._picture: Picture | None = None
        self._window: Window | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without window and canvas, which a copy makes itself when it draws."""
        return {**vars(self), "_picture": None, "_window": None}

    def announce(self, nominal: Rows, active: Rows, feasible: Rows) -> None:
        """Keep what a filter decided for the next step.

        Args:
            nominal: inputs of the policy, a row for each env.
            active: whether the filter changed them.
            feasible: whether the constraints could be met.
        """
        self._decisions = [
            DrawnDecision(tuple(n), bool(a), bool(f))
            for n, a, f in zip(nominal, active, feasible, strict=True)
        ]

    def restart(self, states: Rows, times: Rows, envs: Iterable[int]) -> None:
        """Begin an episode in some envs.

        Args:
            states: of all envs.
            times: since the start of each env's episode, in s.
            envs: indices of those that begin.
        """
        for i in envs:
            self._histories[i].restart(states[i], float(times[i]))
        self._decisions = [None] * len(self._histories)
        self._go_live()

    def advance(
        self, states: Rows, times: Rows, executed: Rows, restarted: Iterable[int] = ()
    ) -> None:
        """Record a step of all envs.

        Args:
            states: after the step.
            times: since the start of each env's episode, in s.
            executed: inputs, in physical units.
            restarted: indices of the envs that begin an episode instead.
        """
        fresh = frozenset(restarted)
        for i, history in enumerate(self._histories):
            if i in fresh:
                history.restart(states[i], float(times[i]))
            else:
                history.append(states[i], float(times[i]), tuple(executed[i]), self._decisions[i])
        self._decisions = [None] * len(self._histories)
        self._go_live()

    def frames(self, shots: Sequence[np.ndarray] | None = None) -> tuple[np.ndarray, ...]:
        """Draw each env, uint8 of shape (height, width, 3).

        Args:
            shots: frames of third-party envs, to show in place of the scenes.

        Raises:
            gymnasium.error.DependencyNotInstalled: pygame is missing.
            ConfigurationError: there is no scene of the problem's name for it.
        """
        picture = self._drawn()
        each = shots or [None] * len(self._histories)
        return tuple(
            [
                picture.frame(history.snapshot, self.caption, shot)
                for history, shot in zip(self._histories, each, strict=True)
            ]
        )

    def render(self) -> Any:
        """Draw a single env; in human mode to the window, and None is returned.

        Raises:
            gymnasium.error.DependencyNotInstalled: pygame is missing.
            ConfigurationError: there is no display for a window.
        """
        if self._live:
            self._go_live()
            return None
        return self.frames()[0]

    def close(self) -> None:
        """Close the window, if there is one; drawing again opens another."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _drawn(self) -> Picture:
        if self._picture is None:
            require_pygame()

            self._picture = Picture(self._problem)
        return self._picture

    def _go_live(self) -> None:
        if not self._live:
            return
        surface = self._drawn().draw(self._histories[0].snapshot, self.caption)
        if self._window is None:
            self._window = Window(
                surface.get_size(), self._problem.name, frames_a_second(self._problem)
            )
        self._window.show(surface)


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
    """Destroy the windows that ended with the display.

    SDL may give a new window the address of an old one: destroying the old one later would end the
    new one.
    """
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
