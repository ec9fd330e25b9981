"""The instants at which paths can be taken up again."""

from __future__ import annotations

import numpy as np

FIRST_ROOM = 64


class Records:
    """The instants at which each path was nearer to a violation than ever before.

    Arrays grow as they fill.

    Args:
        paths: how many.
        states: entries of a state.

    Attributes:
        count: records of each path, int64 (paths,).
        heights: of the records, (paths, room); minus infinity where there is none.
        instants: control instants, int64 (paths, room).
        ended: whether the episode ended there, bool (paths, room).
        states: (paths, room, states).
        integrals: `TiltedNoiseEnv.girsanov_integrals`, (paths, room, 2).
    """

    def __init__(self, paths: int, states: int) -> None:
        self.count = np.zeros(paths, dtype=np.int64)
        shape = (paths, FIRST_ROOM)
        self.heights = np.full(shape, -np.inf)
        self.instants = np.zeros(shape, dtype=np.int64)
        self.ended = np.zeros(shape, dtype=bool)
        self.states = np.zeros((*shape, states))
        self.integrals = np.zeros((*shape, 2))

    @property
    def room(self) -> int:
        """How many records of a path there is room for."""
        return self.heights.shape[1]

    def keep(self, paths: np.ndarray, count: int) -> None:
        """Forget all but the first records of some paths.

        Args:
            paths: which.
            count: of the records that each keeps.
        """
        self.count[paths] = count
        self.heights[paths, count:] = -np.inf

    def add(self, paths: np.ndarray, *entries: np.ndarray) -> None:
        """Note a record of each of some paths.

        Args:
            paths: which.
            *entries: height, control instant, whether the episode ended there, state, and
              `TiltedNoiseEnv.girsanov_integrals`.
        """
        rows = self.count[paths]
        if rows.size and int(rows.max()) == self.room:
            self.grow()
        for kept, values in zip(self._all(), entries, strict=True):
            kept[paths, rows] = values
        self.count[paths] += 1

    def first_below(self, levels: np.ndarray, paths: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the first records of paths below levels, as the arguments of `add`.

        Args:
            levels: heights, shape (B,).
            paths: shape (B,).
        """
        # Records fall along a row, and what was not filled is lower than all.
        rows = (self.heights[paths] >= levels[:, None]).sum(axis=1)
        return tuple(kept[paths, rows] for kept in self._all())

    def last(self, paths: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the last records of paths, in the order of the arguments of `add`."""
        rows = self.count[paths] - 1
        return tuple(kept[paths, rows] for kept in self._all())

    def grow(self) -> None:
        """Double the room."""
        heights, *others = self._all()
        self.heights = np.concatenate([heights, np.full_like(heights, -np.inf)], axis=1)
        self.instants, self.ended, self.states, self.integrals = (
            np.concatenate([old, np.zeros_like(old)], axis=1) for old in others
        )

    def _all(self) -> tuple[np.ndarray, ...]:
        return (
            self.heights,
            self.instants,
            self.ended,
            self.states,
            self.integrals,
        )
