"""Whether a sensor sees enough of a system to estimate its state."""

from __future__ import annotations

import numpy as np

from safe_envs.dynamics.codegen import compile_function
from safe_envs.errors import SystemDefinitionError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.estimation.estimator import Estimator
from safe_envs.wrappers.estimation.initial import InitialBelief
from safe_envs.wrappers.estimation.packed import unpacked

_TRIES = 5
_TOLERANCE = 1e-7
"""Part of the largest singular value below which one counts as 0."""


def require_observable(
    estimator: Estimator, problem: SafetyProblem, initial: InitialBelief
) -> None:
    """Check that a sensor determines all of the state that is uncertain.

    Along trajectories from some starts, under random inputs, what is measured is linearised, H F_k
    .. F_1. A direction of the state that none of them sees, from any start, is
    allowed only if nothing makes it uncertain: neither the initial belief nor the noise.

    Args:
        estimator: with the model and what is measured.
        problem: whose starts and input bounds are taken.
        initial: belief before the first sample.

    Raises:
        SystemDefinitionError: Some direction is uncertain and not seen.
    """
    n, scale = estimator.n, _scales(problem)
    rows, spread = _along(estimator, problem, initial)
    table = rows * scale
    _, values, vectors = np.linalg.svd(table, full_matrices=True)
    size = np.zeros(n)
    size[: len(values)] = values
    unseen = vectors[size <= _TOLERANCE * max(size.max(), 1e-300)]
    if not len(unseen):
        return
    # In units of the scales: how uncertain is what nothing sees?
    scaled = spread / np.outer(scale, scale)
    uncertain = unseen @ scaled @ unseen.T
    if np.trace(uncertain) <= _TOLERANCE**2:
        return
    sizes, directions = np.linalg.eigh(uncertain)
    found = directions[:, sizes > _TOLERANCE * sizes[-1]].T @ unseen
    parts = np.sqrt((found**2).sum(axis=0))
    names = [s.name for s, part in zip(problem.plant.states, parts, strict=True) if part > 0.1]
    raise SystemDefinitionError(
        f"the measurement ({', '.join(c.name for c in estimator.measurement.channels)}) does not"
        f" determine {', '.join(names)} of {problem.name}; measure more, such as"
        f" '{names[0]}:noise=S', or take measurement='default'"
    )


def _along(
    estimator: Estimator, problem: SafetyProblem, initial: InitialBelief
) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions that trajectories see, and the largest covariance without samples."""
    n, model = estimator.n, estimator.model
    rng = np.random.default_rng(0)
    measured = compile_function(model.states, list(estimator.output_jacobian), "floats")
    slopes = compile_function((*model.states, *model.inputs), list(estimator.jacobian), "floats")
    rows, spread = [], unpacked(initial.covariance, n).copy()
    for start in problem.starts[problem.start].proposals(_TRIES):
        x, p, transition = start.tolist(), list(initial.covariance), np.eye(n)
        for _ in range(2 * n):
            u = [float(rng.uniform(low, high)) for low, high in problem.box]
            rows.append(np.reshape(measured(*x), (-1, n)).astype(float) @ transition)
            step = np.eye(n) + estimator.dt * np.reshape(slopes(*x, *u), (n, n)).astype(float)
            transition = step @ transition
            x, p = (list(part) for part in estimator.predict("floats", x, p, u))
            if not np.isfinite([*x, *p]).all():
                break
            moved = unpacked(p, n)
            spread = np.where(abs(moved) > abs(spread), moved, spread)
    return np.concatenate(rows), np.diag(np.diag(spread))


def _scales(problem: SafetyProblem) -> np.ndarray:
    """Return the size of each state's range; 1 where it is not bounded."""
    width = np.array([v.high - v.low for v in problem.states])
    return np.where(np.isfinite(width), width, 1.0)
