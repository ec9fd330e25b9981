"""Checks of data against a drift that is known, and against the region of a problem."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.data.transitions import Transitions
from safe_envs.wrappers.learning.estimators import by_parts

_SUSPECT = 1.5
"""Score of a drift, in standard errors, from which it does not fit the data."""


_SURE = 5.0
"""Standard errors from which a log does not fit a drift."""


_MATERIAL = 0.05
"""Part of a state's steps, or of all states, from which there is a warning."""


_ROUNDING = 64 * np.finfo(float).eps
"""Part of the size of a state up to which a residual is taken for a rounding error."""


def rounding(data: Transitions, rate: np.ndarray) -> np.ndarray:
    """Return the largest residual of each state that may be a rounding error, shape (n,).

    Args:
        data: transitions.
        rate: f(x) + g(x) u at each point, shape (P, n).
    """
    return _ROUNDING * (np.abs(data.x) + np.abs(rate) * data.dt[:, None]).max(axis=0)


def slack(data: Transitions, rate: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the largest residual of each state that another integration may make, shape (n,).

    Args:
        data: transitions.
        rate: f(x) + g(x) u at each point, shape (P, n).
        mean: its mean over the steps, shape (P, n).
    """
    return _MATERIAL * (np.abs(mean - rate) * data.dt[:, None]).max(axis=0)


def drift_score(data: Transitions, rate: np.ndarray, allowed: np.ndarray | float = 0.0) -> float:
    """Return how far the mean steps are from a drift's, in standard errors; 1 if it is right.

    It is the root mean square over points and states. Steps without repetitions tell nothing and
    score 1, and so do residuals within the rounding.

    Args:
        data: transitions under any inputs.
        rate: f(x) + g(x) u at each point, or its mean over the steps, shape (P, n).
        allowed: part of the mean residual of each state that does not count, shape (n,); see
            `slack`.
    """
    expected, small = (data.x + rate * data.dt[:, None]).T, rounding(data, rate)
    ignored = np.broadcast_to(allowed, small.shape)
    scores = np.ones((data.points, len(expected)))
    for part, successors in by_parts(data):
        for i, after in enumerate(successors):
            residual = after - expected[i, part, None]
            mean = np.maximum(np.abs(residual.mean(axis=1)) - ignored[i], 0.0)
            square = np.einsum("pk,pk->p", residual, residual) / data.repetitions
            np.divide(
                mean**2 * data.repetitions,
                square,
                out=scores[part, i],
                where=square > small[i] ** 2,
            )
    return float(np.sqrt(scores.mean()))


def drift_warnings(
    data: Transitions, rate: np.ndarray, mean: np.ndarray, names: Sequence[str]
) -> tuple[str, ...]:
    """Return warnings where a drift does not fit the data.

    Args:
        data: transitions under any inputs.
        rate: f(x) + g(x) u at each point, shape (P, n).
        mean: what it is over the steps; see `mean_rates`.
        names: of the states.
    """
    score = drift_score(data, mean, slack(data, rate, mean))
    if score >= _SUSPECT:
        return (
            (
                f"the mean steps are {score:.1f} standard errors away from those of the model's f"
                " and g, where 1 is expected: the method takes both for known, and what is learned"
                " of the noise contains their error. A wrong dt looks the same"
            ),
        )
    return _factor_warnings(data, mean, names)


def _factor_warnings(data: Transitions, mean: np.ndarray, names: Sequence[str]) -> tuple[str, ...]:
    """Return warnings for a log without repetitions, by regression on the steps of the drift."""
    moved = mean * data.dt[:, None]
    product = (data.successors.mean(axis=1) - data.x - moved) * moved
    size, total, spread = (
        (moved**2).sum(axis=0),
        product.sum(axis=0),
        np.sqrt((product**2).sum(axis=0)),
    )
    excess = np.divide(total, size, out=np.zeros_like(size), where=size > 0)
    bad = (np.abs(total) > _SURE * spread) & (np.abs(excess) > _MATERIAL)
    if not bad.any():
        return ()
    factors = ", ".join(f"{name} {1.0 + excess[i]:.2g}" for i, name in enumerate(names) if bad[i])
    return (
        (
            "the steps in the data are not those of the model's f and g over dt, but times:"
            f" {factors}. A wrong dt, columns in another order or a wrong model does this; the"
            " method takes all three for right, and what is learned of the noise contains their"
            " error"
        ),
    )


def region_warnings(problem: SafetyProblem, data: Transitions) -> tuple[str, ...]:
    """Return warnings where much of the data is outside the region that is explored.

    Args:
        problem: whose region is taken.
        data: transitions.
    """
    found = []
    for variable, (low, high), column in zip(
        problem.states, problem.sampling_domain.region, data.x.T, strict=True
    ):
        # Of an unbounded angle any turn will do.
        bounded = np.isfinite(variable.low) or np.isfinite(variable.high)
        share = np.mean((column < low) | (column > high))
        if bounded and share > _MATERIAL:
            found.append(
                f"{share:.0%} of the data have {variable.symbol} outside the explored region,"
                f" [{low:g}, {high:g}]: it is from {column.min():g} to {column.max():g}. Learn from"
                " data of the region, where what is learned will be used"
            )
    return tuple(found)
