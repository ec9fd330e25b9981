"""A box of states: the part of the state space that is searched."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Region:
    """A box of states.

    Attributes:
        low: lower ends, shape (n,).
        high: upper ends, shape (n,).
        periodic: the states of which the box holds a whole period, shape (n,).
        assumed: the states whose range was assumed, since the workspace is unbounded, shape
            (n,).
        notes: which of the ranges are not the workspace, in words.
    """

    low: np.ndarray
    high: np.ndarray
    periodic: np.ndarray
    assumed: np.ndarray
    notes: tuple[str, ...] = ()

    def scaled(self, factor: float) -> Region:
        """Return the box that is larger by a factor about the same centre; a period stays one."""
        half = np.where(self.periodic, 1.0, factor) * (self.high - self.low) / 2.0
        center = (self.high + self.low) / 2.0
        return replace(self, low=center - half, high=center + half)

    def within(self, low: np.ndarray, high: np.ndarray) -> Region:
        """Return the part of the box between ends.

        Args:
            low: lower ends, shape (n,); may be infinite.
            high: upper ends, shape (n,); may be infinite.
        """
        return replace(self, low=np.maximum(self.low, low), high=np.minimum(self.high, high))

    def around(self, points: np.ndarray, widened: float) -> Region:
        """Return the part of the box around points.

        Args:
            points: states, shape (B, n).
            widened: factor by which it is wider than they are.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        more = (widened - 1.0) * (high - low) / 2.0 + 1e-6 * (self.high - self.low)
        return replace(
            self, low=np.maximum(self.low, low - more), high=np.minimum(self.high, high + more)
        )

    def inside(self, x: np.ndarray) -> np.ndarray:
        """Return states (B, n) moved into the box, by whole periods or to its nearest end."""
        clipped = x.clip(self.low, self.high)
        if not self.periodic.any():
            return clipped
        return np.where(self.periodic, self.low + (x - self.low) % (self.high - self.low), clipped)

    def draw(self, log2: int, rng: np.random.Generator) -> np.ndarray:
        """Draw points that fill the box evenly: a Sobol sequence, shifted at random.

        Args:
            log2: binary logarithm of their number.
            rng: of the shift.

        Returns:
            States, shape (2^log2, n).
        """
        from scipy.stats import qmc

        unit = qmc.Sobol(len(self.low), scramble=False).random_base2(log2)
        return self.low + (self.high - self.low) * ((unit + rng.random(len(self.low))) % 1.0)
