"""Trajectories of the first episodes, for pictures."""

from __future__ import annotations

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.errors import ConfigurationError

_KEPT_BARRIERS = 256
_KEPT_STATES = 32
_MOST_RECORDED = 1_000_000


class Trajectories:
    """Trajectories of the first episodes, NaN after their ends.

    Attributes:
        barrier: smallest barrier value, shape (steps + 1, at most 256).
        states: shape (steps + 1, at most 32, n).

    Raises:
        ConfigurationError: an episode has more steps than a picture could show.
    """

    def __init__(self, steps: int, states: int, episodes: int) -> None:
        if steps > _MOST_RECORDED:
            raise ConfigurationError(
                f"an episode of {steps} steps is too long to draw; choose a horizon of at most"
                f" {_MOST_RECORDED} steps"
            )
        self.barrier = np.full((steps + 1, min(episodes, _KEPT_BARRIERS)), np.nan)
        self.states = np.full((steps + 1, min(episodes, _KEPT_STATES), states), np.nan)

    def note(self, k: int, first: int, present: np.ndarray, h: np.ndarray, x: Components) -> None:
        """Keep instant k of a batch that begins with the episode `first`.

        Args:
            k: the instant.
            first: number of the first episode.
            present: which episodes are under way, shape (B,).
            h: smallest barrier values, shape (B,).
            x: components of the states, each of shape (B,).
        """
        self._put(self.barrier[k], first, present, h)
        for j, component in enumerate(x):
            self._put(self.states[k, :, j], first, present, component)

    @staticmethod
    def _put(row: np.ndarray, first: int, present: np.ndarray, values: np.ndarray) -> None:
        room = row[first : first + len(present)]
        np.copyto(room, values[: len(room)], where=present[: len(room)])
