"""What Bayesian identification knows of a control-affine system: distributions of its drift, input
matrix and noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
import sympy as sp
from scipy.stats import chi2

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.learning.base import LearnedModel, Record
from safe_envs.wrappers.learning.models.features import Features
from safe_envs.wrappers.learning.models.signature import Signature
from safe_envs.wrappers.learning.models.values import (
    LARGEST,
    LearnedFileError,
    array_of,
    require_finite,
)
from safe_envs.wrappers.learning.regression import Gaussian, sigma_map, sigma_samples

_SIGNIFICANT = 0.999
_POINTS = 256
_SLOPE = 1e-6
"""Part of its range by which a state is moved to see how f and g change."""

_ROUNDING = 1e-9
"""Of the entries of a matrix of correlations."""

_ROUNDED = 1e-3
"""Part of its mean within which a regressed variance is rounded off towards 0, so that it stays
positive and smooth."""


@dataclass(frozen=True, eq=False)
class Diffusion:
    """What is known of the noise: a level for each state, or a variance that varies, and
    correlations.

    Attributes:
        squares: S of each state, the sum of xi^2/dt over the residual increments xi, (n,); 0 for a
            state without noise.
        count: N, degrees of freedom of each S.
        correlation: of the noise of the states, (n, n).
        alpha: shape of the prior of sigma.
        beta: its scale, in the units of sigma.
        features: on which the variances per s were regressed; None for constant noise.
        variance: weights of these variances; None for constant noise.
    """

    squares: np.ndarray
    count: float
    correlation: np.ndarray
    alpha: float = 1.0
    beta: float = 1.0
    features: Features | None = None
    variance: Gaussian | None = None

    @property
    def sigma(self) -> np.ndarray:
        """The most probable constant levels, (n,). A state without any scatter has none, where the
        prior would say beta/N."""
        levels = sigma_map(
            self.squares, np.full(len(self.squares), self.count), self.alpha, self.beta
        )
        return np.where(self.squares > 0, levels, 0.0)

    def sigma_intervals(self, delta: float) -> np.ndarray:
        """Intervals that hold all sigma_i of constant, independent noise but for a probability
        delta, shape (n, 2).

        They are those of S/sigma^2 ~ chi^2_N: a prior of sigma, whose scale is a guess, would move
        them off the truth.

        Raises:
            ConfigurationError: the noise varies with the state, or is correlated.
        """
        if self.features is not None or not np.array_equal(
            self.correlation, np.eye(len(self.squares))
        ):
            raise ConfigurationError(
                "intervals of sigma are known for constant noise of independent states only; ask"
                " for confidence instead"
            )
        tail = 0.5 * delta / len(self.squares)
        levels = np.array([tail, 1.0 - tail])
        return np.sqrt(self.squares[:, None] / chi2.isf(levels, self.count))

    def variances(self, x: np.ndarray) -> np.ndarray:
        """Estimated variances per s at states (B, n), without the prior of sigma, shape (B, n)."""
        constant = self.squares / self.count
        if self.features is None or self.variance is None:
            return np.broadcast_to(constant, x.shape)
        p, rounding = self.features.matrix(x) @ self.variance.mean.T, _ROUNDED * constant
        return 0.5 * (p + np.sqrt(p**2 + 4.0 * rounding**2))

    def matrix(self, rng: np.random.Generator | None = None) -> sp.ImmutableMatrix:
        """sigma(x), (n, n): the most probable one, or one drawn from the posterior."""
        if self.features is None or self.variance is None:
            levels = [sp.Float(s, 17) if s else sp.Integer(0) for s in self._levels(rng).tolist()]
        else:
            weights = self.variance.mean if rng is None else self.variance.sample(rng)
            levels = [
                self._level(p, r)
                for p, r in zip(
                    map(self.features.combined, weights), self.squares / self.count, strict=True
                )
            ]
        return sp.ImmutableMatrix(sp.diag(*levels) * _root(self.correlation))

    def _levels(self, rng: np.random.Generator | None) -> np.ndarray:
        if rng is None:
            return self.sigma
        return np.array(
            [
                sigma_samples(s, self.count, self.alpha, self.beta, 1, rng)[0] if s > 0 else 0.0
                for s in self.squares
            ]
        )

    def _level(self, p: sp.Expr, constant: float) -> sp.Expr:
        if not constant:
            return sp.Integer(0)
        rounding = sp.Float(2.0 * _ROUNDED * constant, 17)
        return sp.sqrt((p + sp.sqrt(p**2 + rounding**2)) / 2)


@dataclass(frozen=True, eq=False)
class Posterior(LearnedModel):
    """What Bayesian identification knows of f, g and sigma.

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
        Eq. (6.5): the same posterior,
    with the right variances.
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
        """Whether g_ij is taken for 0, (n, m): it does not differ from 0, or only as the length of
        the steps makes it.

        Such entries would have tiny values, and with them give a relative degree to barriers that
        the input does not reach.
        """
        return self._insignificant() | self._leaked()

    def _insignificant(self) -> np.ndarray:
        """Whether w' Cov^-1 w of the weights of g_ij is below the .999 quantile of chi^2_M."""
        count = self.features.count
        small = np.empty((len(self.mean), len(self.inputs)), dtype=bool)
        for j in range(len(self.inputs)):
            block = slice((j + 1) * count, (j + 2) * count)
            weights = self.mean[:, block, None]
            size = (weights * _solved(self.covariance[:, block, block], weights)).sum(axis=(1, 2))
            small[:, j] = size <= chi2.ppf(_SIGNIFICANT, count)
        return small

    def _leaked(self) -> np.ndarray:
        """Whether g_ij is no larger than twice dt/2 (Df g_j + Dg_j f)_i, by which a step of dt
        mixes it with the others.

        A plant that is integrated finer than dt shows that much: to a position the input comes
        within a step.
        """
        n, parts, _, count = self._blocks
        low, high = np.array(self.features.region).T
        x = np.random.default_rng(0).uniform(low, high, (_POINTS, n))
        reach = np.diag(_SLOPE * (high - low))
        slopes = np.stack(
            [
                (self.features.matrix(x + h) - self.features.matrix(x - h)) / (2.0 * h.sum())
                for h in reach
            ],
            axis=-1,
        )
        weights = self.mean.reshape(n, parts, count)
        values = np.einsum("bk,ipk->bip", self.features.matrix(x), weights)
        jacobians = np.einsum("bkj,ipk->bipj", slopes, weights, optimize=True)
        mixed = jacobians[:, :, 0] @ values[:, :, 1:] + np.einsum(
            "bipj,bj->bip", jacobians[:, :, 1:], values[:, :, 0]
        )
        return (values[:, :, 1:] ** 2).mean(axis=0) <= self.dt**2 * (mixed**2).mean(axis=0)

    @cached_property
    def weights(self) -> Gaussian:
        """The weights of `system`: their distribution, given that those of the pruned entries are
        0."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        for i, row in enumerate(self.pruned):
            zero = np.flatnonzero(np.repeat([False, *row], self.features.count))
            if zero.size:
                gain = _solved(covariance[i][np.ix_(zero, zero)], covariance[i][zero]).T
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
        """A system drawn from the posterior. What is pruned stays 0."""
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
        """Covariances of (f_i, g_i1, .., g_im) at states (B, n), shape (B, n, 1 + m, 1 + m); also
        of what is pruned."""
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
        """The covariance of the weights with the scales of the inputs in it, axes (n, 1 + m, 1 + m,
        M, M)."""
        n, parts, _, count = self._blocks
        scale = np.array([1.0, *self.input_scale])
        split = self.covariance.reshape(n, parts, count, parts, count).transpose(0, 1, 3, 2, 4)
        return split * np.outer(scale, scale)[:, :, None, None]

    @cached_property
    def _stretched(self) -> np.ndarray:
        """The same as one matrix (M, n (1 + m)^2 M), so that a batch costs one product of matrices."""
        return np.ascontiguousarray(
            np.moveaxis(self._split_covariance, 3, 0).reshape(self.features.count, -1)
        )

    @property
    def variance_expressions(self) -> tuple[sp.ImmutableMatrix, ...]:
        """Covariances of (f_i, g_i1, .., g_im) as n matrices (1 + m) x (1 + m) of expressions,
        multiplied out."""
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
            "degree": self.features.degree,
            "region": [list(bounds) for bounds in self.features.region],
            "angles": list(self.features.angles),
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

        def features(degree: int) -> Features:
            return Features.from_json(
                problem.plant.states, details["region"], degree, details["angles"]
            )

        def numbers(name: str, *shape: int) -> np.ndarray:
            return array_of(arrays, name, shape)

        n, m, phi = problem.plant.n, problem.plant.m, features(details["degree"])
        count, degree = phi.count * (1 + m), details["diffusion_degree"]
        varying = features(degree) if degree else None
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
        _require_noise(noise)
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
        """See `LearnedModel.compare`: f_i and g_ij in the units of the states per s, and the
        entries of sigma sigma'."""
        truth, estimate = _entries(problem.plant, x), _entries(self.system, x)
        return {name: (truth[name], estimate[name]) for name in truth}


def _solved(covariance: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The solution of a system with a covariance of weights; what is learned has a regular one."""
    try:
        return np.linalg.solve(covariance, right)
    except np.linalg.LinAlgError as error:
        raise LearnedFileError(
            "the covariance of the weights is singular: the file was altered. Learn again"
        ) from error


def _require_noise(noise: Diffusion) -> None:
    """Raise ValueError where noise has a variance, a correlation or a prior that there is not."""
    correlation = noise.correlation
    fits = (
        (noise.squares >= 0).all()
        and 0 < noise.count <= LARGEST
        and max(noise.alpha, noise.beta) <= LARGEST
    )
    fits = fits and min(noise.alpha, noise.beta) >= 0
    if not (
        fits
        and np.allclose(correlation, correlation.T, atol=_ROUNDING)
        and (abs(correlation) <= 1.0 + _ROUNDING).all()
    ):
        raise ValueError(
            "the noise has a negative variance, a correlation above 1, or no degrees of freedom"
        )


def _entries(system: ControlAffineSDE, x: np.ndarray) -> dict[str, np.ndarray]:
    """Values of f, g and the upper half of sigma sigma' at states (B, n), by name."""
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
    compiled = compile_function(
        system.states, [system.numeric(e) for e in named.values()], "arrays"
    )
    return dict(zip(named, stacked(compiled(*np.ascontiguousarray(x.T)), len(x)).T, strict=True))


def _root(correlation: np.ndarray) -> sp.Matrix:
    """The symmetric square root of a correlation matrix, which may be singular."""
    values, vectors = np.linalg.eigh(correlation)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return sp.Matrix(
        [[sp.Float(v, 17) if v else sp.Integer(0) for v in row] for row in root.tolist()]
    )
