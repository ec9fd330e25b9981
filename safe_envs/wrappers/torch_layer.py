"""A safety filter as a layer of a torch network: gradients pass through it to whatever proposed the
action.

The action is the one that `safe_envs.wrappers.SafetyFilter` returns. What is differentiated is the
formula that gives it near a state: the rows that bind are equations there, the inputs that the box
holds are constants, and of the inputs that are left those nearest to the proposal solve a linear
system. So the derivative is exact, and of any order, where the active set does not change. At a
kink it is that of one side.
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
from safe_envs.errors import ConfigurationError, InvalidInputError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions import Condition
from safe_envs.wrappers.filter_qp import FilterQP
from safe_envs.wrappers.safety_filter import SafetyFilter

_RANK = 1e-9
"""Singular values below this share of the largest are the rounding of rows that depend on each
other."""

_EXACT = 1e-11
"""How near an input at its bound is, as a share of its way there or of the box."""

_AGREED = 1e-6
"""How far apart, as a share of the box, an action and its formula are, at most."""

_NOTHING = 1e-8
"""Share of a force that is rounding."""


class TorchResult(NamedTuple):
    """What a filter decides, for a batch with leading axes `...`, m inputs and k rows.

    Attributes:
        action: executed input, shape (..., m), in the box; only this one has a gradient.
        feasible: whether some action in the box meets every row, shape (...).
        active: rows that bind or cannot be met, shape (..., k).
        differentiable: whether the gradient is that of the action, shape (...); where not, it is
            zero. It says so whether or not a gradient was asked for.
    """

    action: torch.Tensor
    feasible: torch.Tensor
    active: torch.Tensor
    differentiable: torch.Tensor


class TorchFilter(torch.nn.Module):
    """A safety filter in physical units, differentiable in the proposed input and in the state. It
    has no parameters.

    Where the rows cannot all be met, the action is the least-violating one, and its gradient is
    that of this action: zero along the inputs that stay in a corner of the box, and with several
    rows that of their weighted compromise. Where the formula does not give the action, as it may
    not where its equations are nearly dependent, the gradient is zero, and the result says so.

    It runs on the CPU and in double precision, whatever the tensors are.

    Args:
        safety_filter: whose actions are returned.

    Raises:
        ConfigurationError: a row is not a plain one: uncertain, reciprocal, with a network or a
            sampling margin of first order; or the filter pursues a goal; or a row holds a function
            that torch does not have.
    """

    def __init__(self, safety_filter: SafetyFilter) -> None:
        super().__init__()
        # The filter keeps its qp to its solvers, which share it.
        qp = safety_filter.qp
        _require_plain(safety_filter, qp)
        self.safety_filter = safety_filter
        self._low, self._high = np.array(qp.low), np.array(qp.high)
        self._roots = np.sqrt(qp.weights)
        self._priorities = np.array(qp.priorities)
        self._rows = _compiled_rows(qp)

    @classmethod
    def for_problem(
        cls,
        problem: SafetyProblem,
        conditions: Condition | Sequence[Condition] | str,
        knowledge: str = "model",
        priorities: Sequence[float] | None = None,
    ) -> TorchFilter:
        """The filter for the barriers of a problem; arguments and errors as for
        `SafetyFilter.for_problem`."""
        return cls(SafetyFilter.for_problem(problem, conditions, knowledge, priorities=priorities))

    def forward(self, x: torch.Tensor, u: torch.Tensor, return_result: bool = False) -> Any:
        """Decide for a batch.

        Args:
            x: states, shape (..., n).
            u: proposed inputs, shape (..., m), in physical units.
            return_result: whether to return the flags beside the action.

        Returns:
            The action, shape (..., m), of the type of `u` and on its device; or a `TorchResult`
            with it.

        Raises:
            InvalidInputError: a shape or a type does not fit, or an entry is not finite.
            NumericalError: a row has no finite value at a state.
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
        """The actions (B, m) as functions of states (B, n) and inputs (B, m), true near these, and
        where that holds (B,)."""
        m, k = len(self._low), len(self._priorities)
        action, active, slack = (
            found.action.reshape(-1, m),
            found.active.reshape(-1, k),
            found.slack.reshape(-1, k),
        )
        # Where no row acts, the state's gradient is zero, and not missing.
        result = (
            inputs.clamp(torch.from_numpy(self._low), torch.from_numpy(self._high))
            + 0.0 * states[:, :1]
        )
        everywhere = torch.ones(len(states), dtype=torch.bool)
        acting = np.flatnonzero(active.any(axis=1))
        if not acting.size:
            return result, everywhere
        places = torch.from_numpy(acting)
        a, b = self._rows(states[places])
        held, missed, binding = self._active_sets(
            a.detach().numpy(),
            inputs.detach().numpy()[acting],
            action[acting],
            active[acting],
            slack[acting],
        )
        decided = torch.from_numpy(action[acting])
        start = torch.where(torch.from_numpy(held), decided, inputs[places])
        gaps = (a * start[:, None, :]).sum(dim=-1) + b
        roots = torch.from_numpy(self._roots)
        rows = torch.where(torch.from_numpy(held)[:, None, :], 0.0, a / roots)
        weights = missed * np.sqrt(self._priorities)
        solution = start + _nearest(rows, gaps, weights, binding) / roots
        agrees = (
            (solution - decided).abs() <= torch.from_numpy(_AGREED * (self._high - self._low))
        ).all(dim=1)
        formula = torch.where(agrees[:, None], solution, decided)
        return result.index_copy(0, places, formula), everywhere.index_copy(0, places, agrees)

    def _active_sets(
        self, a: np.ndarray, v: np.ndarray, u: np.ndarray, active: np.ndarray, slack: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Inputs that the box holds (R, m), rows that cannot be met and rows that bind (R, k),
        which are equations."""
        way = self._roots * (u - v)
        near = np.minimum(
            self._high - self._low, np.linalg.norm(way, axis=1, keepdims=True) / self._roots
        )
        missed = slack > 0.0
        binding = active & ~missed
        # A single row presses every input on which it depends.
        pressed = (way != 0.0) | ((a != 0.0) & active[:, :, None]).any(axis=1)
        held = pressed & ((u - self._low <= _EXACT * near) | (self._high - u <= _EXACT * near))
        # Several rows may not all be needed.
        several = (np.count_nonzero(active, axis=1) > 1) | (missed.any(axis=1) & (a.shape[1] > 1))
        for i in np.flatnonzero(several):
            forced = self._forced(a[i], u[i], slack[i])
            low, high = [
                ~forced & (gap <= _EXACT * near[i]) for gap in (u[i] - self._low, self._high - u[i])
            ]
            also, binding[i] = _held_and_binding(
                a[i] / self._roots, way[i], low, high, forced, missed[i], binding[i]
            )
            held[i] = forced | also
        return held, missed, binding

    def _forced(self, a: np.ndarray, u: np.ndarray, slack: np.ndarray) -> np.ndarray:
        """Inputs (m,) that the rows that cannot be met press against the box, by the sum of their
        forces; a (k, m), slack (k,)."""
        forces = (self._priorities * slack)[:, None] * a
        force, size = forces.sum(axis=0), np.abs(forces).sum(axis=0)
        gap = np.where(force > 0.0, self._high - u, u - self._low)
        return (np.abs(force) > _NOTHING * size) & (gap <= _EXACT * (self._high - self._low))


def _held_and_binding(
    rows: np.ndarray,
    way: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    fixed: np.ndarray,
    missed: np.ndarray,
    binding: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The inputs (m,) and rows (k,) of one state that hold the action where it is, by the signs of
    their multipliers.

    The way from the proposal to the action is a nonnegative sum of the normals of the rows that
    bind and of the box, and of those of the missed rows in either direction, since the way must not
    change what these miss. Nonnegative least squares uses independent ones only.

    Args:
        rows: in units of the weights, shape (k, m).
        way: from the proposal to the action, in the same units, shape (m,).
        low: inputs that may be held at their lower bounds, shape (m,).
        high: inputs that may be held at their upper bounds, shape (m,).
        fixed: inputs that are held in any case, shape (m,).
        missed: rows that cannot be met, shape (k,).
        binding: rows that may bind, shape (k,).
    """
    left, m = ~fixed, len(way)
    size = np.abs(way[left]).max(initial=0.0)
    if size == 0.0:
        return np.zeros(m, dtype=bool), binding
    lengths = np.linalg.norm(rows[:, left], axis=1)
    units = rows / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    normals = np.concatenate([units, -units, np.eye(m), -np.eye(m)])
    candidates = np.flatnonzero(np.concatenate([binding | missed, missed, low, high]))
    shares = np.zeros(len(normals))
    shares[candidates] = scipy.optimize.nnls(normals[np.ix_(candidates, left)].T, way[left] / size)[
        0
    ]
    of_rows, _, of_low, of_high = np.split(shares > _NOTHING, np.cumsum([len(rows), len(rows), m]))
    return of_low | of_high, of_rows & binding


def _nearest(
    rows: torch.Tensor, gaps: torch.Tensor, weights: np.ndarray, binding: np.ndarray
) -> torch.Tensor:
    """The shortest steps z (R, m) with rows z + gaps = 0 for the rows that bind, after the least
    |weights (rows z + gaps)|^2.

    Rows (R, k, m), gaps (R, k), weights (R, k) of the rows that cannot be met, 0 for others, and
    those that bind (R, k).
    """
    step = rows.new_zeros(rows.shape[0], rows.shape[2])
    walls = rows
    if weights.any():
        lost = torch.from_numpy(weights)
        compromise = lost[:, :, None] * rows
        inverse = torch.linalg.pinv(compromise, rtol=_RANK)
        step = -(inverse @ (lost * gaps)[:, :, None])[:, :, 0]
        # Along these directions nothing changes for the rows that cannot be met.
        walls = rows - (rows @ inverse) @ compromise
    sizes = torch.linalg.vector_norm(rows.detach(), dim=-1)
    scale = torch.from_numpy(binding) / torch.where(sizes > 0.0, sizes, 1.0)
    left = scale * (gaps + (rows @ step[:, :, None])[:, :, 0])
    return (
        step
        - (torch.linalg.pinv(scale[:, :, None] * walls, rtol=_RANK) @ left[:, :, None])[:, :, 0]
    )


def _require_plain(safety_filter: SafetyFilter, qp: FilterQP) -> None:
    if qp.clf is not None:
        raise ConfigurationError(
            "a filter with a clf does not depend on the proposed input; use objective = 'nearest'"
            " for a torch layer"
        )
    reasons = {
        "demand": "is reciprocal; use cbf, hocbf, scbf or szcbf",
        "change": "has a sampling margin of first order; use a number or 'none'",
        "uncertainty": (
            "is uncertain; use a condition of a model, or a learned one without uncertainty"
        ),
        "terms": "holds a network; use a condition of a model, or a learned one with formulas",
    }
    for (barrier, condition), constraint in zip(safety_filter.pairs, qp.constraints, strict=True):
        for attribute, reason in reasons.items():
            if getattr(constraint, attribute) is not None:
                raise ConfigurationError(
                    f"the row {condition.name} on {barrier.name} {reason}: a torch layer takes"
                    " plain rows only"
                )


class _Printer(TorchPrinter):
    """Writes with Python's operators, or calls of `_FUNCTIONS`, what torch has for tensors only: a
    part may be a plain number."""

    def _print_Pow(self, expr: Any) -> str:  # noqa: N802  (sympy's dispatch by name)
        return f"({self._print(expr.base)})**({self._print(expr.exp)})"

    def _print_Relational(self, expr: Any) -> str:  # noqa: N802
        return f"({self._print(expr.lhs)}) {expr.rel_op} ({self._print(expr.rhs)})"

    def _print_Piecewise(self, expr: Any) -> str:  # noqa: N802
        return f"Piecewise({', '.join(self._print(part) for piece in expr.args for part in piece.args)})"

    def _named(self, expr: Any) -> str:
        return f"{expr.func.__name__}({', '.join(map(self._print, expr.args))})"

    _print_Max = _print_Min = _print_Heaviside = _named  # noqa: N815


def _tensors(parts: Sequence[Any]) -> tuple[torch.Tensor, ...]:
    return torch.broadcast_tensors(*[torch.as_tensor(part, dtype=torch.float64) for part in parts])


def _pieces(*parts: Any) -> torch.Tensor:
    """The first of value, condition, value, condition, ... whose condition holds."""
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


def _compiled_rows(qp: FilterQP) -> Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]:
    """From states (B, n) to the rows' a (B, k, m) and b (B, k)."""
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
            f"torch has no {', '.join(sorted(map(str, unknown)))}, which a row holds; write it with"
            " other functions"
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
