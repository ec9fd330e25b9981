"""Conditions that need a learned model: LearnedHOCBF, DDSCBF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import sympy as sp

from safe_envs.dynamics.lie import (
    derivatives,
    generator,
    lie_derivative_f,
    lie_derivative_g,
    tidied,
)
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError, RelativeDegreeError, shown
from safe_envs.filters.conditions.base import (
    FIRST_ORDER,
    AffineConstraint,
    Condition,
    chain_of,
    is_nonnegative,
    require_smooth,
)
from safe_envs.filters.conditions.cbf import gains_of_poles
from safe_envs.filters.conditions.class_k import positive_rates
from safe_envs.problem.problem import Barrier

if TYPE_CHECKING:
    from safe_envs.filters.learning.models.base import LearnedModel
    from safe_envs.filters.learning.models.generator import GeneratorModel
    from safe_envs.filters.learning.models.residual import ResidualModel
    from safe_envs.problem.problem import SafetyProblem


@dataclass(frozen=True)
class LearnedCondition(Condition):
    """A condition that needs a learned model.

    Attributes:
        learned: the learned model.
        method: by which that is learned.
    """

    learned: LearnedModel
    method: ClassVar[str]  # pyright: ignore[reportIncompatibleVariableOverride]  (never None)
    corrects_model = True
    autonomous = True

    def require_fit(self, problem: SafetyProblem) -> None:
        """Raise ConfigurationError for a model of another method or another problem."""
        method = getattr(self.learned, "method", None)
        if method != self.method:
            raise ConfigurationError(
                f"{self.name} needs what the method {self.method} learns; given is"
                f" {method or repr(self.learned)}"
            )
        # There may be further barriers; each constraint looks its own one up.
        barriers = tuple(str(problem.model.numeric(b.expression)) for b in problem.barriers)
        type(self.learned).check(replace(self.learned.signature, barriers=barriers), problem)

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> Condition:
        """Raise ConfigurationError: the condition needs a learned model; see `from_learned`."""
        raise ConfigurationError(
            f"{cls.name} needs a learned model: {cls.name}:file=FILE, with a file of"
            " `safe-envs identify`"
        )

    @classmethod
    def from_learned(cls, learned: Any, gains: Sequence[float], **settings: Any) -> Condition:
        """Return the condition of a learned model.

        Args:
            learned: the model.
            gains: rates p_1..p_r of a problem in 1/s, for conditions that have any.
            settings: further arguments of the condition.
        """
        return cls(learned, **settings)

    @property
    def learned_models(self) -> tuple[LearnedModel, ...]:
        """The learned model."""
        return (self.learned,)

    @property
    def parameters(self) -> dict[str, Any]:
        """Settings, and the file of the learned model or, without one, its checksum."""
        settings = {key: value for key, value in super().parameters.items() if key != "learned"}
        path = self.learned.path
        return {
            **settings,
            **({"sha256": self.learned.sha256[:12]} if path is None else {"file": str(path)}),
        }

    def _number_of(self, model: ControlAffineSDE, barrier: Barrier) -> int:
        """Return which of the learned barriers a barrier is."""
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
                f"{self.name} with a network in its constraint has no sampling margin of first"
                " order; give a number"
            )


def _at_least_zero(name: str, value: Any) -> None:
    if not is_nonnegative(value):
        raise ConfigurationError(f"{name} = {shown(value)}; give a number >= 0")


def require_share(name: str, value: Any) -> None:
    """Raise ConfigurationError unless a value is a number between 0 and 1.

    Args:
        name: what the message calls it.
        value: what was given.
    """
    if not (is_nonnegative(value) and 0 < value < 1):
        raise ConfigurationError(f"{name} = {shown(value)}; give a number above 0 and below 1")


@dataclass(frozen=True)
class LearnedHOCBF(LearnedCondition):
    """The HOCBF with learned residuals in the derivatives of h, and a margin for their errors.

        h^(r) + k_(r-1) h^(r-1) + ... + k_0 h >= e_r + sum_i k_i e_i + e_u |u|

    with h^(i) = L_f^i h + Delta_i and h^(r) = L_f^r h + Delta_r + (L_g L_f^(r-1) h + Sigma) u, f
    and g those of the model, k_i those of the polynomial with its roots at minus the rates, and e
    the errors that the residuals may have. For several inputs the last term is sqrt(m) |(e_u1 u_1,
    ..., e_um u_m)|, which is no smaller.

    Attributes:
        learned: the residuals.
        alpha: rates p_1..p_r in 1/s.
        level: quantile of the held-out errors that e is, for each residual.
        eps: one number for all e in its place; 0 for no margin.

    Source: thesis Eq. (3.18), (3.20), Prop. 3.3.2. The thesis takes one e for residuals of
        different units, and the largest |u| within the input bounds. Eq. (3.26) forgets the margin;
        an error e then settles at h = -e/(p_1 ... p_r).
    """

    learned: ResidualModel  # pyright: ignore[reportIncompatibleVariableOverride]  (narrower, and frozen)
    alpha: tuple[float, ...] = (1.0,)
    level: float = 0.95
    eps: float | None = None
    name = method = "learned-hocbf"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "alpha", positive_rates("alpha", self.alpha))
        require_share("level", self.level)
        if self.eps is not None:
            _at_least_zero("eps", self.eps)

    @classmethod
    def from_learned(
        cls, learned: ResidualModel, gains: Sequence[float], **settings: Any
    ) -> LearnedHOCBF:
        """Return the condition with all rates of a problem, unless others are given."""
        return cls(learned, **{"alpha": tuple(gains), **settings})

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint.

        Raises:
            RelativeDegreeError: the number of rates is not the relative degree.
            ConfigurationError: nothing was learned of the barrier.
        """
        self._require_no_first_order()
        part = self.learned.parts[self._number_of(model, barrier)]
        r, m = part.degree, model.m
        if len(self.alpha) != r:
            raise RelativeDegreeError(
                f"barrier {barrier.name} has relative degree {r} and needs as many rates;"
                f" {len(self.alpha)} given"
            )
        k = [sp.Float(value, 17) for value in (*gains_of_poles([-p for p in self.alpha]), 1.0)]
        eta = derivatives(model, barrier.expression, r, lie_derivative_f)
        require_smooth(model, barrier, eta[:-1], False)
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

    def believed(self, model: ControlAffineSDE) -> ControlAffineSDE:
        """Return the model, with the learned diffusion where that was learned."""
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
        require_smooth(model, barrier, eta[:-1], model.noisy)
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
