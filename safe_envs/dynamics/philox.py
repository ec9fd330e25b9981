"""Counter-based random numbers: streams of words, each given by a key, an episode and a purpose.

A stream needs no seeding, and any of its words is found without those before it. Word j is entry
j % 4 of the Philox 4x64-10 block with the counter (j // 4 + 1, episode, purpose, 0), all modulo
2**64, so that simulations by any backend draw the same numbers.

Source: Salmon, Moraes, Dror, Shaw: Parallel random numbers: as easy as 1, 2, 3. SC 2011.
"""

from __future__ import annotations

import numpy as np

from safe_envs.errors import require_whole

NOISE = 0
START = 1
BRIDGE = 2
POLICY = 3
EPISODE = 4

Key = tuple[int, int]
"""The two words of a key, each below 2**64."""

_WORD = 2**64 - 1
_LANES = 4
_EMPTY = (0, 0, 0, 0)


def key_of(seed: int) -> Key:
    """Return the key of a seed; seeds below 2**128 have keys of their own.

    Raises:
        ConfigurationError: The seed is no whole number from 0.
    """
    require_whole("seed", seed, 0)
    seed = int(seed)
    if seed >> 128:
        low, high = np.random.SeedSequence(seed).generate_state(2, np.uint64).tolist()
        return low, high
    return seed & _WORD, seed >> 64


class StreamReader:
    """Reads words of streams, wherever they are.

    It is not safe to be shared by threads.
    """

    def __init__(self) -> None:
        self._bits = np.random.Philox(key=0)
        self._generator = np.random.Generator(self._bits)
        self._place: dict[str, tuple[int, ...]] = {}
        # NumPy counts up before it computes a block, and an empty buffer makes it do so.
        self._state = {
            "bit_generator": "Philox",
            "state": self._place,
            "buffer": _EMPTY,
            "buffer_pos": _LANES,
            "has_uint32": 0,
            "uinteger": 0,
        }

    def seek(self, key: Key, episode: int, purpose: int, word: int = 0) -> StreamReader:
        """Go to a word of a stream; return the reader.

        Args:
            key: of the seed, see `key_of`.
            episode: its number, from 0.
            purpose: `NOISE`, `START`, `BRIDGE`, `POLICY` or `EPISODE`.
            word: index of the word that is read next, from 0.
        """
        block, lane = divmod(word, _LANES)
        self._place["counter"] = (block, episode, purpose, 0)
        self._place["key"] = key
        self._bits.state = self._state
        if lane:
            self._bits.random_raw(lane, output=False)
        return self

    def words(self, count: int) -> np.ndarray:
        """Return the next words, uint64 (count,)."""
        return self._bits.random_raw(count)

    def uniforms(self, shape: int | tuple[int, ...]) -> np.ndarray:
        """Return the uniforms (w >> 11) / 2**53 in [0, 1) of the next words, in C order."""
        return self._generator.random(shape)

    def fill(self, out: np.ndarray) -> None:
        """Write the uniforms of the next words to an array of doubles, which is contiguous."""
        self._generator.random(out=out)
