"""A safety filter as a layer of a torch network, through which gradients pass.

The action is the one that `safe_envs.wrappers.SafetyFilter` returns. What is differentiated is the
formula that gives it near a state: the constraints that bind are equations there, the inputs at
their bounds are constants, and of the inputs that are left those nearest to the proposal
solve a linear system. So the derivative is exact, and of any order, where the active set does not
change. At a kink it is that of one side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
import sympy as sp
import torch
from sympy.printing.pytorch import TorchPrinter

from safe_envs.dynamics.codegen import in_plain_names
from safe_envs.errors import ConfigurationError, InvalidInputError, shown
from safe_envs.filters.arguments import WIDEST
from safe_envs.filters.conditions.syntax import name_by_itself
from safe_envs.filters.conditions.text import Conditions
from safe_envs.filters.qp import FilterQP
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.problem.problem import SafetyProblem

_RANK = 1e-9
"""Singular values below this share of the largest are the rounding of constraints that depend on
each other."""

_EXACT = 1e-11
"""How near an input at its bound is, as a share of its way there or of the input bounds."""

_NOTHING = 1e-8
"""Share of a force that is rounding."""


class ActiveSets:
    """The active sets of the decisions of a QP."""

    def __init__(self, qp: FilterQP) -> None:
        self.low, self.high = np.array(qp.low), np.array(qp.high)
        self.roots = np.sqrt(qp.weights)
        self.priorities = np.array(qp.priorities)

    def of(
        self, a: np.ndarray, v: np.ndarray, u: np.ndarray, active: np.ndarray, slack: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what holds the actions of R states.

        Args:
            a: coefficients of the constraints, shape (R, k, m).
            v: proposed inputs, shape (R, m).
            u: actions, shape (R, m).
            active: active constraints, shape (R, k).
            slack: their slacks, shape (R, k).

        Returns:
            Inputs that are held at their bounds (R, m), constraints that cannot be met, and
            constraints that bind (R, k), which are equations.
        """
        way = self.roots * (u - v)
        near = np.minimum(
            self.high - self.low, np.linalg.norm(way, axis=1, keepdims=True) / self.roots
        )
        missed = slack > 0.0
        binding = active & ~missed
        # A single constraint presses every input on which it depends.
        pressed = (way != 0.0) | ((a != 0.0) & active[:, :, None]).any(axis=1)
        held = pressed & ((u - self.low <= _EXACT * near) | (self.high - u <= _EXACT * near))
        # Several constraints may not all be needed.
        several = (np.count_nonzero(active, axis=1) > 1) | (missed.any(axis=1) & (a.shape[1] > 1))
        for i in np.flatnonzero(several):
            forced = self._forced(a[i], u[i], slack[i])
            low, high = [
                ~forced & (gap <= _EXACT * near[i]) for gap in (u[i] - self.low, self.high - u[i])
            ]
            also, binding[i] = _held_and_binding(
                a[i] / self.roots, way[i], low, high, forced, missed[i], binding[i]
            )
            held[i] = forced | also
        return held, missed, binding

    def _forced(self, a: np.ndarray, u: np.ndarray, slack: np.ndarray) -> np.ndarray:
        """Return the inputs (m,) that unmet constraints press against their bounds."""
        # The sum of the forces decides; a (k, m), slack (k,).
        forces = (self.priorities * slack)[:, None] * a
        force, size = forces.sum(axis=0), np.abs(forces).sum(axis=0)
        gap = np.where(force > 0.0, self.high - u, u - self.low)
        return (np.abs(force) > _NOTHING * size) & (gap <= _EXACT * (self.high - self.low))


def nearest_step(
    a: torch.Tensor, gaps: torch.Tensor, weights: np.ndarray, binding: np.ndarray
) -> torch.Tensor:
    """Return the shortest steps z (R, m) that meet the binding constraints as equations.

    These are a z + gaps = 0; before, |weights (a z + gaps)|^2 is minimised.

    Args:
        a: coefficients of the constraints, in units of the weights, shape (R, k, m).
        gaps: their values at z = 0, shape (R, k).
        weights: of the constraints that cannot be met, 0 for others, shape (R, k).
        binding: constraints that bind, shape (R, k).
    """
    step = a.new_zeros(a.shape[0], a.shape[2])
    walls = a
    if weights.any():
        lost = torch.from_numpy(weights)
        compromise = lost[:, :, None] * a
        inverse = torch.linalg.pinv(compromise, rtol=_RANK)
        step = -(inverse @ (lost * gaps)[:, :, None])[:, :, 0]
        # Along these directions nothing changes for the constraints that cannot be met.
        walls = a - (a @ inverse) @ compromise
    sizes = torch.linalg.vector_norm(a.detach(), dim=-1)
    scale = torch.from_numpy(binding) / torch.where(sizes > 0.0, sizes, 1.0)
    left = scale * (gaps + (a @ step[:, :, None])[:, :, 0])
    return (
        step
        - (torch.linalg.pinv(scale[:, :, None] * walls, rtol=_RANK) @ left[:, :, None])[:, :, 0]
    )


def _held_and_binding(
    a: np.ndarray,
    way: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    fixed: np.ndarray,
    missed: np.ndarray,
    binding: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inputs (m,) and constraints (k,) that hold the action of one state where it is."""
    # The signs of their multipliers say so.
    #
    # The way from the proposal to the action is a nonnegative sum of the normals of the constraints
    # that bind and of the input bounds, and of those of the missed constraints in either direction,
    # since the way must not change what these miss. Nonnegative least squares uses independent ones
    # only.
    left, m = ~fixed, len(way)
    size = np.abs(way[left]).max(initial=0.0)
    if size == 0.0:
        return np.zeros(m, dtype=bool), binding
    lengths = np.linalg.norm(a[:, left], axis=1)
    units = a / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    normals = np.concatenate([units, -units, np.eye(m), -np.eye(m)])
    candidates = np.flatnonzero(np.concatenate([binding | missed, missed, low, high]))
    shares = np.zeros(len(normals))
    shares[candidates] = scipy.optimize.nnls(normals[np.ix_(candidates, left)].T, way[left] / size)[
        0
    ]
    of_rows, _, of_low, of_high = np.split(shares > _NOTHING, np.cumsum([len(a), len(a), m]))
    return of_low | of_high, of_rows & binding


class _Printer(TorchPrinter):
    """Writes Python's operators, or `_FUNCTIONS`, where torch takes tensors only."""

    def _print_Pow(self, expr: Any) -> str:  # noqa: N802  (sympy's dispatch by name)
        return f"({self._print(expr.base)})**({self._print(expr.exp)})"

    def _print_Relational(self, expr: Any) -> str:  # noqa: N802
        return f"({self._print(expr.lhs)}) {expr.rel_op} ({self._print(expr.rhs)})"

    def _print_Piecewise(self, expr: Any) -> str:  # noqa: N802
        parts = [self._print(part) for piece in expr.args for part in piece.args]
        return f"Piecewise({', '.join(parts)})"

    def _named(self, expr: Any) -> str:
        return f"{expr.func.__name__}({', '.join(map(self._print, expr.args))})"

    _print_Max = _print_Min = _print_Heaviside = _named  # noqa: N815


def _tensors(parts: Sequence[Any]) -> tuple[torch.Tensor, ...]:
    return torch.broadcast_tensors(*[torch.as_tensor(part, dtype=torch.float64) for part in parts])


def _pieces(*parts: Any) -> torch.Tensor:
    """Return the first of value, condition, value, condition, ... whose condition holds."""
    values, conditions = _tensors(parts[::2]), parts[1::2]
    result = torch.full_like(values[0], float("nan"))
    for value, condition in reversed(list(zip(values, conditions, strict=True))):
        result = torch.where(torch.as_tensor(condition), value, result)
    return result


_FUNCTIONS: dict[str, Any] = {
    "Max": lambda *parts: torch.stack(_tensors(parts)).amax(dim=0),
    "Min": lambda *parts: torch.stack(_tensors(parts)).amin(dim=0),
    "Heaviside": lambda *parts: torch.heaviside(*_tensors(parts)),
    "Piecewise": _pieces,
    "torch": torch,
}


def compiled_constraints(
    qp: FilterQP,
) -> Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]:
    """Return the function from states (B, n) to the constraints' a (B, k, m) and b (B, k).

    Raises:
        ConfigurationError: A constraint holds a function that torch does not have.
    """
    model, k = qp.model, len(qp.constraints)
    expressions = [model.numeric(e) for c in qp.constraints for e in (*c.coefficient, c.offset)]
    unknown = {
        f.func
        for e in expressions
        for f in e.atoms(sp.Function)
        if f.func not in TorchPrinter.mapping
    }
    unknown -= {sp.Piecewise, sp.Heaviside}
    if unknown:
        raise ConfigurationError(
            f"torch has no {', '.join(sorted(map(str, unknown)))}, which a constraint holds;"
            " write it with other functions"
        )
    # Torch's functions take no plain numbers.
    numbers = [
        e.xreplace({c: c.evalf(17) for c in e.atoms(sp.NumberSymbol, sp.Function) if c.is_number})
        for e in expressions
    ]
    names, formulas = in_plain_names(model.states, numbers)
    function = sp.lambdify(
        names, formulas, modules=[_FUNCTIONS], printer=_Printer, cse=True, docstring_limit=0
    )

    def rows(states: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        entries = torch.stack(
            [states.new_zeros(len(states)) + e for e in function(*states.unbind(dim=1))], dim=-1
        )
        table = entries.reshape(len(states), k, model.m + 1)
        return table[:, :, :-1], table[:, :, -1]

    return rows


_AGREED = 1e-6
"""How far apart, as a share of the input bounds, an action and its formula are, at most."""


class TorchResult(NamedTuple):
    """What a filter decides, for a batch with leading axes `...`, m inputs and k constraints.

    Attributes:
        action: executed input, shape (..., m), within the input bounds; only this one has a
            gradient.
        feasible: whether some action within the input bounds meets every constraint, shape (...).
        active: constraints that bind or cannot be met, shape (..., k).
        differentiable: whether the gradient is that of the action, shape (...); where not, it is
            zero. It says so whether or not a gradient was asked for.
    """

    action: torch.Tensor
    feasible: torch.Tensor
    active: torch.Tensor
    differentiable: torch.Tensor


class TorchFilter(torch.nn.Module):
    """A safety filter in physical units, differentiable in the proposed input and in the state.

    Where the constraints cannot all be met, the action is the least-violating one, and its gradient
    is that of this action: zero along the inputs that stay in a corner of the input bounds, and
    with several constraints that of their weighted compromise. Where the formula does not give the
    action, as it may not where its equations are nearly dependent, the gradient is zero, and the
    result says so.

    It runs on the CPU and in double precision, whatever the tensors are.

    Args:
        safety_filter: whose actions are returned.

    Raises:
        ConfigurationError: a constraint is not a plain one: uncertain, reciprocal, with a network
            or a sampling margin of first order; or the filter pursues a goal, or acts by itself, as
            the promise filter; or a constraint holds a function that torch does not have.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        super().__init__()
        if not isinstance(safety_filter, SafetyFilter):
            raise _not_differentiable(type(safety_filter).__name__)
        # The formula is of constraints, of which a barrier may have several.
        safety_filter = safety_filter.by_constraint()
        # The filter keeps its qp to its solvers, which share it.
        qp = safety_filter.qp
        _require_plain(safety_filter, qp)
        self.safety_filter = safety_filter
        self._sets = ActiveSets(qp)
        self._constraints = compiled_constraints(qp)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the compiled constraints, which a copy makes itself."""
        return {key: value for key, value in vars(self).items() if key != "_constraints"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._constraints = compiled_constraints(self.safety_filter.qp)

    @classmethod
    def for_problem(
        cls,
        problem: SafetyProblem,
        filters: Conditions,
        knowledge: str = "model",
        priorities: Sequence[float] | None = None,
    ) -> TorchFilter:
        """Return the filter for the barriers of a problem; see `SafetyFilter.for_problem`."""
        if isinstance(filters, str) and name_by_itself(filters):
            raise _not_differentiable(filters)
        return cls(SafetyFilter.for_problem(problem, filters, knowledge, priorities=priorities))

    def forward(self, x: torch.Tensor, u: torch.Tensor, return_result: bool = False) -> Any:
        """Decide for a batch.

        Args:
            x: states, shape (..., n).
            u: proposed inputs, shape (..., m), in physical units.
            return_result: whether to return the flags with the action.

        Returns:
            The action, shape (..., m), of the type of `u` and on its device; or a `TorchResult`
            with it.

        Raises:
            InvalidInputError: a shape or a type does not fit, or an entry is not finite.
            NumericalError: a constraint has no finite value at a state.
        """
        if not (isinstance(x, torch.Tensor) and isinstance(u, torch.Tensor)):
            raise InvalidInputError(
                f"state {type(x).__name__} and input {type(u).__name__}; give tensors, such as"
                " torch.as_tensor(x)"
            )
        if not (x.is_floating_point() and u.is_floating_point()):
            raise InvalidInputError(
                f"state {x.dtype} and input {u.dtype}; give real floating-point tensors, such as"
                " x.double()"
            )
        given = [part.detach().to("cpu", torch.float64).numpy() for part in (x, u)]
        found = self.safety_filter.filter(*given)
        action, differentiable = (
            torch.from_numpy(found.action),
            torch.ones(found.action.shape[:-1], dtype=torch.bool),
        )
        if return_result or (torch.is_grad_enabled() and (x.requires_grad or u.requires_grad)):
            states, inputs = [
                part.to("cpu", torch.float64).reshape(-1, part.shape[-1]) for part in (x, u)
            ]
            formula, agrees = self._formula(states, inputs, found)
            formula, differentiable = (
                formula.reshape(action.shape),
                agrees.reshape(differentiable.shape),
            )
            action = action + (formula - formula.detach())
        action = action.to(u.device, u.dtype)
        flags = [
            torch.as_tensor(part, device=u.device)
            for part in (found.feasible, found.active, differentiable)
        ]
        return TorchResult(action, *flags) if return_result else action

    def _formula(
        self, states: torch.Tensor, inputs: torch.Tensor, found: Any
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the actions (B, m) as functions of states (B, n) and inputs (B, m)."""
        sets = self._sets
        m, k = len(sets.low), len(sets.priorities)
        action, active, slack = (
            found.action.reshape(-1, m),
            found.active.reshape(-1, k),
            found.slack.reshape(-1, k),
        )
        # Where no constraint acts, the state's gradient is zero, and not missing.
        result = (
            inputs.clamp(torch.from_numpy(sets.low), torch.from_numpy(sets.high))
            + 0.0 * states[:, :1]
        )
        everywhere = torch.ones(len(states), dtype=torch.bool)
        acting = np.flatnonzero(active.any(axis=1))
        if self.safety_filter.qp.partial and acting.size:
            # With a barrier without a value there is no formula.
            with torch.no_grad():
                parts = self._constraints(states[acting])
            lost = ~torch.stack([p.isfinite().flatten(1).all(dim=1) for p in parts]).all(dim=0)
            without = torch.from_numpy(acting)[lost]
            result = result.index_copy(0, without, torch.from_numpy(action)[without])
            everywhere[without] = False
            acting = acting[~lost.numpy()]
        if not acting.size:
            return result, everywhere
        places = torch.from_numpy(acting)
        a, b = self._constraints(states[places])
        held, missed, binding = sets.of(
            a.detach().numpy(),
            inputs.detach().numpy()[acting],
            action[acting],
            active[acting],
            slack[acting],
        )
        decided = torch.from_numpy(action[acting])
        start = torch.where(torch.from_numpy(held), decided, inputs[places])
        gaps = (a * start[:, None, :]).sum(dim=-1) + b
        roots = torch.from_numpy(sets.roots)
        rows = torch.where(torch.from_numpy(held)[:, None, :], 0.0, a / roots)
        weights = missed * np.sqrt(sets.priorities)
        solution = start + nearest_step(rows, gaps, weights, binding) / roots
        agrees = (
            (solution - decided).abs() <= torch.from_numpy(_AGREED * (sets.high - sets.low))
        ).all(dim=1)
        formula = torch.where(agrees[:, None], solution, decided)
        return result.index_copy(0, places, formula), everywhere.index_copy(0, places, agrees)


def _not_differentiable(given: str) -> ConfigurationError:
    return ConfigurationError(
        f"{shown(given)} is no SafetyFilter, and a torch layer takes no other; the promise filter"
        " looks its inputs up in a table, and the backup filter searches for them, so they have no"
        " gradient. Take a condition here, such as 'scbf' or 'hocbf'; or train an agent behind it,"
        " which needs no gradient of it, by SafetyFilterVectorWrapper or"
        " make_sb3_env(..., filter='promise:p=0.99')"
    )


def _require_plain(safety_filter: SafetyFilter, qp: FilterQP) -> None:
    if safety_filter.of_measurements:
        raise ConfigurationError(
            f"the filter has {safety_filter.of_measurements}, and a torch layer decides at states"
            " that it is given: leave that out, and give it the estimate as the state"
        )
    if qp.runtime:
        raise ConfigurationError(
            f"the filter takes {', '.join(map(str, qp.runtime))} at each call, which a torch layer"
            " does not; make them states or fixed parameters"
        )
    if max(map(abs, (*qp.low, *qp.high))) >= WIDEST:
        raise ConfigurationError(
            "the filter has input bounds without an end, and a torch layer measures by their width"
            " what holds an action; give finite ones"
        )
    if qp.clf is not None:
        raise ConfigurationError(
            "a filter with a clf does not depend on the proposed input; use objective = 'nearest'"
            " for a torch layer"
        )
    reasons = {
        "demand": "is reciprocal, or of a certificate; use cbf, hocbf, scbf or szcbf",
        "change": "has a sampling margin of first order; use a number or 'none'",
        "uncertainty": (
            "is uncertain; use a condition of a model, or a learned one without uncertainty"
        ),
        "alternatives": (
            "is of a maximum, of whose functions the proposed input chooses one; take a smooth"
            " function below it"
        ),
        "terms": "holds a network; use a condition of a model, or a learned one with formulas",
    }
    for (barrier, condition), constraint in zip(safety_filter.parts, qp.constraints, strict=True):
        for attribute, reason in reasons.items():
            if getattr(constraint, attribute) not in (None, ()):
                raise ConfigurationError(
                    f"the constraint {condition.name} on {barrier.name} {reason}: a torch layer"
                    " takes plain constraints only"
                )


__all__ = ["TorchFilter", "TorchResult"]
