"""Conditions that rest on something learned: LearnedHOCBF, DDSCBF, BayesianSCBF."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import sympy as sp

from safe_envs.dynamics.lie import (
    derivatives,
    generator,
    gradient,
    ito_correction,
    lie_derivative_f,
    lie_derivative_g,
    relative_degree,
    tidied,
)
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, RelativeDegreeError, shown
from safe_envs.problem.barrier import Barrier
from safe_envs.wrappers.conditions.base import FIRST_ORDER, AffineConstraint, Condition, chain_of
from safe_envs.wrappers.conditions.cbf import gains_of_poles
from safe_envs.wrappers.conditions.class_k import positive_rates

if TYPE_CHECKING:
    from safe_envs.problem.problem import SafetyProblem
    from safe_envs.wrappers.learning.base import LearnedModel
    from safe_envs.wrappers.learning.models.generator import GeneratorModel
    from safe_envs.wrappers.learning.models.posterior import Posterior
    from safe_envs.wrappers.learning.models.residual import ResidualModel


@dataclass(frozen=True)
class LearnedCondition(Condition):
    """A condition of something learned.

    Attributes:
        learned: what it rests on.
        method: by which that is learned.
    """

    learned: LearnedModel
    method: ClassVar[str]
    corrects_model = True

    def require_fit(self, problem: SafetyProblem) -> None:
        """Raise ConfigurationError where what it rests on was learned by another method, or of
        another problem."""
        method = getattr(self.learned, "method", None)
        if method != self.method:
            raise ConfigurationError(
                f"{self.name} rests on what the method {self.method} learns; given is"
                f" {method or repr(self.learned)}"
            )
        # There may be further barriers; each row looks its own one up.
        barriers = tuple(str(problem.model.numeric(b.expression)) for b in problem.barriers)
        type(self.learned).check(replace(self.learned.signature, barriers=barriers), problem)

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> Condition:
        """There is none without something learned; see `from_learned`."""
        raise ConfigurationError(
            f"{cls.name} rests on something learned: {cls.name}:file=FILE, with a file of"
            " `safe-envs identify`"
        )

    @classmethod
    @abstractmethod
    def from_learned(cls, learned: Any, gains: Sequence[float], **settings: Any) -> Condition:
        """The condition of something learned, with the rates p_1..p_r of a problem where it has
        any."""

    @property
    def parameters(self) -> dict[str, Any]:
        """What makes the same condition again: the settings, and the file or, without one, the
        checksum of what was learned."""
        settings = {k: v for k, v in super().parameters.items() if k != "learned" and v is not None}
        path = self.learned.path
        return {
            **settings,
            **({"sha256": self.learned.sha256[:12]} if path is None else {"file": str(path)}),
        }

    def _number_of(self, model: ControlAffineSDE, barrier: Barrier) -> int:
        """Which of the barriers that were learned a barrier is."""
        expression = str(model.numeric(barrier.expression))
        if expression not in self.learned.signature.barriers:
            known = ", ".join(self.learned.signature.barriers)
            raise ConfigurationError(
                f"{self.name} was learned for the barriers {known}; given is {barrier.name}:"
                f" {expression}"
            )
        return self.learned.signature.barriers.index(expression)

    def _require_no_first_order(self) -> None:
        if self.sampling_margin == FIRST_ORDER:
            raise ConfigurationError(
                f"{self.name} with a network in its row has no sampling margin of first order; give"
                " a number"
            )


def _at_least_zero(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < math.inf:
        raise ConfigurationError(f"{name} = {shown(value)}; give a number >= 0")


def _share(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1:
        raise ConfigurationError(f"{name} = {shown(value)}; give a number above 0 and below 1")


@dataclass(frozen=True)
class LearnedHOCBF(LearnedCondition):
    """The HOCBF with the derivatives of h corrected by learned residuals, and a margin for what
    they miss.

        h^(r) + k_(r-1) h^(r-1) + ... + k_0 h >= e_r + sum_i k_i e_i + e_u |u|

    with h^(i) = L_f^i h + Delta_i and h^(r) = L_f^r h + Delta_r + (L_g L_f^(r-1) h + Sigma) u, f
    and g those of the model, k_i those of the polynomial with its roots at minus the rates, and e
    the errors that the residuals may have. For several inputs the last term is sqrt(m) |(e_u1 u_1,
    ..., e_um u_m)|, which is no smaller.

    Attributes:
        learned: the residuals.
        p: rates p_1..p_r in 1/s.
        level: quantile of the held-out errors that e is, for each residual.
        eps: one number for all e in its place; 0 for no margin.

    Source: thesis Eq. (3.18), (3.20), Prop. 3.3.2. The print takes one e for residuals of different
        units, and the largest |u| of the
    box; Eq. (3.26) forgets the margin, and an error e then settles at h = -e/(p_1 ... p_r).
    """

    learned: ResidualModel  # pyright: ignore[reportIncompatibleVariableOverride]  (narrower, and frozen)
    p: tuple[float, ...] = (1.0,)
    level: float = 0.95
    eps: float | None = None
    name = method = "learned-hocbf"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "p", positive_rates("p", self.p))
        _share("level", self.level)
        if self.eps is not None:
            _at_least_zero("eps", self.eps)

    @classmethod
    def from_learned(
        cls, learned: ResidualModel, gains: Sequence[float], **settings: Any
    ) -> LearnedHOCBF:
        """The condition with all rates of a problem, unless others are given."""
        return cls(learned, **{"p": tuple(gains), **settings})

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint.

        Raises:
            RelativeDegreeError: the number of rates is not the relative degree.
            ConfigurationError: nothing was learned of the barrier.
        """
        self._require_no_first_order()
        part = self.learned.parts[self._number_of(model, barrier)]
        r, m = part.degree, model.m
        if len(self.p) != r:
            raise RelativeDegreeError(
                f"barrier {barrier.name} has relative degree {r} and needs as many rates;"
                f" {len(self.p)} given"
            )
        k = [sp.Float(value, 17) for value in (*gains_of_poles([-p for p in self.p]), 1.0)]
        eta = derivatives(model, barrier.expression, r, lie_derivative_f)
        a = lie_derivative_g(model, eta[r - 1])
        deltas, sigmas = part.symbols[:r], part.symbols[r:]
        error = part.eps(self.level).tolist() if self.eps is None else [self.eps] * (r + m)
        margin: Any = sum(ki * e for ki, e in zip(k[1:], error[:r], strict=True))
        offset: Any = (
            sum(ki * e for ki, e in zip(k, eta, strict=True))
            + sum(ki * d for ki, d in zip(k[1:], deltas, strict=True))
            - margin
        )
        form = {(j, j): sp.Float(m * e * e, 17) for j, e in enumerate(error[r:], start=1)}
        uncertainty = tuple(
            form.get((i, j), sp.Integer(0)) for i in range(m + 1) for j in range(i, m + 1)
        )
        return AffineConstraint(
            tuple(tidied(a[0, j]) + sigmas[j] for j in range(m)),
            offset,
            (barrier.expression,),
            uncertainty=uncertainty if any(error[r:]) else None,
            terms=part,
        )


@dataclass(frozen=True)
class DDSCBF(LearnedCondition):
    """A^r h >= margin, with the part of the generator that the unknown noise makes learned.

    Attributes:
        learned: the generator: a network for each order, or the diffusion, from which the generator
            of any order follows.
        margin: what is asked for beyond 0, in the units of A^r h.

    Source: thesis Prop. 5.2.2, Sec. 5.3. A positive margin cannot be met everywhere on a compact C:
        where h is largest, A h <= 0.
    """

    learned: GeneratorModel  # pyright: ignore[reportIncompatibleVariableOverride]
    margin: float = 0.0
    name = method = "ddscbf"
    stochastic = True

    def __post_init__(self) -> None:
        super().__post_init__()
        _at_least_zero("margin", self.margin)

    @classmethod
    def from_learned(
        cls, learned: GeneratorModel, gains: Sequence[float], **settings: Any
    ) -> DDSCBF:
        """The condition; it has no rates."""
        return cls(learned, **settings)

    def believed(self, model: ControlAffineSDE) -> ControlAffineSDE:
        """The model with the learned diffusion, where that is what was learned."""
        return model if self.learned.diffusion is None else self.learned.diffusion.system(model)

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint; see `chain_of` for what it raises."""
        margin = sp.Float(self.margin, 17)
        if self.learned.diffusion is not None:
            chain, offset = chain_of(model, barrier, None, generator)
            return AffineConstraint.after(model, chain, offset - margin)
        self._require_no_first_order()
        part = self.learned.generators[self._number_of(model, barrier)]
        eta = derivatives(model, barrier.expression, part.degree, lie_derivative_f)
        term, *slopes = part.symbols
        a: Any = lie_derivative_g(model, eta[-2])
        if slopes:
            a = a + sp.Matrix([slopes]) * model.input_matrix
        return AffineConstraint(
            tuple(a[0, j] for j in range(model.m)),
            eta[-1] + term - margin,
            (barrier.expression,),
            terms=part,
        )


@dataclass(frozen=True)
class BayesianSCBF(LearnedCondition):
    """A^r h >= 0 for the identified system: for its most probable one, or for those that the data
    leave possible.

    With theta Gaussian, A h = a + b u has a mean and a variance v(x, u), and the robust form asks
    for mean - z sqrt(v) >= 0. With `confidence` z is the quantile of Student's distribution, for
    each (x, u) by itself, and sigma the most probable. With `simultaneous` the ellipsoid of theta
    and the intervals of sigma hold together with that probability, hence for all (x, u) at once:
    then `safe_envs.wrappers.verification.posterior_guarantee` has a bound for it. Correlated noise
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
                _share(field, getattr(self, field))

    @classmethod
    def from_learned(
        cls, learned: Posterior, gains: Sequence[float], **settings: Any
    ) -> BayesianSCBF:
        """The condition; it has no rates."""
        return cls(learned, **settings)

    @property
    def robust(self) -> bool:
        """Whether it is met for more than the most probable system."""
        return self.confidence is not None or self.simultaneous is not None

    def believed(self, model: ControlAffineSDE) -> ControlAffineSDE:
        """The identified system."""
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
        """By what the variance of each f_i + g_i u is multiplied, z^2 among others, shape (n,).

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
        largest, estimated = (
            noise.sigma_intervals(self.delta_sigma)[:, 1] ** 2,
            noise.squares / noise.count,
        )
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
        """1/2 tr(sigma sigma' h_xx), for the simultaneous form the least that the intervals of the
        sigma_i allow."""
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
