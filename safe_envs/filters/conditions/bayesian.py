"""The condition of an identified system, for its most probable weights or a whole credible set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.lie import (
    generator,
    gradient,
    ito_correction,
    lie_derivative_f,
    lie_derivative_g,
    relative_degree,
)
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, RelativeDegreeError
from safe_envs.filters.conditions.base import FIRST_ORDER, AffineConstraint, CredibleSet, chain_of
from safe_envs.filters.conditions.learned import LearnedCondition, require_share
from safe_envs.problem.problem import Barrier

if TYPE_CHECKING:
    from safe_envs.filters.learning.models.posterior import Posterior


@dataclass(frozen=True)
class BayesianSCBF(LearnedCondition):
    """A^r h >= 0 for the identified system.

    This is the most probable system, or each of those that the data leave possible.

    With theta Gaussian, A h = a + b u has a mean and a variance v(x, u), and the robust form asks
    for mean - z sqrt(v) >= 0. With `confidence` z is the quantile of Student's distribution, for
    each (x, u) by itself, and sigma the most probable. With `simultaneous` the ellipsoid of theta
    and the intervals of sigma hold together with that probability, hence for all (x, u) at once:
    then `safe_envs.proofs.posterior` has a bound for it. Correlated noise
    makes v at most its largest eigenvalue larger. Both hold as far as the features and a constant
    sigma fit the data; what does not is in the warnings of the record.

    Attributes:
        learned: the posterior.
        confidence: of the form that is robust at each state by itself.
        simultaneous: of the form that is robust at all states at once.

    Raises:
        ConfigurationError: both are given, or one is not between 0 and 1.

    Source: thesis Sec. 6.2.5, Eq. (6.12), for the most probable system.
    """

    learned: Posterior  # pyright: ignore[reportIncompatibleVariableOverride]
    confidence: float | None = None
    simultaneous: float | None = None
    name = "bayesian-scbf"
    method = "bayesian"
    corrects_model = False
    stochastic = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.confidence is not None and self.simultaneous is not None:
            raise ConfigurationError("bayesian-scbf takes confidence or simultaneous, not both")
        for field in ("confidence", "simultaneous"):
            if getattr(self, field) is not None:
                require_share(field, getattr(self, field))

    @property
    def credible_set(self) -> CredibleSet | None:
        """The systems of the simultaneous form; None of the others."""
        if self.simultaneous is None:
            return None
        return CredibleSet(self.learned, self.delta_theta + self.delta_sigma)

    @property
    def robust(self) -> bool:
        """Whether it is met for more than the most probable system."""
        return self.confidence is not None or self.simultaneous is not None

    def believed(self, model: ControlAffineSDE) -> ControlAffineSDE:
        """Return the identified system."""
        return self.learned.system

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint.

        Raises:
            RelativeDegreeError: there is no relative degree, or it is not 1 and the robust form is
                asked for.
        """
        if self.learned.pruned.all():
            raise RelativeDegreeError(
                "no input acts on the identified system: learn from more data, or under larger"
                " inputs"
            )
        if not self.robust:
            return AffineConstraint.after(model, *chain_of(model, barrier, None, generator))
        degree = relative_degree(model, barrier.expression, generator)
        if degree != 1:
            raise RelativeDegreeError(
                f"barrier {barrier.name} has relative degree {degree}, where A^r h is not linear in"
                " the weights and its distribution not known: the robust form is for relative"
                " degree 1. Leave out confidence and simultaneous"
            )
        if self.sampling_margin == FIRST_ORDER:
            raise ConfigurationError(
                "the robust form has no sampling margin of first order; give a number"
            )
        # What the most probable system prunes may yet differ from 0 a little, and a large input
        # makes that much.
        mean = self.learned.mean_system
        slopes: Any = gradient(mean, barrier.expression)
        a: Any = lie_derivative_g(mean, barrier.expression)
        factors = self.variance_factors(np.array([entry != 0 for entry in slopes])).tolist()
        total: Any = sp.zeros(mean.m + 1)
        for slope, factor, form in zip(
            slopes, factors, self.learned.variance_expressions, strict=True
        ):
            total = total + sp.Float(factor, 17) * slope**2 * form
        return AffineConstraint(
            tuple(a[0, j] for j in range(mean.m)),
            lie_derivative_f(mean, barrier.expression) + self._least_ito_term(mean, barrier),
            (barrier.expression,),
            uncertainty=tuple(total[i, j] for i in range(mean.m + 1) for j in range(i, mean.m + 1)),
        )

    def variance_factors(self, outputs: np.ndarray) -> np.ndarray:
        """Return by what the variance of each f_i + g_i u is multiplied, shape (n,), as by z^2.

        Args:
            outputs: whether the barrier depends on each state, (n,).
        """
        from scipy import stats

        noise = self.learned.diffusion
        if self.confidence is not None:
            z = max(stats.t.ppf(self.confidence, noise.count), 0.0)
            correlated = np.linalg.eigvalsh(noise.correlation[np.ix_(outputs, outputs)])[-1]
            return np.full(len(outputs), z**2 * correlated)
        # The variance of the weights is that of the noise, which may be as large as its interval
        # allows: more than estimated, since the interval leaves out a quarter at most of what is
        # smaller, and the median of a chi^2 lies below its mean.
        largest = noise.sigma_intervals(self.delta_sigma)[:, 1] ** 2
        estimated = noise.squares / noise.count
        allowed = np.divide(largest, estimated, out=np.ones(len(largest)), where=estimated > 0)
        return (
            stats.chi2.ppf(1.0 - self.delta_theta, outputs.sum() * self.learned.mean.shape[1])
            * allowed
        )

    @property
    def delta_theta(self) -> float:
        """Probability that the ellipsoid of the simultaneous form misses theta."""
        return 0.5 * (1.0 - (self.simultaneous or 0.0))

    @property
    def delta_sigma(self) -> float:
        """Probability that its intervals miss a sigma."""
        return 1.0 - (self.simultaneous or 0.0) - self.delta_theta

    def _least_ito_term(self, system: ControlAffineSDE, barrier: Barrier) -> sp.Expr:
        """Return 1/2 tr(sigma sigma' h_xx)."""
        # For the simultaneous form it is the smallest that the intervals of the sigma_i allow.
        if self.simultaneous is None:
            return ito_correction(system, barrier.expression)
        curvatures = [sp.diff(barrier.expression, s, 2) / 2 for s in system.states]
        intervals = self.learned.diffusion.sigma_intervals(self.delta_sigma).tolist()
        return sp.Add(
            *[
                sp.Min(c * low**2, c * high**2)
                for c, (low, high) in zip(curvatures, intervals, strict=True)
            ]
        )
