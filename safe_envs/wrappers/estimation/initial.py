"""What an estimator believes before the first sample: the moments of the start distribution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import compile_function
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.problem import SafetyProblem
from safe_envs.validators import real_array
from safe_envs.wrappers.estimation.packed import packed

_PROPOSALS = 40_000
_LEAST = 100


@dataclass(frozen=True)
class InitialBelief:
    """Mean and covariance of the state at the first control instant, before its sample.

    Attributes:
        mean: n numbers.
        covariance: n (n + 1)/2 components, see `packed`.
    """

    mean: tuple[float, ...]
    covariance: tuple[float, ...]

    @classmethod
    def of(cls, mean: Any, covariance: Any) -> InitialBelief:
        """Return a belief that somebody states.

        Args:
            mean: shape (n,).
            covariance: shape (n, n), or (n,) for variances.

        Raises:
            ConfigurationError: The shapes do not fit, a number is not finite, or the covariance is
                not symmetric and positive semidefinite.
        """
        center, spread = real_array("mean", mean), real_array("covariance", covariance)
        table = np.diag(spread) if spread.ndim == 1 else spread
        if center.ndim != 1 or table.shape != 2 * center.shape:
            raise ConfigurationError(
                f"mean {center.shape} and covariance {spread.shape} do not fit; give (n,), and"
                " (n, n) or variances (n,)"
            )
        sound = np.isfinite(center).all() and np.isfinite(table).all()
        if not sound or not np.allclose(table, table.T) or np.linalg.eigvalsh(table)[0] < -1e-12:
            raise ConfigurationError(
                f"covariance = {shown(covariance)}; give a symmetric, positive semidefinite matrix"
            )
        return cls(tuple(center.tolist()), tuple(packed(table)))

    def require_states(self, n: int) -> None:
        """Raise ConfigurationError unless the belief is of so many states."""
        if len(self.mean) != n:
            raise ConfigurationError(
                f"the initial belief has {len(self.mean)} states; the model has {n}"
            )


def initial_belief(problem: SafetyProblem) -> InitialBelief:
    """Return the moments of the start distribution of a problem.

    They are exact for a fixed start, whose covariance is 0, and else those of 40,000 draws, always
    the same.

    Args:
        problem: whose start in use is taken.

    Raises:
        ConfigurationError: The condition of the distribution is hardly ever met.
    """
    start = problem.starts[problem.start]
    if not start.uniforms:
        fixed = [float(v) for v in start.proposals(1)[0]]
        return InitialBelief.of(fixed, np.zeros(len(fixed)))
    states = start.proposals(_PROPOSALS)
    if start.condition is not None:
        condition = problem.model.numeric(start.condition)
        allowed = compile_function(problem.model.states, (condition,), "arrays")(*states.T)[0]
        states = states[np.broadcast_to(allowed > 0, len(states))]
    if len(states) < _LEAST:
        raise ConfigurationError(
            f"the start {problem.start!r} of {problem.name} meets its condition too rarely for its"
            " moments; give an InitialBelief of your own"
        )
    return InitialBelief.of(states.mean(axis=0), _covariance(states))


def _covariance(states: np.ndarray) -> np.ndarray:
    """Return the covariance of draws, without correlations that are nothing but chance."""
    table: np.ndarray = np.atleast_2d(np.cov(states.T))
    scale = np.sqrt(np.diag(table))
    size = np.outer(scale, scale)
    chance = abs(table) < 4.0 * size / np.sqrt(len(states))
    np.fill_diagonal(chance, False)
    return np.where(chance, 0.0, table)
