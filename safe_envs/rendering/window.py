"""The window of the mode "human"."""

from __future__ import annotations

import pygame

from safe_envs.errors import ConfigurationError


class Window:
    """Shows pictures in real time.

    Args:
        size: width and height in pixels.
        title: of the window.
        fps: pictures a second.

    Raises:
        ConfigurationError: there is no display.
    """

    def __init__(self, size: tuple[int, int], title: str, fps: int) -> None:
        try:
            pygame.display.init()
            self._screen = pygame.display.set_mode(size)
        except pygame.error as error:
            pygame.display.quit()
            raise ConfigurationError(
                f'no window can be opened ({error}); make the env with render_mode="rgb_array", which needs no display'
            ) from error
        pygame.display.set_caption(title)
        self._clock = pygame.time.Clock()
        self._fps = fps

    def show(self, surface: pygame.Surface) -> None:
        """Show a picture, once the time of the one before is over."""
        self._screen.blit(surface, (0, 0))
        pygame.event.pump()
        self._clock.tick(self._fps)
        pygame.display.flip()

    def close(self) -> None:
        """Close the window."""
        pygame.display.quit()
