"""Episodes that can be resumed at each instant at which their height was a record."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from safe_envs.agents.rare_events.heights import Heights
from safe_envs.agents.rare_events.path_keys import PathKeys
from safe_envs.agents.rare_events.records import Records


class PathPlayer(Protocol):
    """Simulates paths; what comes of one depends on nothing but its key and its last record.

    Attributes:
        steps: control periods of an episode.
    """

    steps: int

    def starts(self, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the states, (B, n), and the barriers, (B, k), at the starts of paths.

        Args:
            keys: of the paths, uint64 (B,).
        """
        ...

    def play(
        self,
        paths: np.ndarray,
        keys: np.ndarray,
        heights: Heights,
        records: Records,
        length: float,
    ) -> np.ndarray:
        """Simulate paths from their only record until they end or violate, and add the others.

        Args:
            paths: their numbers, shape (B,).
            keys: of all paths, uint64.
            heights: of all paths.
            records: of all paths.
            length: of the drift, in 1/sqrt(s).

        Returns:
            The control instants at which they ended, shape (B,).
        """
        ...


class Particles:
    """Paths of a policy in an env, up to their first violations; see `Heights`.

    Args:
        player: simulates them.
        keys: gives each generation of a path a key.
        powers: p of the height of each path.
        length: of the drift of their noise, in 1/sqrt(s).

    Attributes:
        lowest: smallest height of each path, shape (paths,).
        steps: control periods that were simulated.
        outside: how many paths start where h <= 0.
        kept_length: mean length of the paths from the starts that do not violate, in control
            periods; None without any.
    """

    def __init__(
        self, player: PathPlayer, keys: PathKeys, powers: np.ndarray, length: float = 0.0
    ) -> None:
        self._player, self._keys, self._length = player, keys, length
        self._generation = 0
        count = len(powers)
        paths = np.arange(count)
        self.lowest = np.full(count, np.inf)
        self._now = keys.of(count, 0)
        states, barriers = player.starts(self._now)
        self._heights = Heights(powers, player.steps, barriers)
        self._records = Records(count, states.shape[1])
        # At the start the weight is 1.
        h = self._heights.relative(barriers)
        self.outside, self.steps = int(np.count_nonzero(h <= 0.0)), 0
        instants, ended = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=bool)
        integrals = np.zeros((count, 2))
        lengths = self._play(paths, (h, instants, ended, states, integrals))
        kept = lengths[self.lowest > 0.0]
        self.kept_length = float(kept.mean()) if kept.size else None

    def h_at_lowest(self, paths: np.ndarray) -> np.ndarray:
        """Return h of paths where their heights were smallest, shape as given.

        Of several barriers it is relative to the starts.
        """
        instants = self._records.last(paths)[1]
        return self.lowest[paths] / self._heights.weight(instants, paths)

    def girsanov_integrals(self, paths: np.ndarray) -> np.ndarray:
        """Return `girsanov_integrals` of paths where their heights were smallest, shape (B, 2)."""
        return self._records.last(paths)[4]

    def branch(self, paths: np.ndarray, parents: np.ndarray, levels: np.ndarray) -> None:
        """Replace paths by what goes on from where others of the same p first fell below levels.

        Each gets a key of its own, so that its noise is new.

        Args:
            paths: those that are replaced, shape (B,).
            parents: those that are continued, none of which is replaced, shape (B,).
            levels: heights, each above its parent's smallest, shape (B,).
        """
        self._generation += 1
        self._now = self._keys.of(len(self.lowest), self._generation)
        entries = self._records.first_below(levels, parents)
        self._records.keep(paths, 0)
        self._play(paths, entries)

    def _play(self, paths: np.ndarray, entries: tuple[np.ndarray, ...]) -> np.ndarray:
        """Simulate paths from entries of `Records.add`; return when they ended."""
        self._records.add(paths, *entries)
        ends = self._player.play(paths, self._now, self._heights, self._records, self._length)
        self.steps += int((ends - entries[1]).sum())
        self.lowest[paths] = self._records.last(paths)[0]
        return ends
