"""The standard normal numbers that drive an episode, drawn ahead."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.noise import NOISE, Key, StreamReader, standard_normals
from safe_envs.envs.starts import EpisodeStreams

_CHUNK = 256
_FIRST_CHUNK = 64
_AHEAD = 32
"""Control periods before their end at which chunks may be renewed together with others."""

_OTHERS = 16
"""Envs without an ended episode to draw ahead for at a time: it takes as long as the call does."""


class NoiseStream:
    """Standard normal numbers of one env, drawn ahead in chunks.

    Args:
        channels: numbers in a control period.
        periods: of an episode; nothing is drawn ahead for more.
        purpose: of the stream, see `safe_envs.dynamics.noise`.
    """

    def __init__(self, channels: int, periods: int, purpose: int = NOISE) -> None:
        self._channels, self._periods, self._purpose = channels, periods, purpose
        self._reader = StreamReader()
        self.begin((0, 0), 0)

    def begin(self, key: Key, episode: int, period: int = 0) -> None:
        """Go to a control period of an episode.

        Args:
            key: of the seed.
            episode: its number since the seed.
            period: of the episode, the first one by default.
        """
        self._key, self._episode, self._drawn = key, episode, period
        self._rows: list[list[float]] = []
        self._position = 0

    def next(self) -> list[float]:
        """Return the draws of the next control period."""
        if not self._channels:
            return []
        if self._position == len(self._rows):
            self._draw()
        self._position += 1
        return self._rows[self._position - 1]

    def _draw(self) -> None:
        left = self._periods - self._drawn
        count = min(left, _CHUNK) if left > 0 else _CHUNK
        self._reader.seek(self._key, self._episode, self._purpose, self._drawn * self._channels)
        uniforms = self._reader.uniforms((count, self._channels))
        self._rows = standard_normals(uniforms, out=uniforms).tolist()
        self._position = 0
        self._drawn += count


class NoiseStreams:
    """Standard normal numbers of a batch: each env has its own stream.

    Computing few numbers takes nearly as long as computing thousands. Hence envs whose episodes are
    not in step draw ahead together: what they soon need, and the beginning of their next episode.

    Args:
        streams: of the envs.
        channels: numbers in a control period.
        periods: of an episode; nothing is drawn ahead for more.
        purpose: of the streams, see `safe_envs.dynamics.noise`.
    """

    def __init__(
        self, streams: EpisodeStreams, channels: int, periods: int, purpose: int = NOISE
    ) -> None:
        self._streams, self._channels, self._periods = streams, channels, periods
        self._purpose = purpose
        self._chunk = min(_CHUNK, periods)
        # Env i has the slots 2 i and 2 i + 1, one for its episode and one for the beginning of the
        # next; what a slot holds stands at its end.
        n = streams.num_envs
        self._make_room()
        self._slot = 2 * np.arange(n)
        self._row = (self._slot + 1) * self._chunk
        self._end = self._row.copy()
        self._drawn = np.zeros(n, dtype=np.int64)
        self._ahead = np.zeros(n, dtype=np.int64)
        self._before_refill = 0

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without what was drawn ahead, which a copy draws itself."""
        kept = {name: each for name, each in vars(self).items() if name not in ("_buffer", "_rows")}
        return {**kept, "_drawn": self._drawn - (self._end - self._row)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make_room()
        self.seek(np.arange(self._streams.num_envs), self._drawn)

    def _make_room(self) -> None:
        self._buffer = np.empty((2 * self._streams.num_envs, self._chunk, self._channels))
        self._rows = self._buffer.reshape(len(self._buffer) * self._chunk, self._channels)

    def seek(self, envs: Sequence[int] | np.ndarray, periods: np.ndarray) -> None:
        """Go to a control period of the episodes of some envs.

        Args:
            envs: their indices.
            periods: the control period of each.
        """
        self._row[envs] = self._end[envs]
        self._drawn[envs] = periods
        self._ahead[envs] = 0
        self._before_refill = 0

    def begin(self, envs: np.ndarray) -> None:
        """Begin the next episodes of some envs, given by their indices."""
        if not self._channels:
            return
        # What was drawn ahead before a seed is of another stream.
        ahead = np.where(self._streams.episodes[envs] > 0, self._ahead[envs], 0)
        slot = self._slot[envs] ^ 1
        end = (slot + 1) * self._chunk
        self._slot[envs] = slot
        self._end[envs] = end
        self._row[envs] = end - ahead
        self._drawn[envs] = ahead
        self._ahead[envs] = 0
        self._before_refill = min(self._before_refill, int(ahead.min()))

    def next(self, stepping: np.ndarray | None) -> np.ndarray:
        """Return the draws of the next control period, shape (channels, num_envs).

        Args:
            stepping: the envs whose stream moves on; None for all. The others get draws that are to
                be ignored.
        """
        if not self._channels:
            return self._rows.T[:0]
        if not self._before_refill:
            self._refill(stepping)
        self._before_refill -= 1
        draws = self._rows.take(
            self._row if stepping is None else np.where(stepping, self._row, 0), axis=0
        ).T
        self._row += 1 if stepping is None else stepping
        return draws

    def _refill(self, stepping: np.ndarray | None) -> None:
        left = self._end - self._row
        moving = True if stepping is None else stepping
        used_up = (left == 0) & moving
        if np.count_nonzero(used_up):
            soon = (left <= _AHEAD) & (self._drawn < self._periods) & moving
            self._draw(np.flatnonzero(used_up | soon), self._later(), left)
            left = self._end - self._row
        self._before_refill = max(int(left.min()), 1)

    def _later(self) -> np.ndarray:
        """Return the envs for whose next episodes to draw too, if episodes end at all."""
        missing, restarted = self._ahead == 0, self._streams.episodes > 0
        others = np.flatnonzero(missing & ~restarted)[:_OTHERS]
        later = np.flatnonzero(missing & restarted)
        return np.concatenate([later, others]) if later.size else later

    def _draw(self, now: np.ndarray, later: np.ndarray, left: np.ndarray) -> None:
        """Draw for some envs."""
        n, envs, nothing = len(now), np.concatenate([now, later]), np.zeros_like(later)
        drawn = np.concatenate([self._drawn[now], nothing])
        kept = np.concatenate([left[now], nothing])
        counts = self._counts(drawn, kept)
        episodes, slots = self._streams.episodes[envs], self._slot[envs]
        episodes[n:] += 1
        slots[n:] ^= 1
        normals = self._normals(envs, episodes, drawn, counts)
        first = 0
        for i, count, rest in zip(
            slots[:n].tolist(), counts[:n].tolist(), kept[:n].tolist(), strict=True
        ):
            slot, new = self._buffer[i], self._chunk - count
            if rest:
                slot[new - rest : new] = slot[-rest:]
            slot[new:] = normals[first : first + count]
            first += count
        self._row[now] -= counts[:n]
        self._drawn[now] += counts[:n]
        if later.size:
            count = int(counts[n])
            ahead = normals[first:].reshape(len(later), count, self._channels)
            self._buffer[slots[n:], -count:] = ahead
            self._ahead[later] = count

    def _counts(self, drawn: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Return for how many control periods to draw, after some and with some that are left."""
        to_come = self._periods - drawn
        # An episode that has lasted is likely to last: chunks grow with it.
        counts = np.clip(drawn, _FIRST_CHUNK, self._chunk)
        counts = np.where(to_come <= 2 * counts, to_come, counts)
        return np.minimum(np.where(to_come > 0, counts, self._chunk), self._chunk - left)

    def _normals(
        self, envs: np.ndarray, episodes: np.ndarray, periods: np.ndarray, counts: np.ndarray
    ) -> np.ndarray:
        """Return the numbers of some control periods of each env, one after the other."""
        found = np.empty((int(counts.sum()), self._channels))
        keys, reader = self._streams.keys, self._streams.reader
        first, words = 0, (periods * self._channels).tolist()
        for i, episode, word, count in zip(
            envs.tolist(), episodes.tolist(), words, counts.tolist(), strict=True
        ):
            reader.seek(keys[i], episode, self._purpose, word).fill(found[first : first + count])
            first += count
        return standard_normals(found, out=found)
