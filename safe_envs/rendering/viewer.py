"""The viewer of an env: the history of its episodes, which it draws when it is asked to.

It imports pygame then, and not before: envs are made without it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from safe_envs.errors import ConfigurationError, install_extra
from safe_envs.problem.problem import SafetyProblem
from safe_envs.rendering.snapshot import DrawnDecision, History

if TYPE_CHECKING:
    from safe_envs.rendering.picture import Picture, Window

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
            from safe_envs.rendering.picture import Picture

            self._picture = Picture(self._problem)
        return self._picture

    def _go_live(self) -> None:
        if not self._live:
            return
        surface = self._drawn().draw(self._histories[0].snapshot, self.caption)
        if self._window is None:
            from safe_envs.rendering.picture import Window

            self._window = Window(
                surface.get_size(), self._problem.name, frames_a_second(self._problem)
            )
        self._window.show(surface)
