"""Which episodes are safe, in one bit for each."""

from __future__ import annotations

import numpy as np


class SafeFlags:
    """Which of consecutive episodes are safe, in their order.

    It is all that is always kept of a single episode, to count the pairs of two filters: 1.25 MB
    for 10,000,000 episodes.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._rest = np.empty(0, dtype=bool)

    @classmethod
    def of(cls, safe: np.ndarray) -> SafeFlags:
        """Return the flags of an array of booleans, shape (E,)."""
        found = cls()
        found.add(safe)
        return found

    def add(self, safe: np.ndarray) -> None:
        """Add the episodes that follow, shape (B,)."""
        bits = np.concatenate((self._rest, safe))
        whole = len(bits) - len(bits) % 8
        self._bytes += np.packbits(bits[:whole]).tobytes()
        # A view would keep all of the bits.
        self._rest = bits[whole:].copy()

    def __len__(self) -> int:
        return 8 * len(self._bytes) + len(self._rest)

    @property
    def packed(self) -> np.ndarray:
        """The flags as bits of bytes, of which those past the last episode are 0."""
        return np.concatenate(
            (np.frombuffer(bytes(self._bytes), dtype=np.uint8), np.packbits(self._rest))
        )

    @property
    def array(self) -> np.ndarray:
        """The flags as booleans, shape (E,)."""
        return np.unpackbits(self.packed, count=len(self)).astype(bool)
