"""Base of the conditions, which turn a system and a barrier into a constraint on the input."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import sympy as sp

from safe_envs.dynamics.declarations import TIME
from safe_envs.dynamics.lie import Derivative, generator, lie_derivative_f, lie_derivative_g
from safe_envs.dynamics.min_max import clauses
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import (
    ConfigurationError,
    SafeEnvsError,
    SystemDefinitionError,
    shortened,
    shown,
)
from safe_envs.problem.barrier import Barrier
from safe_envs.wrappers.conditions.chain import require_smooth, resolved
from safe_envs.wrappers.conditions.constraint import AffineConstraint, either_of
from safe_envs.wrappers.conditions.names import COMMON

if TYPE_CHECKING:
    from safe_envs.problem.problem import SafetyProblem
    from safe_envs.wrappers.learning.models.base import LearnedModel
    from safe_envs.wrappers.learning.models.posterior import Posterior

FIRST_ORDER = "first-order"


class CredibleSet(NamedTuple):
    """The identified systems for all of which a condition is met.

    Attributes:
        posterior: their distribution.
        miss_probability: of the systems that the set leaves out.
    """

    posterior: Posterior
    miss_probability: float


@dataclass(frozen=True)
class Condition(ABC):
    """Base of the conditions, which are small frozen dataclasses of their parameters.

    A condition holds in continuous time, but an input is held for a control period dt. Along the
    held input the constraint psi = a u + b changes by dt psi' + O(dt^2), with psi' the derivative
    along the flow (for stochastic conditions the generator: then it is the expectation that
    changes). `sampling_margin` "first-order" therefore asks for psi >= 0 and psi + dt psi' >= 0, so
    that psi stays nonnegative over the period up to O(dt^2). Both hold at the executed input, in
    which psi' is quadratic; see `safe_envs.wrappers.filter_qp.period_search`. A number asks for psi
    >= that number.

    Attributes:
        name: under which messages show it; by default that of the class. Names of
            `safe_envs.wrappers.conditions.registry` are those of the command line.
        stochastic: whether it takes the noise into account.
        almost_sure: whether it keeps every path in the safe set under noise, where it can be met.
            Then it asks for unbounded control wherever noise acts at the edge.
        corrects_model: whether it corrects what the model gets wrong, so that it is of no use to a
            filter that knows the plant.
        method: by which the models that it needs are learned; None if it needs none.
        differentiates: whether it differentiates the barrier, which has to be smooth then.
        autonomous: whether it is only for models and barriers that neither hold signals nor the
            time, as what was learned or proved of one.
        sampling_margin: "none", "first-order", or a number >= 0 in the units of the constraint.
        belief: probability, for all control instants of an episode and all barriers together, with
            which the error of an estimate exceeds the margin of the belief barrier, whose chain
            takes the place of that of h; see `safe_envs.wrappers.conditions.belief`. None at a true
            state, and for certainty equivalence.
        measurement_error: bound of the error of each state, one number for all or one for each,
            within which the constraint is met; see `safe_envs.wrappers.conditions.bounded_error`.
            () for none.

    Raises:
        ConfigurationError: a parameter is out of its range.
    """

    name: ClassVar[str]
    stochastic: ClassVar[bool] = False
    almost_sure: ClassVar[bool] = False
    corrects_model: ClassVar[bool] = False
    method: ClassVar[str | None] = None
    differentiates: ClassVar[bool] = True
    autonomous: ClassVar[bool] = False

    sampling_margin: str | float = field(default="none", kw_only=True)
    belief: float | None = field(default=None, kw_only=True)
    measurement_error: tuple[float, ...] = field(default=(), kw_only=True)

    def __init_subclass__(cls) -> None:
        cls.name = cls.__dict__.get("name", cls.__name__)

    def __post_init__(self) -> None:
        margin = self.sampling_margin
        if margin not in ("none", FIRST_ORDER) and not is_nonnegative(margin):
            raise ConfigurationError(
                f"sampling_margin = {shown(margin)}; allowed: none, {FIRST_ORDER}, or a number >= 0"
            )

        if self.belief is not None and not (is_nonnegative(self.belief) and 0 < self.belief < 1):
            raise ConfigurationError(
                f"belief = {shown(self.belief)}; give a probability above 0 and below 1"
            )
        given = self.measurement_error
        errors = given if isinstance(given, tuple | list) else (given,)
        if not all(map(is_nonnegative, errors)):
            raise ConfigurationError(
                f"measurement_error = {shown(given)}; give a number >= 0, or one for each state"
            )
        object.__setattr__(self, "measurement_error", tuple(map(float, errors)))
        if self.belief is not None and self.measurement_error:
            raise ConfigurationError(
                f"belief = {self.belief} and measurement_error = {shown(given)} are two answers to"
                " the same error of the state; give one"
            )

    @property
    def derivative(self) -> Derivative:
        """D of the chain: the Lie derivative, or the Ito generator."""
        return generator if self.stochastic else lie_derivative_f

    def require_fit(self, problem: SafetyProblem) -> None:  # noqa: B027  (most conditions fit every problem)
        """Raise ConfigurationError where the condition is made for another problem."""

    def constraint(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint for a model and a barrier, in the model's symbols.

        A barrier that is a maximum has a constraint for each function, one of which is enough. A
        minimum has several constraints: see `parts`.

        Args:
            model: system that the filter knows.
            barrier: barrier h.

        Returns:
            The constraint, with its margin for sampling.

        Raises:
            RelativeDegreeError: The condition does not suit the barrier's relative degree.
            SystemDefinitionError: A class-K function, the barrier or the model cannot be
                differentiated as often as the chain needs, or the barrier is a minimum.
            ConfigurationError: The condition is only for models without signals and time, or the
                code of a condition from outside fails.
        """
        if self.belief is not None or self.measurement_error:
            raise ConfigurationError(
                f"{self.name} with belief or measurement_error is a condition at an estimate, which"
                " a filter has; what is asked for is of true states: leave them out"
            )
        if self.autonomous:
            _require_autonomous(self.name, model, barrier)
        if len(self.parts(barrier)) > 1:
            raise SystemDefinitionError(
                f"barrier {barrier.name} = {barrier.expression} is a minimum, which has several"
                " constraints; give one barrier for each of its pieces, or make a SafetyFilter,"
                " which does so"
            )
        functions = clauses(barrier.expression)[0] if self.splits else (barrier.expression,)
        try:
            found = [_constraint(self, model, Barrier(h, barrier.name)) for h in functions]
            noisy = self.stochastic and model.noisy
            return found[0] if len(found) == 1 else either_of(self.name, barrier, found, noisy)
        except SafeEnvsError:
            raise
        except (Exception, SystemExit) as error:
            raise ConfigurationError(
                f"{self.name} cannot derive its constraint on {barrier.name}"
                f" ({type(error).__name__}: {shortened(error)}); correct its class"
            ) from error

    @property
    def splits(self) -> bool:
        """Whether minima and maxima of functions are taken apart."""
        return self.differentiates and not self.is_learned

    def parts(self, barrier: Barrier) -> tuple[Barrier, ...]:
        """Return the barriers with a constraint each that keep a barrier: those it is the least of.

        Args:
            barrier: h.
        """
        found = clauses(barrier.expression) if self.splits else ()
        if len(found) < 2:
            return (barrier,)
        return tuple(
            Barrier(sp.Max(*each), f"{barrier.name}_{i}") for i, each in enumerate(found, 1)
        )

    def believed(self, model: ControlAffineSDE) -> ControlAffineSDE:
        """Return the system to differentiate along: the model, or a learned one."""
        return model

    @abstractmethod
    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint without a margin for sampling.

        Args:
            model: system to differentiate along.
            barrier: barrier h.

        Returns:
            The constraint.
        """

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> Condition:
        """Return the condition with the rates p_1..p_r of a problem, where it has any."""
        return cls()

    @property
    def learned_models(self) -> tuple[LearnedModel, ...]:
        """Learned models that the condition needs."""
        return ()

    @property
    def is_learned(self) -> bool:
        """Whether the condition needs a learned model."""
        return bool(self.learned_models)

    @property
    def credible_set(self) -> CredibleSet | None:
        """Identified systems for all of which the condition is met at once; None without any."""
        return None

    def chain_rates(self, degree: int) -> tuple[float, ...] | None:
        """Return alpha_1..alpha_r of the chain b_j = D b_(j-1) + alpha_j b_(j-1).

        Returns:
            Rates in 1/s; None for another form.
        """
        return None

    @property
    def parameters(self) -> dict[str, Any]:
        """Arguments that make the same condition, besides those of every condition."""
        given = {key: value for key, value in vars(self).items() if key not in COMMON}
        return {key: value for key, value in given.items() if value is not None}


def _require_autonomous(name: str, model: ControlAffineSDE, barrier: Barrier) -> None:
    """Raise ConfigurationError for a model or a barrier that changes by itself."""
    moving = [*model.signals, *([TIME] if model.uses_time else [])]
    moving += [TIME] if not moving and TIME in barrier.expression.free_symbols else []
    if moving:
        raise ConfigurationError(
            f"{name} was learned or proved for a system without signals, adjustable parameters and"
            f" time; {barrier.name} or the model depends on {', '.join(map(str, moving))}. Take a"
            " condition that needs nothing but a model, such as hocbf or szcbf"
        )


def _sympified(found: Any, inputs: int) -> AffineConstraint:
    """Return a constraint whose Python numbers are expressions; raise for anything else."""
    if not isinstance(found, AffineConstraint):
        raise TypeError(f"derived returns {type(found).__name__}, no AffineConstraint")
    if len(found.coefficient) != inputs:
        raise ValueError(f"{len(found.coefficient)} coefficients for {inputs} inputs")
    coefficient, chain = (tuple(map(sp.sympify, e)) for e in (found.coefficient, found.chain))
    offset, domain = sp.sympify(found.offset), tuple(map(sp.sympify, found.domain))
    return replace(found, coefficient=coefficient, offset=offset, chain=chain, domain=domain)


def is_nonnegative(value: Any) -> bool:
    """Return whether a value is a finite number of at least 0."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and 0 <= value < math.inf


@lru_cache(maxsize=256)
def _constraint(
    condition: Condition, model: ControlAffineSDE, barrier: Barrier
) -> AffineConstraint:
    """Derive a constraint; remembered, since derivatives of long expressions take their time."""
    model = condition.believed(model)
    found = _sympified(condition.derived(model, barrier), model.m)
    noisy = condition.stochastic and model.noisy
    if condition.differentiates:
        require_smooth(model, barrier, found.chain, noisy)
    if condition.sampling_margin == FIRST_ORDER:
        row = (
            sum(a * u for a, u in zip(found.coefficient, model.inputs, strict=True))
            + found.offset
            - (found.demand or 0)
        )
        require_smooth(model, barrier, [row], noisy, kinks=not noisy)
        by_input = (lie_derivative_g(model, row) * sp.Matrix(model.inputs))[0, 0]
        return replace(found, change=resolved(condition.derivative(model, row) + by_input, barrier))
    if condition.sampling_margin != "none":
        return replace(found, offset=found.offset - sp.Float(condition.sampling_margin, 17))
    return found
