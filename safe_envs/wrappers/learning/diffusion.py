"""Learning the covariance of the noise from one-step data, where the drift is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.checks import Purpose, random_stream
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.drift_checks import rounding
from safe_envs.wrappers.learning.estimators import by_parts
from safe_envs.wrappers.learning.models.diffusion import Entry, LearnedDiffusion
from safe_envs.wrappers.learning.models.features import Features

_DEGREES = (0, 1, 2)
_HELD_OUT = 0.2
_FEWEST_STARTS = 5

_EXACT = 1e-12


def learn_diffusion(
    problem: SafetyProblem, data: Transitions, rate: np.ndarray, allowed: np.ndarray | float = 0.0
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
    return LearnedDiffusion(problem.plant.states, entries), _held_out_errors(
        problem, data, found, entries
    )


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
    """See `learn_diffusion`."""
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
