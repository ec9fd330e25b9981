"""Base of the conditions, which turn a system and a barrier into a constraint on the input."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import sympy as sp

from safe_envs.dynamics.codegen import Components
from safe_envs.dynamics.kinks import STEPS, edges, is_bent, switches
from safe_envs.dynamics.lie import (
    Derivative,
    generator,
    gradient,
    lie_derivative_f,
    lie_derivative_g,
    relative_degree,
    tidied,
    vanishes,
)
from safe_envs.dynamics.min_max import MOST, clauses
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.dynamics.symbols import TIME
from safe_envs.engine.formulas import Source
from safe_envs.engine.program import has_own_source
from safe_envs.engine.slots import Data
from safe_envs.errors import (
    ConfigurationError,
    NotCompilableError,
    SafeEnvsError,
    SystemDefinitionError,
    shortened,
    shown,
)
from safe_envs.filters.conditions.class_k import ClassK, Rate, applied
from safe_envs.filters.conditions.names import COMMON, wrong_rates
from safe_envs.problem.problem import Barrier, SafetyProblem

if TYPE_CHECKING:
    from safe_envs.filters.learning.models.base import LearnedModel
    from safe_envs.filters.learning.models.posterior import Posterior


def chain_of(
    model: ControlAffineSDE, barrier: Barrier, alphas: Sequence[Rate] | None, derivative: Derivative
) -> tuple[list[sp.Expr], sp.Expr]:
    """Return a chain and its end without the input.

    It is b_0 = h, b_j = D b_(j-1) + alpha_j(b_(j-1)) for j < r; the end is that part of b_r.

    Args:
        model: the system that D differentiates along.
        barrier: h.
        alphas: alpha_1..alpha_r; None for zeros, with r computed.
        derivative: D, the Lie derivative or the Ito generator.

    Returns:
        b_0, ..., b_(r-1), and the part of b_r without the input.

    Raises:
        RelativeDegreeError: the number of functions is not the relative degree, or there is none.
        SystemDefinitionError: the barrier or a class-K function cannot be differentiated as often
            as the chain needs.
    """
    degree = relative_degree(model, barrier.expression, derivative)
    if alphas is not None and len(alphas) != degree:
        raise wrong_rates(barrier.name, degree, len(alphas))
    for j, alpha in enumerate(alphas or (), start=1):
        if isinstance(alpha, ClassK) and not alpha.is_smooth(degree - j):
            raise SystemDefinitionError(
                f"class-K function {alpha} is the {j}. of {degree} and needs {degree - j}"
                " continuous derivatives, which it has not at 0; use an odd power or another"
                " smooth function there"
            )
    chain = [barrier.expression]
    for alpha in alphas or (None,) * degree:
        term = 0 if alpha is None else applied(alpha, chain[-1])
        chain.append(resolved(derivative(model, chain[-1]), barrier) + term)
    return chain[:-1], chain[-1]


def resolved(expression: Any, barrier: Barrier) -> sp.Expr:
    """Return a derivative of a chain without what sympy adds where functions have kinks.

    It has no weight where what is differentiated is continuous; see `require_smooth`.

    Args:
        expression: the derivative.
        barrier: barrier of the chain.

    Raises:
        SystemDefinitionError: sympy cannot differentiate.
    """
    if expression.has(sp.Derivative, sp.Subs):
        raise SystemDefinitionError(
            f"barrier {barrier.name} = {barrier.expression} cannot be differentiated as often as is"
            " needed; give a smooth one, of real symbols"
        )
    return expression.replace(sp.DiracDelta, lambda *_: sp.Integer(0))


def require_smooth(
    model: ControlAffineSDE,
    barrier: Barrier,
    functions: Sequence[sp.Expr],
    noisy: bool,
    kinks: bool = False,
) -> None:
    """Raise SystemDefinitionError where functions cannot be differentiated along a system.

    Where one jumps, its derivative lacks the jump. Where it has a kink, the two sides have their
    own constraints. The chain is right where states only pass, which they do where neither the
    input nor noise acts across the kink. Where the input does, it may hold the state there, by
    turns of inputs that the two sides allow, with a mean that neither allows. Where noise does, the
    generator lacks a local time.

    Args:
        model: the system.
        barrier: barrier of the chain.
        functions: that are differentiated.
        noisy: whether noise counts.
        kinks: whether they may have kinks anywhere.
    """
    for function in filter(is_bent, functions):
        known = model.exact(function)
        for edge in edges(known, model.measured):
            raise _not_smooth(model, barrier, edge, "may jump", "which its derivative leaves out")
        for edge in () if kinks else edges(known, model.measured, 1):
            across: list[Any] = [*lie_derivative_g(model, edge)]
            across += [*(gradient(model, edge) * model.diffusion)] if noisy else []
            speed = model.exact(lie_derivative_f(model, edge))
            if edges(speed, model.measured) or not all(vanishes(model, e) for e in across):
                why = "across which an input or noise acts"
                raise _not_smooth(model, barrier, edge, "may have a kink", why)


def _not_smooth(
    model: ControlAffineSDE, barrier: Barrier, edge: Any, what: str, why: str
) -> SystemDefinitionError:
    """Return the error of a chain that is not smooth, with the function that makes it so."""
    parts = {f"the drift of {s}": e for s, e in zip(model.states, model.drift, strict=True)}
    parts |= {"the input matrix": model.input_matrix, "the diffusion": model.diffusion}
    entries = [(name, e) for name, part in parts.items() for e in sp.flatten([part])]
    causes = [(name, e) for name, e in entries if edge in switches(model.exact(e))]
    place = f"where {edge} = 0" if isinstance(edge, sp.Expr) else f"by {edge}"
    place = f"by {edge}" if isinstance(edge, STEPS) else place
    reason = f"{what}{'' if edge.atoms(sp.Dummy) else f' {place}'}, {why}"
    if edge in switches(model.exact(barrier.expression)) or not causes:
        others = f"a smooth one, a sum of multiples of Min, Max and Abs of up to {MOST} ones, or "
        others *= len(clauses(barrier.expression)) == 1
        return SystemDefinitionError(
            f"barrier {barrier.name} = {barrier.expression} {reason}; give {others}one barrier for"
            " each of its pieces"
        )
    name, expression = causes[0]
    return SystemDefinitionError(
        f"{name} = {expression} {reason}; the chain of barrier {barrier.name} differentiates it:"
        " give a smooth function, such as tanh for a step, or another barrier"
    )


class Terms(Protocol):
    """Numbers of a learned model in a constraint, whose expressions hold symbols for them."""

    @property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        """Symbols of the numbers."""
        ...

    def floats(self, x: Sequence[float]) -> Sequence[float]:
        """Return the values at one state, given by components."""
        ...

    def arrays(self, x: Components) -> Components:
        """Return the values at a batch of states, components of shape (B,) in and out."""
        ...

    def source(self, name: str, data: Data) -> Source:
        """Return a function `name(x, data, work)` of the state, a tuple, that gives the values.

        Args:
            name: of the function, with which the names of other generated functions begin.
            data: receives its numbers.
        """
        ...


def terms_source(terms: Terms, name: str, data: Data) -> Source:
    """Return learned numbers as a function of a compiled program; see `Terms.source`.

    Args:
        terms: whose values it gives. They need no method `source`, as far as this is not called.
        name: of the function.
        data: receives its numbers.

    Raises:
        NotCompilableError: They have no method of their own for that.
    """
    if not has_own_source(terms, "floats", "arrays"):
        raise NotCompilableError(
            f"the learned terms {type(terms).__name__} have no compiled form, which their method"
            " source(name, data) would give"
        )
    return terms.source(name, data)


@dataclass(frozen=True)
class AffineConstraint:
    """The constraint a(x) u + b(x) >= 0 that a condition asks for.

    Attributes:
        coefficient: a, an expression for each input.
        offset: b.
        chain: b_0 = h, ..., b_(r-1); the condition keeps the intersection of {b_j >= 0}, not C
            itself.
        demand: of a reciprocal condition, which asks for a u + b >= demand where h > 0 and has no
            meaning elsewhere. There a u + b is the rate of h, and all that is left is to make that
            as large as the other constraints allow.
        domain: expressions that are all positive where the demand has a meaning, of a certificate's
            constraint for example; h, by more than its rounding, where none are given.
        change: rate of the constraint while the input is held, an expression of states and inputs,
            where a margin of first order is asked for.
        uncertainty: where a and b are known up to an error only, the entries (i, j), i <= j, of the
            symmetric Q(x) with which the condition asks for a u + b >= sqrt([1, u]' Q [1, u]).
        terms: learned numbers in the expressions, whose symbols are no states.
        alternatives: constraints of the functions of a barrier that is their maximum, of which one
            is enough; what else is stated is that of the first.
    """

    coefficient: tuple[sp.Expr, ...]
    offset: sp.Expr
    chain: tuple[sp.Expr, ...]
    demand: sp.Expr | None = None
    change: sp.Expr | None = None
    uncertainty: tuple[sp.Expr, ...] | None = None
    terms: Terms | None = None
    domain: tuple[sp.Expr, ...] = ()
    alternatives: tuple[AffineConstraint, ...] = ()

    @property
    def functions(self) -> tuple[sp.Expr, ...]:
        """The barrier, or the functions that it is the maximum of; () where none is stated."""
        return tuple(c.chain[0] for c in self.alternatives or (self,) if c.chain)

    @classmethod
    def after(
        cls,
        model: ControlAffineSDE,
        chain: Sequence[sp.Expr],
        offset: sp.Expr,
        demand: sp.Expr | None = None,
    ) -> AffineConstraint:
        """Return the constraint L_g b_(r-1) u + offset >= 0, or >= demand, at the end of a chain.

        Args:
            model: system that the chain was derived for.
            chain: b_0, ..., b_(r-1).
            offset: part of b_r without the input.
            demand: see the class.
        """
        # What sympy adds at kinks has no weight: see `safe_envs.filters.conditions.base`.
        a: Any = lie_derivative_g(model, chain[-1]).replace(sp.DiracDelta, lambda *_: sp.Integer(0))
        return cls(
            tuple(tidied(a[0, j]) for j in range(model.m)), tidied(offset), tuple(chain), demand
        )


def either_of(
    name: str, barrier: Barrier, found: Sequence[AffineConstraint], noisy: bool
) -> AffineConstraint:
    """Return the constraint of a barrier that is a maximum.

    Args:
        name: of the condition.
        barrier: h.
        found: constraints of the functions that it is the maximum of.
        noisy: whether the condition takes noise into account.

    Raises:
        SystemDefinitionError: The constraint of one function is not enough.
    """
    special = [p for c in found for p in (c.demand, c.change, c.uncertainty, c.terms)]
    if noisy or any(part is not None for part in special):
        raise SystemDefinitionError(
            f"barrier {barrier.name} = {barrier.expression} is a maximum, which {name} cannot keep:"
            " the constraint of one of its functions is enough only without noise, uncertainty,"
            " reciprocal demands and first-order margins. Take cbf, ecbf or hocbf, or a smooth"
            " function below it, such as log((exp(k*a) + exp(k*b))/2)/k for Max(a, b)"
        )
    return replace(found[0], alternatives=tuple(found))


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
    which psi' is quadratic; see `safe_envs.engine.decide`. A number asks for psi
    >= that number.

    Attributes:
        name: under which messages show it; by default that of the class. Names of
            `safe_envs.filters.conditions.registry` are those of the command line.
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
            takes the place of that of h; see `safe_envs.filters.conditions.estimates`. None at a
            true state, and for certainty equivalence.
        measurement_error: bound of the error of each state, one number for all or one for each,
            within which the constraint is met; see `safe_envs.filters.conditions.estimates`.
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


Pairs = tuple[tuple[Barrier, Condition], ...]
"""Barriers with their conditions."""


def parts_of(pairs: Pairs) -> tuple[tuple[int, ...], Pairs]:
    """Return what has a constraint: the number of its barrier, and the part of it.

    Args:
        pairs: barriers with their conditions.
    """
    found = [(i, part, c) for i, (b, c) in enumerate(pairs) for part in c.parts(b)]
    return tuple(i for i, *_ in found), tuple((part, c) for _, part, c in found)


def with_parts(
    problem: SafetyProblem, conditions: Sequence[Condition]
) -> tuple[SafetyProblem, tuple[Condition, ...]]:
    """Return a problem and its conditions with a barrier for each constraint.

    Args:
        problem: the problem.
        conditions: one for each of its barriers.
    """
    owners, parts = parts_of(tuple(zip(problem.barriers, conditions, strict=True)))
    if len(parts) == len(problem.barriers):
        return problem, tuple(conditions)
    gains = tuple(problem.gains_of(i) for i in owners)
    barriers = tuple(barrier for barrier, _ in parts)
    return replace(problem, barriers=barriers, gains=gains), tuple(c for _, c in parts)
