"""The covariance of the noise, from which with a known drift every generator follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.checks import Purpose, random_stream
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.drift_checks import rounding
from safe_envs.wrappers.learning.estimators import by_parts
from safe_envs.wrappers.learning.models.features import Features
from safe_envs.wrappers.learning.models.values import array_of

_DEGREES = (0, 1, 2)
_HELD_OUT = 0.2
_FEWEST_STARTS = 5
_SINGULAR = 1e-12
"""Least eigenvalue of a constant covariance, as part of the largest one: what is below cannot be
told from rounding."""

_EXACT = 1e-12


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

    @classmethod
    def learn(
        cls,
        problem: SafetyProblem,
        data: Transitions,
        rate: np.ndarray,
        allowed: np.ndarray | float = 0.0,
    ) -> tuple[LearnedDiffusion, dict[str, float]]:
        """Regress the covariances by least squares, with the degree of least BIC.

        Args:
            problem: over whose region the features are scaled.
            data: transitions under any inputs; one from each point is enough where there are many
                points.
            rate: f(x) + g(x) u at each point, or its mean over the steps, shape (P, n); see
                `safe_envs.wrappers.learning.estimators`.
            allowed: residual of each state, shape (n,), that is no noise where data do not repeat;
                see `slack` there.

        Returns:
            What was learned from all points; and by name, for each entry that is not zero, the root
            mean square error of a regression on 80 % of the start states at the others, empty where
            there are less than five. It contains the error of the covariances there, sqrt(2/(K -
            1)) of a diagonal entry.

        Source: thesis Sec. 5.3 learns from the same data a term of a single barrier's generator.
        """
        found = covariances(data, rate)
        small = rounding(data, rate) + (allowed if data.repetitions == 1 else 0.0)
        noisy = found.diagonal(axis1=1, axis2=2).max(axis=0) > small**2 / data.dt.min()
        pairs = [
            (i, j) for i in range(len(noisy)) for j in range(i, len(noisy)) if noisy[i] and noisy[j]
        ]
        designs = _designs(problem, data.x)
        fits = {(i, j): _fit(designs, found[:, i, j], may_vanish=i != j) for i, j in pairs}
        entries = tuple(Entry(i, j, *fit) for (i, j), fit in fits.items() if fit is not None)
        return cls(problem.plant.states, entries), _held_out_errors(problem, data, found, entries)

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
        """All but the weights, for JSON."""
        return [
            {
                "row": e.row,
                "column": e.column,
                "degree": e.features.degree,
                "region": e.features.region,
                "angles": e.features.angles,
            }
            for e in self.entries
        ]

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
            features = Features.from_json(states, d["region"], d["degree"], d["angles"])
            weights = array_of(arrays, _name(d["row"], d["column"]), (features.count,))
            entries.append(Entry(int(d["row"]), int(d["column"]), features, weights))
        return cls(states, tuple(entries))


def covariances(data: Transitions, rate: np.ndarray) -> np.ndarray:
    """Estimates of sigma sigma' at each point, free of bias for Euler-Maruyama steps.

    With repetitions they are the covariances of the sample, over dt: whatever the drift is, and
    however a step without noise was integrated, is not taken for noise. A single successor leaves r
    r'/dt with the residual r = x' - x - (f + g u) dt, to which an error e of the known drift adds e
    e' dt.

    Args:
        data: transitions under any inputs.
        rate: f(x) + g(x) u at each point, or its mean over the steps, shape (P, n).

    Returns:
        Shape (P, n, n), in units of the states' products per s.
    """
    expected = (data.x + rate * data.dt[:, None]).T
    found = np.empty((data.points, len(expected), len(expected)))
    more = data.repetitions - 1
    for part, successors in by_parts(data):
        means = [after.mean(axis=1) for after in successors] if more else expected[:, part]
        residuals = [after - mean[:, None] for after, mean in zip(successors, means, strict=True)]
        scale = data.dt[part] * max(more, 1)
        for i, first in enumerate(residuals):
            for j, second in enumerate(residuals[: i + 1]):
                found[part, i, j] = found[part, j, i] = np.einsum("pk,pk->p", first, second) / scale
    return found


def _designs(problem: SafetyProblem, x: np.ndarray) -> list[tuple[Features, np.ndarray]]:
    """Return the features (P, M) of each degree at states (P, n), while M is at most P/2."""
    candidates = [
        Features.of(problem, degree) for degree in _DEGREES if Features.allowed(problem, degree)
    ]
    return [(f, f.matrix(x)) for f in candidates if f.degree == 0 or 2 * f.count <= len(x)]


def _fit(
    designs: Sequence[tuple[Features, np.ndarray]], values: np.ndarray, may_vanish: bool
) -> tuple[Features, np.ndarray] | None:
    """Return features and weights of the regression of values (P,) with least BIC; None for 0."""
    # A fit without any residual would win over all others, by an infinite margin.
    floor = len(values) * (_EXACT * np.abs(values).max()) ** 2

    def criterion(residuals: np.ndarray, count: int) -> float:
        return len(values) * np.log(max(residuals @ residuals, floor)) + count * np.log(len(values))

    best, least = None, criterion(values, 0) if may_vanish else np.inf
    for features, matrix in designs:
        weights = np.linalg.lstsq(matrix, values)[0]
        score = criterion(values - matrix @ weights, features.count)
        if score < least:
            best, least = (features, weights), score
    return best


def _held_out_errors(
    problem: SafetyProblem, data: Transitions, found: np.ndarray, entries: Sequence[Entry]
) -> dict[str, float]:
    """See `LearnedDiffusion.learn`."""
    if len(np.unique(data.x, axis=0)) < _FEWEST_STARTS:
        return {}
    held = data.held_out(_HELD_OUT, random_stream(data.seed or 0, Purpose.HELD_OUT))
    trained = ~held
    designs, errors = _designs(problem, data.x[trained]), {}
    for entry in entries:
        fit = _fit(
            designs, found[trained, entry.row, entry.column], may_vanish=entry.row != entry.column
        )
        predicted = 0.0 if fit is None else fit[0].matrix(data.x[held]) @ fit[1]
        names = ", ".join(problem.states[i].symbol.name for i in (entry.row, entry.column))
        errors[f"C({names})"] = float(
            np.sqrt(np.mean((predicted - found[held, entry.row, entry.column]) ** 2))
        )
    return errors


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
