"""Counter-based random numbers: streams of words, each given by a key, an episode and a purpose.

A stream needs no seeding, and any of its words is found without those before it. Word j is entry
j % 4 of the Philox 4x64-10 block with the counter (j // 4 + 1, episode, purpose, 0), all modulo
2**64, so that simulations by any backend draw the same numbers.

Source: Salmon, Moraes, Dror, Shaw: Parallel random numbers: as easy as 1, 2, 3. SC 2011.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.dynamics import normal_kernel as kernel
from safe_envs.errors import require_whole

NOISE = 0
START = 1
BRIDGE = 2
POLICY = 3
EPISODE = 4
# Keys of paths of rare events: see `safe_envs.agents.rare_events.splitting`.
PILOTS = 5
SPLIT = 6
DRIFTING = 7
SENSOR = 8

Key = tuple[int, int]
"""The two words of a key, each below 2**64."""

_WORD = 2**64 - 1
_LANES = 4
_EMPTY = (0, 0, 0, 0)
_FIRST_CHUNK, _CHUNK = 64, 256


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
        self._generator = np.random.Generator(np.random.Philox(key=0))
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
            purpose: `NOISE`, `START`, `BRIDGE`, `POLICY`, `EPISODE` or `SENSOR`.
            word: index of the word that is read next, from 0.
        """
        block, lane = divmod(word, _LANES)
        self._place["counter"] = (block, episode, purpose, 0)
        self._place["key"] = key
        self._generator.bit_generator.state = self._state  # pyright: ignore[reportAttributeAccessIssue]
        if lane:
            self.words(lane)
        return self

    def words(self, count: int) -> np.ndarray:
        """Return the next words, uint64 (count,)."""
        return self._generator.bit_generator.random_raw(count)

    def uniforms(self, shape: int | tuple[int, ...]) -> np.ndarray:
        """Return the uniforms (w >> 11) / 2**53 in [0, 1) of the next words, in C order."""
        return self._generator.random(shape)

    def fill(self, out: np.ndarray) -> None:
        """Write the uniforms of the next words to an array of doubles, which is contiguous."""
        self._generator.random(out=out)


class EpisodeUniforms:
    """Uniforms of the first episodes of seeds, side by side, which do not depend on each other.

    Args:
        seeds: of the episodes.
        purpose: of what is drawn.
        width: how many numbers a control period takes.
        periods: control period of each episode that comes next; None for the first of all.
    """

    def __init__(
        self,
        seeds: Sequence[int],
        purpose: int,
        width: int,
        periods: Sequence[int] | None = None,
    ) -> None:
        self._keys = [key_of(seed) for seed in seeds]
        self._periods = [0] * len(self._keys) if periods is None else periods
        self._purpose, self._width = purpose, width
        self._reader = StreamReader()
        self._chunk = np.empty((len(self._keys), 0, width))
        self._position = self._drawn = 0

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._keys)

    def next(self) -> np.ndarray:
        """Return the uniforms in [0, 1) of the next control period, shape (episodes, width)."""
        if self._position == self._chunk.shape[1]:
            self._draw()
        self._position += 1
        return self._chunk[:, self._position - 1]

    def _draw(self) -> None:
        # An episode that has lasted is likely to last: chunks grow with it.
        count = min(max(self._drawn, _FIRST_CHUNK), _CHUNK)
        self._chunk = np.empty((len(self._keys), count, self._width))
        for key, begin, out in zip(self._keys, self._periods, self._chunk, strict=True):
            word = (begin + self._drawn) * self._width
            self._reader.seek(key, 0, self._purpose, word).fill(out)
        self._drawn += count
        self._position = 0


def episode_seeds(seed: int, episodes: range) -> list[int]:
    """Return the seeds of the envs in consecutive episodes of an evaluation.

    Args:
        seed: of the evaluation.
        episodes: their numbers.

    Returns:
        Whole numbers below 2**64. That of episode i is word 4 i of the stream `EPISODE`.
    """
    reader = StreamReader().seek(key_of(seed), 0, EPISODE, _LANES * episodes.start)
    return reader.words(_LANES * len(episodes))[::_LANES].tolist()


_PIECE = 16384
"""Numbers to compute at a time: so many, with all that is computed on the way, fit the cache."""

_Pairs = tuple[np.ndarray, ...]
"""Coefficients of two polynomials, each pair (2, 1), the highest power first."""


def _coefficients(above: str, below: str) -> _Pairs:
    tops = [getattr(kernel, f"{above}{i}") for i in range(7, -1, -1)]
    lows = [*(getattr(kernel, f"{below}{i}") for i in range(7, 0, -1)), 1.0]
    return tuple(np.array(pair)[:, None] for pair in zip(tops, lows, strict=True))


_CENTRAL, _NEAR, _FAR = _coefficients("A", "B"), _coefficients("C", "D"), _coefficients("E", "F")


def standard_normals(uniforms: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Return the standard normal numbers of uniforms of `StreamReader`.

    Args:
        uniforms: in [0, 1), of any shape.
        out: contiguous array of the same shape for the result, which may be `uniforms` itself; None
            for a new one.
    """
    found = np.empty(np.shape(uniforms)) if out is None else out
    np.subtract(uniforms, 0.5, out=found)
    flat = found.reshape(-1)
    work = np.empty((2, min(flat.size, _PIECE)))
    for first in range(0, flat.size, _PIECE):
        piece = flat[first : first + _PIECE]
        _invert(piece, work[:, : piece.size])
    return found


def standard_exponentials(uniforms: np.ndarray) -> np.ndarray:
    """Return the standard exponentials of uniforms of `StreamReader`, in [0, 1); same shape."""
    found = np.log(uniforms + kernel.HALF_STEP)
    return np.negative(found, out=found)


def _invert(q: np.ndarray, work: np.ndarray) -> None:
    """Put the normal numbers of U - 1/2 in place of them; `work` is of shape (2, q.size)."""
    q += kernel.HALF_STEP
    distance = np.abs(q)
    tails = np.flatnonzero(distance > kernel.CENTRAL)
    signed, distance = q[tails], distance[tails]
    r = q * q
    np.subtract(kernel.CENTRAL_SQUARE, r, out=r)
    # The central function has poles in the tails, which get values of their own below.
    np.maximum(r, 0.0, out=r)
    q *= _quotient(_CENTRAL, r, work)
    found = _tail(distance)
    q[tails] = np.copysign(found, signed, out=found)


def _tail(distance: np.ndarray) -> np.ndarray:
    """Return the normal numbers of the uniforms that lie above 1/2 by so much."""
    r = np.subtract(0.5, distance)
    np.log(r, out=r)
    np.negative(r, out=r)
    np.sqrt(r, out=r)
    far = np.flatnonzero(r > kernel.NEAR_END)
    beyond = r[far] - kernel.FAR_SHIFT
    r -= kernel.NEAR_SHIFT
    found = _quotient(_NEAR, r, np.empty((2, r.size)))
    if far.size:
        found[far] = _quotient(_FAR, beyond, np.empty((2, far.size)))
    return found


def _quotient(pairs: _Pairs, r: np.ndarray, work: np.ndarray) -> np.ndarray:
    """Return the quotient of a pair of polynomials in r, computed in `work` (2, r.size)."""
    np.multiply(pairs[0], r, out=work)
    for pair in pairs[1:-1]:
        work += pair
        work *= r
    work += pairs[-1]
    return np.divide(work[0], work[1], out=work[0])
