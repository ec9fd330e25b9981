"""Checks of a condition, for its author."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import (
    ConfigurationError,
    NumericalError,
    SafeEnvsError,
    SystemDefinitionError,
)
from safe_envs.filters.conditions.base import AffineConstraint, Condition
from safe_envs.filters.conditions.text import parse_conditions, spec_of
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.safe_set import draw_starts
from safe_envs.registry import make_problem

_STEP = 1e-3
"""Of the finite differences, relative to the state."""

_TOLERANCE = 1e-5
"""Of the derivatives, relative to the largest over the samples."""

_KINKS = 0.1
"""Share of the states at which a class-K function or a barrier may have a kink, or a pole near."""

_SINGLE = 20
"""States at which a decision for one state is compared with that of the batch."""

_TIGHT = 1e-3
"""Share of the input bounds under which most conditions cannot be met at some of the states."""

Field = Callable[[np.ndarray], np.ndarray]


def check_condition(
    condition: Condition | str,
    problem: SafetyProblem | str = "Scalar-v0",
    *,
    samples: int = 200,
    seed: int = 0,
) -> None:
    """Check that a condition does what filters, evaluations and bounds take for granted.

    On every barrier of the problem: the text of the condition makes it again; the constraint has
    finite values in the safe set; its coefficients, its offset (where `chain_rates` is known) and
    the rate for a sampling margin agree with finite differences along the system; the filter
    decides for a batch as for one state, stays inside the input bounds, meets the constraint where
    it says so, and calls states infeasible where no action meets it.

    Args:
        condition: condition, or its text, such as "my_filter.py:Eager:gain=2".
        problem: problem, or the id of its env.
        samples: number of states and proposed inputs.
        seed: of the samples.

    Raises:
        AssertionError: A property does not hold; the message begins with its name.
        ConfigurationError: The text cannot be read.
        RelativeDegreeError: The condition does not suit the problem.
    """
    if isinstance(problem, str):
        problem = make_problem(problem)
    each = parse_conditions(condition, problem) if isinstance(condition, str) else (condition,)
    each = each * len(problem.barriers) if len(each) == 1 else each
    for one in each:
        _check_text(one, problem)
    try:
        safety_filter = SafetyFilter.for_problem(problem, each)
    except ConfigurationError as error:
        raise AssertionError(f"derived: {error}") from error
    rng = np.random.default_rng(seed)
    x = _states(problem, samples, rng, seed)
    low, high = np.array(problem.input_bounds).T
    u = rng.uniform(1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low, (samples, len(low)))
    constraints = zip(safety_filter.parts, safety_filter.constraints, strict=True)
    for (barrier, one), given in constraints:
        what = f"{one.name} on {barrier.name}"
        for constraint in given.alternatives or (given,):
            found = _Constraint(one.believed(safety_filter.model), one, constraint, what)
            found.check_values(x, u)
            if constraint.terms is None and constraint.uncertainty is None:
                found.check_derivatives(x, u)
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    for share in (1.0, _TIGHT):
        bounds = np.stack([middle - share * half, middle + share * half])
        tight = SafetyFilter(
            safety_filter.model, safety_filter.pairs, input_bounds=bounds.T.tolist(), dt=problem.dt
        )
        _check_decisions(tight, x, u, *bounds)


def _check_text(condition: Condition, problem: SafetyProblem) -> None:
    name = type(condition).__name__
    try:
        hash(condition)
    except TypeError as error:
        raise AssertionError(f"parameters: {name} cannot be hashed; use tuples: {error}") from error
    if any(model.path is None for model in condition.learned_models):
        return
    text = spec_of(condition)
    try:
        again = parse_conditions(text, problem)[0]
    except SafeEnvsError as error:
        raise AssertionError(
            f"text: {name} writes {text!r}, which cannot be read: {error}"
        ) from error
    _require(
        spec_of(again) == text and (again == condition or condition.is_learned),
        f"text: {name} writes {text!r}, from which {again} is read in place of {condition}",
    )


def _states(problem: SafetyProblem, count: int, rng: np.random.Generator, seed: int) -> np.ndarray:
    """Draw states where the problem is explored, inside and outside the safe set, and starts."""
    starts = draw_starts(problem, count, seed)
    try:
        low, high = np.array(problem.sampling_domain.region).T
    except SystemDefinitionError:
        return starts
    return np.where(rng.random((count, 1)) < 0.5, rng.uniform(low, high, starts.shape), starts)


class _Constraint:
    """The constraint of a condition as functions of states (B, n) and inputs (B, m)."""

    def __init__(
        self, model: ControlAffineSDE, condition: Condition, found: AffineConstraint, what: str
    ) -> None:
        self._model, self._condition, self._found, self._what = model, condition, found, what
        _require(bool(found.chain), f"chain: {what} has none; it begins with h")

    def _compiled(self, expressions: Sequence[Any], inputs: bool = False) -> Callable[..., Any]:
        symbols = (*self._model.states, *self._model.inputs * inputs)
        values = [self._model.numeric(e) for e in expressions]
        function = compile_function(symbols, values, "arrays")

        def at(*parts: np.ndarray) -> np.ndarray:
            with np.errstate(all="ignore"):
                return stacked(function(*np.hstack(parts).T), len(parts[0]))

        return at

    def check_values(self, x: np.ndarray, u: np.ndarray) -> None:
        """Check that the constraint is finite in the safe set."""
        found = self._found
        if found.terms is not None:  # these are values of a model, which the filter evaluates
            return
        h = self._compiled(found.chain[:1])(x)[:, 0]
        extra = [e for e in (found.demand, found.change) if e is not None]
        values = self._compiled([*found.coefficient, found.offset, *extra], inputs=True)(x, u)
        bad = np.flatnonzero((h > 0.0) & ~np.isfinite(values).all(axis=1))
        if bad.size:
            raise AssertionError(f"finite: {self._what} has no value at {x[bad[0]].tolist()}")

    def check_derivatives(self, x: np.ndarray, u: np.ndarray) -> None:
        """Check the coefficients, the offset and the rate of change by finite differences."""
        model, found = self._model, self._found
        last = self._compiled(found.chain[-1:])
        a = self._compiled(found.coefficient)(x)
        for j, column in enumerate(self._columns(model.input_matrix, x)):
            self._agree(f"coefficient of {model.inputs[j]}", a[:, j], _along(last, x, column))
        # A barrier of its own is no derivative of h.
        for j in range(len(found.chain) if self._condition.differentiates else 0):
            self._check_level(j, x)
        if found.change is not None:
            row = found.offset - (found.demand or 0)
            row += sum(c * s for c, s in zip(found.coefficient, model.inputs, strict=True))
            value = self._compiled([row], inputs=True)
            expected = self._rate(lambda y: value(y, u), x, u)
            self._agree("change", self._compiled([found.change], inputs=True)(x, u)[:, 0], expected)

    def _check_level(self, j: int, x: np.ndarray) -> None:
        """Check b_(j+1), or the offset at the end of the chain, against D b_j."""
        found, condition = self._found, self._condition
        end = j + 1 == len(found.chain)
        name = "offset" if end else f"b_{j + 1} of the chain"
        value = self._compiled([found.offset if end else found.chain[j + 1]])(x)[:, 0]
        if end and isinstance(condition.sampling_margin, int | float):
            value = value + condition.sampling_margin
        function = self._compiled(found.chain[j : j + 1])
        level, rate = function(x)[:, 0], self._rate(function, x)
        rates = condition.chain_rates(len(found.chain))
        if found.demand is not None:
            rates = (0.0,) * len(found.chain)
        if rates is not None:
            self._agree(name, value, rate + rates[j] * level)
            return
        scale = 1.0 + np.abs(rate[np.isfinite(rate)]).max(initial=0.0)
        loose = np.flatnonzero((level < 0.0) & (value - rate > _TOLERANCE * scale))
        _require(
            not loose.size,
            f"class K: the {name} of {self._what} lets b_{j} fall where it is negative, such as at"
            f" {x[loose[:1]].tolist()}",
        )

    def _columns(self, matrix: Any, x: np.ndarray) -> list[np.ndarray]:
        return [self._compiled(list(matrix[:, j]))(x) for j in range(matrix.cols)]

    def _rate(self, value: Field, x: np.ndarray, u: np.ndarray | None = None) -> np.ndarray:
        """Return D of a function (B, 1) along the system, under an input or without."""
        model = self._model
        (flow,) = self._columns(model.drift, x)
        if u is not None:
            flow = flow + sum(
                column * u[:, j : j + 1]
                for j, column in enumerate(self._columns(model.input_matrix, x))
            )
        rate = _along(value, x, flow)
        for column in self._columns(model.diffusion, x) if self._condition.stochastic else ():
            rate = rate + 0.5 * _along(value, x, column, twice=True)
        return rate

    def _agree(self, name: str, found: np.ndarray, expected: np.ndarray) -> None:
        known = np.isfinite(found) & np.isfinite(expected)
        scale = 1.0 + np.abs(expected[known]).max(initial=0.0)
        wrong = np.flatnonzero(known & (np.abs(found - expected) > _TOLERANCE * scale))
        _require(
            len(wrong) <= _KINKS * len(found),
            f"derivatives: the {name} of {self._what} differs from finite differences at"
            f" {len(wrong)} of {len(found)} states, such as {found[wrong[:1]].tolist()} in place of"
            f" {expected[wrong[:1]].tolist()}",
        )


def _along(value: Field, x: np.ndarray, direction: np.ndarray, twice: bool = False) -> np.ndarray:
    """Return the derivative, or the second one, of a function (B, 1) along directions (B, n)."""
    length = np.linalg.norm(direction, axis=1)
    step = _STEP * (1.0 + np.abs(x).max(axis=1)) / np.where(length > 0.0, length, 1.0)
    values = [value(x + k * step[:, None] * direction)[:, 0] for k in (-2, -1, 0, 1, 2)]
    weights = (-1, 16, -30, 16, -1) if twice else (1, -8, 0, 8, -1)
    total = sum(w * v for w, v in zip(weights, values, strict=True))
    return total / (12.0 * step ** (2 if twice else 1))


def _check_decisions(
    safety_filter: SafetyFilter, x: np.ndarray, u: np.ndarray, low: np.ndarray, high: np.ndarray
) -> None:
    name = ", ".join(sorted({condition.name for _, condition in safety_filter.pairs}))
    try:
        found = safety_filter.filter(x, u)
        single = [safety_filter.filter(x[i], u[i]) for i in range(min(_SINGLE, len(x)))]
    except NumericalError as error:
        raise AssertionError(f"finite: the filter of {name} has no decision: {error}") from error
    for i, one in enumerate(single):
        same = np.allclose(one.action, found.action[i], rtol=1e-7, atol=1e-7 * np.max(high - low))
        _require(
            same and one.feasible == found.feasible[i],
            f"batch: {name} decides {one.action.tolist()} for the state {x[i].tolist()} alone, and"
            f" {found.action[i].tolist()} in a batch",
        )
    inside = (found.action >= low) & (found.action <= high)
    _require(bool(inside.all()), f"bounds: {name} leaves the input bounds")
    flagged = (found.slack <= 0.0).all(axis=1) | ~found.feasible
    _require(bool(flagged.all()), f"infeasible: {name} has a slack where it is feasible")
    first, *others = safety_filter.constraints
    if (
        others
        or first.alternatives
        or any(
            part is not None
            for part in (first.demand, first.change, first.uncertainty, first.terms)
        )
    ):
        return
    a, b = _affine(safety_filter, x)
    best = np.maximum(a * low, a * high).sum(axis=1) + b
    clear = np.abs(best) > 1e-9 * (np.abs(a).sum(axis=1) * np.abs(high - low).max() + np.abs(b))
    _require(
        bool((found.feasible == (best >= 0.0))[clear].all()),
        f"infeasible: {name} is feasible where no action meets it, or not where one does",
    )


def _affine(safety_filter: SafetyFilter, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients (B, m) and the offset (B,) of the only constraint."""
    model, (constraint,) = safety_filter.model, safety_filter.constraints
    expressions = [model.numeric(e) for e in (*constraint.coefficient, constraint.offset)]
    values = stacked(compile_function(model.states, expressions, "arrays")(*x.T), len(x))
    return values[:, :-1], values[:, -1]


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise AssertionError(message)
