"""A few vectors of unit length as sums of an orthonormal basis, in plain floats.

Vectors that depend on those before them, up to rounding, add nothing to the basis. Then a step
cannot have any products with all of them: it has those that fit best, in weighted squares.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import mul

from safe_envs.wrappers.qp.rounding import Floats

_DEPENDENT = 1e-14
"""Part of a unit vector that the rounding of others leaves of it."""
_ENOUGH = 0.5
"""Part of a vector next to which the rounding of what the others take from it is none."""
_INDEPENDENT = 1e-8
"""Part of the entries of weighted vectors that surely is more than rounding."""


def orthonormal(
    vectors: Sequence[list[float]], least: float
) -> tuple[list[list[float]], list[list[float]]]:
    """Return an orthonormal basis, and the coordinates of each vector as far as they are not 0.

    Args:
        vectors: the vectors, of n entries.
        least: length of what is left of a vector that adds to the basis.
    """
    basis: list[list[float]] = []
    coordinates = []
    for vector in vectors:
        rest, shares = vector, []
        for e in basis:
            share = sum(map(mul, e, rest))
            rest = [x - share * y for x, y in zip(rest, e, strict=True)]
            shares.append(share)
        left = math.hypot(*rest)
        if basis and not left > _ENOUGH * math.hypot(*vector):
            for c, e in enumerate(basis):  # takes back the rounding of the first time
                share = sum(map(mul, e, rest))
                rest = [x - share * y for x, y in zip(rest, e, strict=True)]
                shares[c] += share
            left = math.hypot(*rest)
        if left > least:
            basis.append([x / left for x in rest])
            shares.append(left)
        coordinates.append(shares)
    return basis, coordinates


class LineSpan:
    """The span of one vector, or of numbers; as `RowSpan`.

    Args:
        vectors: one vector of n entries, or several of one.
        weights: roots of the weights of their squares.

    Attributes:
        dependent: whether there are several.
        inverse: what the products with the vectors count in the step, or in its entries.
    """

    def __init__(self, vectors: Sequence[list[float]], weights: Floats) -> None:
        self.dependent = len(vectors) > 1
        numbers = [vector[0] for vector in vectors] if self.dependent else vectors[0]
        pulls = numbers
        if self.dependent:
            largest = max(weights)
            pulls = [n * (w / largest) ** 2 for n, w in zip(numbers, weights, strict=True)]
        square = sum(map(mul, pulls, numbers))
        self.inverse = [pull / square for pull in pulls] if any(numbers) else numbers

    def step(self, products: Floats) -> list[float]:
        """Return the shortest step (n) that has given products with the vectors.

        Args:
            products: one for each vector.
        """
        if self.dependent:
            return [sum(map(mul, self.inverse, products))]
        (product,) = products
        return [product * part for part in self.inverse]

    def pressures(self, way: Floats) -> list[float]:
        """Return the least factors with which the vectors add up to the part of a way in the span.

        Args:
            way: n entries.
        """
        if self.dependent:
            (length,) = way
            return [length * part for part in self.inverse]
        return [sum(map(mul, self.inverse, way))]


class RowSpan:
    """The span of vectors.

    Args:
        vectors: the vectors, of n entries.
        weights: roots of the weights of their squares, where they depend on each other.

    Attributes:
        dependent: whether some depend on the others.
    """

    def __init__(self, vectors: Sequence[list[float]], weights: Floats) -> None:
        # More vectors than entries are fitted without a basis, if their entries are independent.
        self._basis: list[list[float]] = []
        self._direct = False
        self._size = len(vectors[0])
        self.dependent = self._size < len(vectors)
        if self.dependent:
            self._fit([*zip(*vectors, strict=True)], weights)
            self._direct = len(self._fits) == self._size
            if self._direct:
                return
        self._basis, self._coordinates = orthonormal(vectors, _DEPENDENT)
        rank = len(self._basis)
        self.dependent = rank < len(vectors)
        if self.dependent:
            columns = [
                [shares[c] if c < len(shares) else 0.0 for shares in self._coordinates]
                for c in range(rank)
            ]
            self._fit(columns, weights, -1.0)

    def _fit(
        self, columns: Sequence[Sequence[float]], weights: Floats, least: float = _INDEPENDENT
    ) -> None:
        largest = max(weights)
        self._weights = [weight / largest for weight in weights]
        weighted = [[*map(mul, self._weights, column)] for column in columns]
        self._fits, self._coordinates = orthonormal(weighted, least)

    def step(self, products: Floats) -> list[float]:
        """Return the shortest step (n) that has given products with the vectors.

        Args:
            products: one for each vector.
        """
        found: list[float] = []
        if self.dependent:
            scaled = [*map(mul, self._weights, products)]
            found = [sum(map(mul, e, scaled)) for e in self._fits]
            for c in range(len(found) - 1, -1, -1):
                shares = self._coordinates[c]
                found[c] /= shares[c]
                for d in range(c):
                    found[d] -= shares[d] * found[c]
            if self._direct:
                return found
        else:
            for shares, product in zip(self._coordinates, products, strict=True):
                found.append((product - sum(map(mul, found, shares))) / shares[-1])
        if not found:
            return [0.0] * self._size
        step = [found[0] * x for x in self._basis[0]]
        for c in range(1, len(found)):
            share = found[c]
            step = [x + share * y for x, y in zip(step, self._basis[c], strict=True)]
        return step

    def pressures(self, way: Floats) -> list[float]:
        """Return the least factors with which the vectors add up to the part of a way in the span.

        Args:
            way: n entries.
        """
        found = [*way] if self._direct else [sum(map(mul, e, way)) for e in self._basis]
        if not self.dependent:
            for i in range(len(found) - 1, -1, -1):
                shares = self._coordinates[i]
                found[i] /= shares[i]
                for c in range(i):
                    found[c] -= shares[c] * found[i]
            return found
        for c, shares in enumerate(self._coordinates):
            found[c] = (found[c] - sum(map(mul, found[:c], shares))) / shares[c]
        return [
            weight * sum([part * e[i] for part, e in zip(found, self._fits, strict=True)])
            for i, weight in enumerate(self._weights)
        ]
