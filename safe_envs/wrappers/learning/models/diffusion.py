"""The covariance of the noise, from which with a known drift every generator follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.wrappers.learning.data.values import array_of
from safe_envs.wrappers.learning.models.features import Features

_SINGULAR = 1e-12
"""Least eigenvalue of a constant covariance, as part of the largest one: what is below cannot be
told from rounding."""


@dataclass(frozen=True, eq=False)
class Entry:
    """An entry of the covariance, and of its mirror image, that is not zero everywhere.

    Attributes:
        row: its index i.
        column: its index j >= i.
        features: on which it was regressed.
        weights: of the features, shape (M,), in units of x_i x_j per s.
    """

    row: int
    column: int
    features: Features
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class LearnedDiffusion:
    """C(x) = sigma sigma', each entry a polynomial of degree 0 to 2 in the scaled states.

    A regression knows no signs: where an entry of the diagonal is near 0 it may come out slightly
    negative. Generators only contain C itself, so that nothing is made of that; but see `system`.

    Attributes:
        states: n symbols.
        entries: those that are not zero.
    """

    states: tuple[sp.Symbol, ...]
    entries: tuple[Entry, ...]

    @cached_property
    def covariance(self) -> sp.ImmutableMatrix:
        """C, n x n expressions of the states."""
        matrix = sp.zeros(len(self.states))
        for entry in self.entries:
            matrix[entry.row, entry.column] = matrix[entry.column, entry.row] = (
                entry.features.combined(entry.weights.tolist())
            )
        return sp.ImmutableMatrix(matrix)

    def system(self, model: ControlAffineSDE) -> ControlAffineSDE:
        """Return the model with a diffusion L for which L L' = C.

        L is a Cholesky factor in symbols, whose roots cancel in L L': `ito_correction`, and with it
        every generator, sees the polynomials themselves. To evaluate L is another matter: where the
        regressed C is not positive definite, its roots have no real value. A constant C is
        projected to a positive semidefinite one first.

        Args:
            model: with the same states; its own diffusion is ignored.
        """
        matrix = self.covariance
        factor = _cholesky(matrix if matrix.free_symbols else _projected(matrix))
        live = [j for j in range(factor.cols) if factor[j, j] != 0]
        return replace(model, diffusion=factor[:, live] if live else sp.zeros(model.n, 1))

    def details(self) -> list[dict[str, Any]]:
        """Return all but the weights, for JSON."""
        return [{"row": e.row, "column": e.column, **e.features.details()} for e in self.entries]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the weights by name."""
        return {_name(e.row, e.column): e.weights for e in self.entries}

    @classmethod
    def restored(
        cls,
        states: tuple[sp.Symbol, ...],
        details: Sequence[Mapping[str, Any]],
        arrays: Mapping[str, np.ndarray],
    ) -> LearnedDiffusion:
        """Make it again of what `details` and `to_arrays` gave.

        Args:
            states: n symbols.
            details: see `details`.
            arrays: see `to_arrays`.

        Raises:
            KeyError: a part is missing.
            ValueError: the parts do not fit.
        """
        entries, places = [], {(i, j) for j in range(len(states)) for i in range(j + 1)}
        for d in details:
            # Each place once.
            places.remove((d["row"], d["column"]))
            features = Features.restored(states, d)
            weights = array_of(arrays, _name(d["row"], d["column"]), (features.count,))
            entries.append(Entry(int(d["row"]), int(d["column"]), features, weights))
        return cls(states, tuple(entries))


def _projected(matrix: sp.ImmutableMatrix) -> sp.ImmutableMatrix:
    """Return the nearest positive semidefinite matrix of numbers, with positive pivots or 0."""
    numbers = np.array(matrix, dtype=float)
    live = np.flatnonzero(numbers.diagonal())
    values, vectors = np.linalg.eigh(numbers[np.ix_(live, live)])
    if not len(live) or values[0] >= _SINGULAR * values[-1]:
        return matrix
    numbers[np.ix_(live, live)] = vectors * np.maximum(values, _SINGULAR * values[-1]) @ vectors.T
    return sp.ImmutableMatrix(numbers.tolist())


def _cholesky(matrix: Any) -> sp.ImmutableMatrix:
    """Lower triangular L with L L' = C, in symbols; a state without noise has an empty column."""
    n = matrix.rows
    factor: Any = sp.zeros(n)
    for j in range(n):
        pivot = matrix[j, j] - sum(factor[j, k] ** 2 for k in range(j))
        if pivot == 0:
            continue
        factor[j, j] = sp.sqrt(pivot)
        for i in range(j + 1, n):
            factor[i, j] = (
                matrix[i, j] - sum(factor[i, k] * factor[j, k] for k in range(j))
            ) / factor[j, j]
    return sp.ImmutableMatrix(factor)


def _name(row: int, column: int) -> str:
    return f"covariance_{row}_{column}"
