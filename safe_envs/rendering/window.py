"""The window of the mode "human"."""

from __future__ import annotations

from weakref import WeakSet

import pygame

from safe_envs.errors import ConfigurationError

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
