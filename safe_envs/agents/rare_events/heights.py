"""How far paths are from a violation."""

from __future__ import annotations

import numpy as np


class Heights:
    """The heights of paths.

    The height of a path at control instant k of K is its smallest h since the last one, times (1 -
    k/(K + 1))^-p: for p = 0 that is h, and for p = 1/2 it is h against what a Brownian motion may
    do in the time that is left. It is 0 or less at a violation. Of several barriers, which may have
    units of their own, each is divided by its mean at the starts.

    Args:
        powers: p of each path.
        steps: K.
        barriers: at the starts, shape (paths, k).

    Attributes:
        kinds: column of `weights` for each path, int64 (paths,).
        weights: (1 - k/(K + 1))^-p for each control instant, (K + 1, kinds).
        units: of the barriers, (k,).
    """

    def __init__(self, powers: np.ndarray, steps: int, barriers: np.ndarray) -> None:
        different, self.kinds = np.unique(powers, return_inverse=True)
        left = 1.0 - np.arange(steps + 1) / (steps + 1)
        self.weights = left[:, None] ** -different
        self.units = np.ones(barriers.shape[1])
        if len(self.units) > 1:
            at_start = barriers.mean(axis=0)
            self.units = np.where(at_start > 0.0, at_start, 1.0)

    def relative(self, barriers: np.ndarray) -> np.ndarray:
        """Return the smallest of the barriers, relative to their units: (B,) for (B, k)."""
        shares = barriers / self.units
        return shares[:, 0] if shares.shape[1] == 1 else shares.min(axis=1)

    def weight(self, instants: np.ndarray, paths: np.ndarray) -> np.ndarray:
        """Return what the smallest barriers of paths at control instants are multiplied by.

        Args:
            instants: at most K, shape (B,).
            paths: shape (B,).
        """
        return self.weights[instants, self.kinds[paths]]
