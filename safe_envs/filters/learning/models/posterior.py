"""The posterior of a control-affine system: distributions of drift, input matrix and noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
import sympy as sp
from scipy.stats import chi2

from safe_envs.dynamics.codegen import tabulated
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.filters.learning.data import (
    LARGEST,
    LearnedFileError,
    Signature,
    array_of,
    require_finite,
)
from safe_envs.filters.learning.models.base import LearnedModel, Record
from safe_envs.filters.learning.models.distributions import Diffusion, Gaussian, require_noise
from safe_envs.filters.learning.models.features import Features
from safe_envs.problem.problem import SafetyProblem

_SIGNIFICANT = 0.999
_POINTS = 256
_SLOPE = 1e-6
"""Part of its range by which a state is moved to see how f and g change."""


def insignificant(mean: np.ndarray, covariance: np.ndarray, inputs: int) -> np.ndarray:
    """Return whether w' Cov^-1 w of the weights of g_ij is below the .999 quantile of chi^2_M.

    Args:
        mean: of the weights, shape (n, M (1 + m)).
        covariance: of the weights of each state, shape (n, M (1 + m), M (1 + m)).
        inputs: m.

    Returns:
        Shape (n, m).
    """
    count = mean.shape[1] // (1 + inputs)
    small = np.empty((len(mean), inputs), dtype=bool)
    for j in range(inputs):
        block = slice((j + 1) * count, (j + 2) * count)
        weights = mean[:, block, None]
        size = (weights * solved(covariance[:, block, block], weights)).sum(axis=(1, 2))
        small[:, j] = size <= chi2.ppf(_SIGNIFICANT, count)
    return small


def mixed_by_steps(features: Features, mean: np.ndarray, dt: float) -> np.ndarray:
    """Return whether g_ij is no larger than twice dt/2 (Df g_j + Dg_j f)_i.

    A step of dt mixes the entries by that much: in a plant that is integrated finer than dt the
    input reaches a position within a step.

    Args:
        features: Phi, M of them.
        mean: of the weights, shape (n, M (1 + m)).
        dt: length of the steps in s.

    Returns:
        Shape (n, m).
    """
    n, low, high = len(mean), *np.array(features.region).T
    x = np.random.default_rng(0).uniform(low, high, (_POINTS, n))
    reach = np.diag(_SLOPE * (high - low))
    slopes = np.stack(
        [(features.matrix(x + h) - features.matrix(x - h)) / (2.0 * h.sum()) for h in reach],
        axis=-1,
    )
    weights = mean.reshape(n, -1, features.count)
    values = np.einsum("bk,ipk->bip", features.matrix(x), weights)
    jacobians = np.einsum("bkj,ipk->bipj", slopes, weights, optimize=True)
    mixed = jacobians[:, :, 0] @ values[:, :, 1:] + np.einsum(
        "bipj,bj->bip", jacobians[:, :, 1:], values[:, :, 0]
    )
    return (values[:, :, 1:] ** 2).mean(axis=0) <= dt**2 * (mixed**2).mean(axis=0)


def solved(covariance: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution of a system with a covariance of weights.

    Args:
        covariance: regular, if it was learned, shape (..., D, D).
        right: right-hand sides, shape (..., D, k).

    Raises:
        LearnedFileError: the covariance is singular.
    """
    try:
        return np.linalg.solve(covariance, right)
    except np.linalg.LinAlgError as error:
        raise LearnedFileError(
            "the covariance of the weights is singular: the file was altered. Learn again"
        ) from error


@dataclass(frozen=True, eq=False)
class Posterior(LearnedModel):
    """The distributions of f, g and sigma of an identified system.

    f_i = Phi w_i0 and g_ij = s_j Phi w_ij, with the features Phi and Gaussian weights (w_i0, ..,
    w_im), drawn independently from state to state. Where the noise of the states is correlated, the
    weights are as well: see `BayesianSCBF`.

    Attributes:
        signature: of which system.
        record: how it was learned.
        features: Phi, M of them.
        inputs: m symbols.
        input_scale: s, (m,), in 1/(unit of the input).
        mean: of the weights, (n, D) with D = M (1 + m).
        covariance: of the weights, (n, D, D).
        diffusion: the noise.
        dt: mean length of the steps in the data, in s.
        misfit: part of each state's rate that the features miss beyond the noise, (n,); 0 where
            that may be chance.
        variation: part by which the variance of its noise varies although it was taken for
            constant, (n,), likewise.

    Source: thesis Sec. 6.2, with f and g in one regression on both inputs instead of the pairs of
        Eq. (6.5): the same posterior, with the right variances.
    """

    method: ClassVar[str] = "bayesian"
    signature: Signature
    record: Record
    features: Features
    inputs: tuple[sp.Symbol, ...]
    input_scale: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    diffusion: Diffusion
    dt: float
    misfit: np.ndarray
    variation: np.ndarray

    @cached_property
    def pruned(self) -> np.ndarray:
        """Which g_ij are taken for 0, (n, m); see `safe_envs.filters.learning.models.posterior`.

        Such entries would have tiny values, and with them give a relative degree to barriers that
        the input does not reach.
        """
        zero = insignificant(self.mean, self.covariance, len(self.inputs))
        return zero | mixed_by_steps(self.features, self.mean, self.dt)

    @cached_property
    def weights(self) -> Gaussian:
        """The weights of `system`: their distribution where those of the pruned entries are 0."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        for i, row in enumerate(self.pruned):
            zero = np.flatnonzero(np.repeat([False, *row], self.features.count))
            if zero.size:
                gain = solved(covariance[i][np.ix_(zero, zero)], covariance[i][zero]).T
                mean[i] -= gain @ mean[i][zero]
                covariance[i] -= gain @ covariance[i][zero]
                mean[i][zero], covariance[i][zero], covariance[i][:, zero] = 0.0, 0.0, 0.0
        return Gaussian(mean, covariance)

    @cached_property
    def system(self) -> ControlAffineSDE:
        """The most probable system, in the problem's own symbols."""
        return self._system(self.weights.mean, self.diffusion.matrix())

    @cached_property
    def mean_system(self) -> ControlAffineSDE:
        """The system with the mean of all weights, those of the pruned entries too."""
        return self._system(self.mean, self.diffusion.matrix())

    def sample(self, rng: np.random.Generator) -> ControlAffineSDE:
        """Draw a system from the posterior; what is pruned stays 0."""
        return self._system(self.weights.sample(rng), self.diffusion.matrix(rng))

    def _system(self, weights: np.ndarray, diffusion: sp.ImmutableMatrix) -> ControlAffineSDE:
        n, m, count = len(self.mean), len(self.inputs), self.features.count
        scaled = (
            weights.reshape(n, 1 + m, count) * np.array([1.0, *self.input_scale])[:, None]
        ).tolist()
        entries = [
            [self.features.combined(w) if any(w) else sp.Integer(0) for w in row] for row in scaled
        ]
        drift, rows = [row[0] for row in entries], [row[1:] for row in entries]
        return ControlAffineSDE(self.features.states, self.inputs, drift, rows, diffusion)

    def drift_variance(self, x: np.ndarray) -> np.ndarray:
        """Return the covariances of (f_i, g_i1, .., g_im) at states, pruned entries included.

        The states are (B, n), the covariances (B, n, 1 + m, 1 + m).
        """
        phi = self.features.matrix(x)
        return np.einsum(
            "bipqk,bk->bipq", (phi @ self._stretched).reshape(len(x), *self._blocks), phi
        )

    @cached_property
    def _blocks(self) -> tuple[int, int, int, int]:
        """Shape (n, 1 + m, 1 + m, M)."""
        return (len(self.mean), 1 + len(self.inputs), 1 + len(self.inputs), self.features.count)

    @cached_property
    def _split_covariance(self) -> np.ndarray:
        """The covariance of the weights in physical inputs, axes (n, 1 + m, 1 + m, M, M)."""
        n, parts, _, count = self._blocks
        scale = np.array([1.0, *self.input_scale])
        split = self.covariance.reshape(n, parts, count, parts, count).transpose(0, 1, 3, 2, 4)
        return split * np.outer(scale, scale)[:, :, None, None]

    @cached_property
    def _stretched(self) -> np.ndarray:
        """The same as one matrix (M, n (1 + m)^2 M): a batch costs one product of matrices."""
        return np.ascontiguousarray(
            np.moveaxis(self._split_covariance, 3, 0).reshape(self.features.count, -1)
        )

    @property
    def variance_expressions(self) -> tuple[sp.ImmutableMatrix, ...]:
        """Covariances of (f_i, g_i1, .., g_im) as n matrices (1 + m) x (1 + m), multiplied out."""
        first, second = np.triu_indices(self.features.count)
        phi = self.features.expressions
        products = [
            sp.expand(phi[k] * phi[j]).as_coefficients_dict()
            for k, j in zip(first, second, strict=True)
        ]
        monomials = list(dict.fromkeys(monomial for product in products for monomial in product))
        # By numbers, not by symbols, of which there are many more.
        shares = np.array(
            [[float(product.get(monomial, 0)) for monomial in monomials] for product in products]
        )
        twice = np.where(first == second, 0.5, 1.0)

        def entry(block: np.ndarray) -> sp.Expr:
            weights = ((block + block.T)[first, second] * twice) @ shares
            return sp.Add(
                *[
                    sp.Float(w, 17) * monomial
                    for w, monomial in zip(weights.tolist(), monomials, strict=True)
                    if w
                ]
            )

        return tuple(
            sp.ImmutableMatrix([[entry(block) for block in row] for row in state])
            for state in self._split_covariance
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """See `LearnedModel.arrays`."""
        noise = self.diffusion
        named = {
            name: getattr(self, name)
            for name in ("input_scale", "mean", "covariance", "misfit", "variation")
        }
        named |= {"squares": noise.squares, "correlation": noise.correlation}
        if noise.variance is not None:
            named |= {
                "variance_mean": noise.variance.mean,
                "variance_covariance": noise.variance.covariance,
            }
        return named

    def details(self) -> dict[str, Any]:
        """See `LearnedModel.details`."""
        noise = self.diffusion
        return {
            **self.features.details(),
            "diffusion_degree": 0 if noise.features is None else noise.features.degree,
            "dt": self.dt,
            "count": noise.count,
            "alpha": noise.alpha,
            "beta": noise.beta,
        }

    @classmethod
    def restored(
        cls,
        problem: SafetyProblem,
        record: Record,
        details: Mapping[str, Any],
        arrays: Mapping[str, np.ndarray],
    ) -> Self:
        """See `LearnedModel.restored`. The region is the one in which was learned."""

        def numbers(name: str, *shape: int) -> np.ndarray:
            return array_of(arrays, name, shape)

        n, m = problem.plant.n, problem.plant.m
        phi = Features.restored(problem.plant.states, details)
        count, degree = phi.count * (1 + m), details["diffusion_degree"]
        also = {**details, "degree": degree}
        varying = Features.restored(problem.plant.states, also) if degree else None
        noise = Diffusion(
            numbers("squares", n),
            correlation=numbers("correlation", n, n),
            **{name: require_finite(details[name]) for name in ("count", "alpha", "beta")},
            features=varying,
            variance=varying
            and Gaussian(
                numbers("variance_mean", n, varying.count),
                numbers("variance_covariance", n, varying.count, varying.count),
            ),
        )
        require_noise(noise)
        weights = numbers("mean", n, count), numbers("covariance", n, count, count)
        scale, dt = numbers("input_scale", m), require_finite(details["dt"])
        if not (0 < dt <= LARGEST and (scale > 0).all()):
            raise ValueError("a step or the scale of an input is not positive, or too large")
        rest = dt, numbers("misfit", n), numbers("variation", n)
        return cls(
            Signature.of(problem), record, phi, problem.plant.inputs, scale, *weights, noise, *rest
        )

    @classmethod
    def check(cls, signature: Signature, problem: SafetyProblem) -> None:
        """See `LearnedModel.check`. Barriers, model and control period may differ."""
        signature.require(problem)

    def compare(
        self, problem: SafetyProblem, x: np.ndarray
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return f_i, g_ij and the entries of sigma sigma'; see `LearnedModel.compare`."""
        truth, estimate = _entries(problem.plant, x), _entries(self.system, x)
        return {name: (truth[name], estimate[name]) for name in truth}


def _entries(system: ControlAffineSDE, x: np.ndarray) -> dict[str, np.ndarray]:
    """Return f, g and the upper half of sigma sigma' at states (B, n), by name."""
    covariance = system.diffusion * system.diffusion.T
    named = {f"f[{s}]": system.drift[i] for i, s in enumerate(system.states)}
    named |= {
        f"g[{s}, {u}]": system.input_matrix[i, j]
        for i, s in enumerate(system.states)
        for j, u in enumerate(system.inputs)
    }
    named |= {
        f"covariance[{s}, {t}]": covariance[i, j]
        for i, s in enumerate(system.states)
        for j, t in enumerate(system.states)
        if i <= j
    }
    values = tabulated(system.states, [system.numeric(e) for e in named.values()])(x)
    return dict(zip(named, values.T, strict=True))
