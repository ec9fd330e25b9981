"""Grids of nodes, between which values are interpolated."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class NodeGrid:
    """Equidistant nodes along some axes, of which the last one varies fastest.

    Attributes:
        low: first node along each axis.
        step: distance of the nodes.
        counts: number of nodes.
        periodic: whether the first node follows the last one.
    """

    low: tuple[float, ...]
    step: tuple[float, ...]
    counts: tuple[int, ...]
    periodic: tuple[bool, ...]

    @classmethod
    def over(
        cls,
        ends: Sequence[tuple[float, float]],
        counts: Sequence[int],
        periodic: Sequence[bool],
    ) -> NodeGrid:
        """Return a grid of so many nodes between two ends along each axis.

        Args:
            ends: first and last node; one turn apart where the axis is periodic.
            counts: number of nodes.
            periodic: whether the first node follows the last one.
        """
        steps = [
            (high - low) / (count if turns else count - 1)
            for (low, high), count, turns in zip(ends, counts, periodic, strict=True)
        ]
        return cls(tuple(a for a, _ in ends), tuple(steps), tuple(counts), tuple(periodic))

    @property
    def size(self) -> int:
        """Number of all nodes."""
        return int(np.prod(self.counts))

    def points(self, numbers: np.ndarray) -> list[np.ndarray]:
        """Return the coordinates of nodes, an array (B,) for each axis."""
        places = np.unravel_index(numbers, self.counts)
        return [
            low + step * place for low, step, place in zip(self.low, self.step, places, strict=True)
        ]

    def nearest(self, q: Sequence[np.ndarray]) -> np.ndarray:
        """Return the number of the node that is nearest to each point, shape (B,)."""
        places = []
        for values, low, step, count, turns in self._axes(q):
            place = np.rint((values - low) / step).astype(np.int64)
            places.append(place % count if turns else np.clip(place, 0, count - 1))
        return np.asarray(np.ravel_multi_index(places, self.counts))

    def corners(self, q: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes around points, and their shares in what is interpolated.

        Points beyond the ends of an axis are taken to its end.

        Args:
            q: an array (B,) for each axis.

        Returns:
            Numbers of nodes and their shares, shape (2^n, B) each.
        """
        sides = []
        for values, low, step, count, turns in self._axes(q):
            t = (values - low) / step
            t = t % count if turns else np.clip(t, 0.0, count - 1.0)
            first = np.minimum(t.astype(np.int64), count - 1 if turns else count - 2)
            share = t - first
            second = (first + 1) % count if turns else first + 1
            sides.append(((first, 1.0 - share), (second, share)))
        numbers, shares = [], []
        for corner in itertools.product(*sides):
            number = np.zeros(len(q[0]), dtype=np.int64)
            product = np.ones(len(q[0]))
            for (place, share), count in zip(corner, self.counts, strict=True):
                number = number * count + place
                product = product * share
            numbers.append(number)
            shares.append(product)
        return np.stack(numbers), np.stack(shares)

    def around(
        self, q: Sequence[np.ndarray], known: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return more nodes around points, and shares that are exact for cubic functions.

        Where such a node lies beyond the grid or is not known, the shares are those of `corners`.

        Args:
            q: an array (B,) for each axis.
            known: which nodes have values, shape (nodes,); None for all.

        Returns:
            Numbers of nodes and their shares, shape (4^n, B) each.
        """
        sides, linear = [], np.zeros(len(q[0]), dtype=bool)
        for values, low, step, count, turns in self._axes(q):
            t = (values - low) / step
            t = t % count if turns else np.clip(t, 0.0, count - 1.0)
            first = np.minimum(t.astype(np.int64), count - 1 if turns else count - 2)
            sides.append((first, t - first, count))
            if not turns:
                linear |= (first < 1) | (first > count - 3)
        number = np.zeros((1, len(q[0])), dtype=np.int64)
        for first, _, count in sides:
            places = np.stack([(first + j) % count for j in (-1, 0, 1, 2)])
            number = (number[:, None] * count + places).reshape(4 * len(number), -1)
        if known is not None:
            linear |= ~known[number].all(axis=0)
        share = np.ones((1, len(q[0])))
        for _, s, _ in sides:
            cubic = np.stack(
                [
                    -s * (s - 1.0) * (s - 2.0) / 6.0,
                    (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
                    -(s + 1.0) * s * (s - 2.0) / 2.0,
                    (s + 1.0) * s * (s - 1.0) / 6.0,
                ]
            )
            straight = np.stack([np.zeros_like(s), 1.0 - s, s, np.zeros_like(s)])
            own = np.where(linear, straight, cubic)
            share = (share[:, None] * own).reshape(4 * len(share), -1)
        return number, share

    def interpolated(self, table: np.ndarray, q: Sequence[np.ndarray]) -> np.ndarray:
        """Return values at points.

        Args:
            table: on the nodes, shape (nodes, ...).
            q: an array (B,) for each axis.

        Returns:
            Shape (B, ...).
        """
        return np.sum(
            [
                table[number] * share.reshape(-1, *[1] * (table.ndim - 1))
                for number, share in zip(*self.corners(q), strict=True)
            ],
            axis=0,
        )

    def around_marked(self, marked: np.ndarray) -> np.ndarray:
        """Return which nodes are marked or next to one that is, also across a corner.

        Args:
            marked: of all nodes, bool (nodes,).

        Returns:
            Of the same shape.
        """
        found = marked.reshape(self.counts)
        for axis, turns in enumerate(self.periodic):
            sides = [(1, 1) if i == axis else (0, 0) for i in range(found.ndim)]
            wide = np.moveaxis(np.pad(found, sides, "wrap" if turns else "constant"), axis, 0)
            found = np.moveaxis(wide[:-2] | wide[1:-1] | wide[2:], 0, axis)
        return found.ravel()

    def _axes(self, q: Sequence[np.ndarray]) -> zip[tuple[np.ndarray, float, float, int, bool]]:
        return zip(q, self.low, self.step, self.counts, self.periodic, strict=True)
