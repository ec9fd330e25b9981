"""The bias of an identified system by the length of steps: means are taken for initial rates."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
import sympy as sp

from safe_envs.dynamics.tables import tabulated

if TYPE_CHECKING:
    from safe_envs.wrappers.learning.models.posterior import Posterior

_SLOPE, _CURVE = 1e-6, 1e-3
"""Parts of its range by which a state is moved for first and second derivatives."""

_MOST_INPUTS = 81
_MOST_STATES = 1024


def rate_bias(posterior: Posterior, barrier: sp.Expr, box: np.ndarray, x: np.ndarray) -> float:
    """Return by how much A h of the identified system is off at most, to first order in the step.

    Along F = f + g u with held u the mean of a step of dt is F dt + dt^2/2 L F, with the generator
    L of the system, and its covariance is S dt + dt^2/2 (J S + S J'), with S = sigma sigma' and J
    the Jacobian of F. So the regression finds F + dt/2 L F in place of F and S + dt/2 (J S + S J')
    in place of S. It is 0 for data that were collected from a plant that is integrated by one step
    of Euler and Maruyama a period: there the mean of a step is F dt exactly.

    Args:
        posterior: of the system; its mean stands for the truth.
        barrier: h, an expression of the states with numbers for all parameters.
        box: (low, high) of each input, shape (m, 2).
        x: states of the safe set, shape (B, n).
    """
    if posterior.record.settings.get("substeps") == 1:
        return 0.0
    x = x[:: -(-len(x) // _MOST_STATES)]
    slope, curvature = _derivatives(posterior.features.states, barrier, x)
    spread = posterior.diffusion.matrix() * posterior.diffusion.matrix().T
    covariance = tabulated(posterior.features.states, list(spread))(x)
    covariance = covariance.reshape(len(x), *spread.shape)
    most = 0.0
    for u in itertools.islice(
        itertools.product(*[np.linspace(low, high, 3) for low, high in box]), _MOST_INPUTS
    ):
        rate, jacobian, curved = _rates(posterior, x, np.array(u), covariance)
        moved = np.einsum("bij,bj->bi", jacobian, rate) + curved
        widened = np.einsum("bij,bjk->bik", jacobian, covariance)
        off = (slope * moved).sum(axis=1) + np.einsum("bik,bik->b", widened, curvature)
        most = max(most, float(np.nanmax(abs(off))))
    return 0.5 * posterior.dt * most


def _derivatives(
    states: tuple[sp.Symbol, ...], barrier: sp.Expr, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (B, n) and Hessian (B, n, n) of h."""
    slopes = [sp.diff(barrier, s) for s in states]
    curves = [sp.diff(slope, s) for slope in slopes for s in states]
    values = tabulated(states, [*slopes, *curves])(x)
    n = len(states)
    return values[:, :n], values[:, n:].reshape(len(x), n, n)


def _rates(
    posterior: Posterior, x: np.ndarray, u: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return F (B, n), its Jacobian (B, n, n) and 1/2 tr(S F_xx) (B, n), by differences."""
    n, parts = len(posterior.mean), 1 + len(posterior.inputs)
    weights = np.einsum(
        "ipk,p->ki",
        posterior.mean.reshape(n, parts, -1),
        np.array([1.0, *(posterior.input_scale * u)]),
    )
    width = np.ptp(np.array(posterior.features.region), axis=1)

    def rate(at: np.ndarray) -> np.ndarray:
        return posterior.features.matrix(at) @ weights

    steps = np.diag(_SLOPE * width)
    jacobian = np.stack([(rate(x + h) - rate(x - h)) / (2.0 * h.sum()) for h in steps], axis=2)
    curved = np.zeros((len(x), n))
    steps = np.diag(_CURVE * width)
    for i, j in itertools.product(range(n), repeat=2):
        if covariance[:, i, j].any():
            a, b = steps[i], steps[j]
            second = (rate(x + a + b) - rate(x + a - b) - rate(x - a + b) + rate(x - a - b)) / (
                4.0 * a.sum() * b.sum()
            )
            curved += 0.5 * covariance[:, i, j, None] * second
    return rate(x), jacobian, curved
