"""The noise of paths that begin in different control periods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.normal import standard_normals
from safe_envs.dynamics.philox import NOISE
from safe_envs.envs.seeding import EpisodeStreams

_FIRST_CHUNK, _CHUNK = 64, 256


class PathNoise:
    """The standard normals of a batch in which each env plays one episode, or the rest of one.

    It takes the place of `safe_envs.envs.noise.NoiseStreams`, which is for envs that go on with
    further episodes. Here those have no noise: nobody looks at them.

    Args:
        streams: of the envs.
        channels: numbers in a control period.
        periods: of an episode.
    """

    def __init__(self, streams: EpisodeStreams, channels: int, periods: int) -> None:
        self._streams, self._channels, self._periods = streams, channels, periods
        self._begun = np.zeros(streams.num_envs, dtype=np.int64)
        self._over = np.zeros(streams.num_envs, dtype=bool)
        self._restart()

    def seek(self, envs: Sequence[int] | np.ndarray, periods: Any = 0) -> None:
        """Go to a control period of new streams of some envs.

        Args:
            envs: their indices.
            periods: the control period of each, or of all.
        """
        self._begun += self._passed
        self._begun[envs], self._over[envs] = periods, False
        self._restart()

    def begin(self, envs: np.ndarray) -> None:
        """Begin the next episodes of some envs, given by their indices."""
        later = self._streams.episodes[envs] > 0
        self._over[envs[later]] = True
        if not later.all():
            self.seek(envs[~later])

    def next(self, stepping: np.ndarray | None) -> np.ndarray:
        """Return the draws of the next control period, shape (channels, num_envs).

        Args:
            stepping: of no meaning here.
        """
        if not self._channels:
            return self._chunk.reshape(0, self._streams.num_envs)
        if self._position == self._chunk.shape[1]:
            self._draw()
        self._position += 1
        self._passed += 1
        return self._chunk[:, self._position - 1].T

    def _restart(self) -> None:
        self._passed = self._position = 0
        self._chunk = np.empty((self._streams.num_envs, 0, self._channels))

    def _draw(self) -> None:
        """Draw ahead for the envs whose episodes are not over."""
        periods = self._begun + self._passed
        left = np.where(self._over, 0, np.maximum(self._periods - periods, 0))
        # An episode that has lasted is likely to last: chunks grow with it.
        count = min(max(self._passed, _FIRST_CHUNK), _CHUNK)
        most = max(int(left.max()), 1)
        count = most if most <= 2 * count else count
        envs = np.flatnonzero(left)
        # The normal number of 1/2 is next to 0.
        drawn = np.full((len(envs), count, self._channels), 0.5)
        words, ends = periods[envs] * self._channels, np.minimum(left[envs], count)
        for i, word, end, out in zip(
            envs.tolist(), words.tolist(), ends.tolist(), drawn, strict=True
        ):
            self._streams.reader.seek(self._streams.keys[i], 0, NOISE, word).fill(out[:end])
        self._chunk = np.zeros((self._streams.num_envs, count, self._channels))
        self._chunk[envs] = standard_normals(drawn, out=drawn)
        self._position = 0
