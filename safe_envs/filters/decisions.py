"""The decisions of a filter's QP: for one state in lists, and for a batch in arrays.

`safe_envs.engine.decide` makes them: in machine code, or interpreted, with the same bits. A filter
of one constraint, or of one input, is interpreted for single states, which takes about as long; its
batches get machine code when there are many.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import struct
from array import array
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.dynamics.codegen import Components, Flavour, compile_function
from safe_envs.dynamics.defined import NO_VALUE
from safe_envs.engine import decide as kernel
from safe_envs.engine.decide import (
    answer_length,
    conclude_single,
    decide,
    scratch_lengths,
    shape_of,
)
from safe_envs.engine.program import MachineCode, decider
from safe_envs.engine.qp import ROUNDING, project, scratch_size
from safe_envs.errors import ConfigurationError
from safe_envs.filters.conditions.base import AffineConstraint
from safe_envs.filters.other_solvers import BINDING, require_solver, solve_with
from safe_envs.filters.qp import FilterDecision, FilterQP, UndefinedConstraintError

Bounds = tuple[Sequence[Any], Sequence[Any]]
"""m lower and m upper input bounds, floats or arrays (B,)."""

_Answer = tuple[int, Sequence[float]]

_FEW = 20_000
"""Decisions in batches from which on machine code is read from disk, which takes a second."""
_MANY = 2_000_000
"""Decisions in batches from which on it is compiled: they have taken some ten seconds."""


class QPValues:
    """The numbers of a QP at a state, as `safe_envs.engine.decide` takes them.

    Attributes:
        symbols: of the state and what follows it, and of learned terms.
        expressions: of the values; 0 in place of demands.
        demands: places of demands among the values, with the places of the expressions that are
            positive where they have a meaning, and what they are.
        owners: for each constraint, the places of its own values.
        shape: see `safe_envs.engine.decide.shape_of`.
        weights: of the inputs and the goal, then priorities.
        ends: lower and upper bounds of the inputs.
    """

    def __init__(self, qp: FilterQP) -> None:
        m, constraints, goal = qp.model.m, qp.constraints, int(qp.clf is not None)
        self.symbols = (*qp.symbols, *(s for term in qp.terms for s in term.symbols))
        self.expressions: list[Any] = [
            *(entry for c in constraints for entry in c.coefficient),
            *(c.offset for c in constraints),
        ]
        k, weights, unit = len(constraints), list(qp.weights), 1.0
        self.owners = [[*range(i * m, i * m + m), k * m + i] for i in range(k)]
        self.demands: list[tuple[int, range, Any]] = []
        if qp.clf is not None:
            qp.clf.require_known(qp.model, qp.symbols)
            given = (qp.clf.input_weight, qp.clf.slack_weight)
            input_weight, slack_weight = (float(qp.model.numeric(w)) for w in given)
            if not (0 < input_weight < math.inf and 0 < slack_weight < math.inf):
                raise ConfigurationError(
                    f"the goal weighs inputs by {input_weight} and slack by {slack_weight};"
                    " give positive numbers"
                )
            growth, along = qp.clf.growth(qp.model)
            self.expressions += [growth, *along]
            weights, unit = [input_weight] * (m + 1), math.sqrt(input_weight / slack_weight)
        parts = [self._add(qp, i) for i in range(k)]
        kind = kernel.UNCERTAIN if solved_as_cones(qp) else kernel.CHANGED
        kind = kernel.PLAIN if qp.plain else kind
        self.shape = shape_of((k, m, goal), kind, qp.dt, unit, parts)
        self.weights = [*map(float, (*weights, *qp.priorities, *([1.0] * goal)))]
        self.ends = [*map(float, (*qp.low, *qp.high))]
        self.lengths = scratch_lengths(self.shape)
        self.answer = answer_length(k, m, goal)

    def _add(self, qp: FilterQP, i: int) -> list[int]:
        """Add the values of a constraint; return its numbers in `shape_of`."""
        c, place = qp.constraints[i], len(self.expressions)
        domain = domain_of(c) if c.demand is not None else ()
        self.expressions += domain
        if c.demand is not None:
            levels = range(place, len(self.expressions))
            self.demands.append((len(self.expressions), levels, c.demand))
            self.expressions.append(sp.Integer(0))
        if i in qp.partial:
            self.expressions.append(sp.Add(*c.functions))
        self.expressions += c.uncertainty or ()
        self.expressions += functions_of(c)
        if c.change is not None:
            self.expressions += change_coefficients(qp, i)
        self.owners[i] += range(place, len(self.expressions))
        is_partial, is_uncertain = i in qp.partial, c.uncertainty is not None
        flags = (c.change is not None, is_uncertain, is_partial)
        return [len(domain), *map(int, flags), len(c.alternatives), qp.owner_of_each[i]]


class FilterQPSolver:
    """Decides for states given component by component, as floats or as arrays of a batch.

    Args:
        qp: the QP.
        solver: of it, one of `qpsolvers.available_solvers`; ours by default.

    Raises:
        ConfigurationError: There is no such solver, or it cannot solve the QP.
    """

    def __init__(self, qp: FilterQP, solver: str | None = None) -> None:
        self._qp, self.values, self._solver = qp, QPValues(qp), solver
        if solver is not None:
            require_solver(solver)
            if self.values.shape[kernel.KIND] != kernel.PLAIN:
                raise ConfigurationError(
                    f"solver = {solver!r} solves filters of affine constraints; take no solver with"
                    " reciprocal, learned or first-order conditions, goals, maxima and barriers"
                    " without a value"
                )
        shape = self.values.shape
        k, m, goal = (int(shape[i]) for i in (kernel.K, kernel.M, kernel.GOAL))
        self._k, self._m, self._goal = k, m, goal
        self._barriers = int(shape[kernel.OWNED]) or k
        is_plain = shape[kernel.KIND] == kernel.PLAIN and solver is None
        self._is_single, self._scratch_size = is_plain and k == 1, scratch_size(k, m)
        several = k + goal > 1 or shape[kernel.SAMPLED] > 0.0
        self._at_once = several and m + goal > 1
        self._fresh()

    def _fresh(self) -> None:
        # A copy counts for itself, since it may be in another process.
        self._run: MachineCode | None = None
        self._made = 0
        self._frames: list[Any] = []
        self._machine_frames: list[CallFrame] = []

    def _count(self, decisions: int) -> MachineCode | None:
        """Count decisions; return what makes them in machine code, if it is due."""
        if self._run is None and self._solver is None:
            before, self._made = self._made, self._made + decisions
            if self._at_once or before < _MANY <= self._made:
                self._run = decider()
            elif before < _FEW <= self._made:
                self._run = decider(compiling=False)
        return self._run

    def __getstate__(self) -> dict[str, Any]:
        made = {"_frames", "_machine_frames", "_floats", "_demands", "_arrays", "_run", "_made"}
        return {name: value for name, value in vars(self).items() if name not in made}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._fresh()

    def compile(self) -> None:
        """Compile all that a decision may need; else each part is at its first use."""
        _ = self._floats, self._demands, self._arrays
        if self._at_once:
            self._count(0)
        zero = np.zeros(1)
        for term in self._qp.terms:
            # Learned terms compile themselves when they are first read, wherever that is.
            with contextlib.suppress(*NO_VALUE), np.errstate(all="ignore"):
                term.floats((0.0,) * self._qp.model.n)
                term.arrays((zero,) * self._qp.model.n)

    def _compiled(self, expressions: Sequence[Any], flavour: Flavour) -> Any:
        numbers = [self._qp.model.numeric(e) for e in expressions]
        return compile_function(self.values.symbols, numbers, flavour)

    @cached_property
    def _floats(self) -> Any:
        return self._compiled(self.values.expressions, "floats")

    @cached_property
    def _demands(self) -> list[tuple[int, range, Any]]:
        found = self.values.demands
        return [(place, of, self._compiled([e], "floats")) for place, of, e in found]

    @cached_property
    def _arrays(self) -> Any:
        expressions = list(self.values.expressions)
        for place, _, demand in self.values.demands:
            expressions[place] = demand
        return self._compiled(expressions, "arrays")

    def floats(
        self, x: Sequence[float], u: Sequence[float], bounds: Bounds | None = None
    ) -> FilterDecision:
        """Decide for one state.

        Args:
            x: components of the state, followed by those of `FilterQP.runtime`.
            u: m components of the proposed input.
            bounds: input bounds; by default those of the QP.

        Returns:
            The decision in components.

        Raises:
            UndefinedConstraintError: A constraint or the goal has no finite value.
        """
        ends = None if bounds is None else [*bounds[0], *bounds[1]]
        decide_one = self._decide_single if self._is_single else self._decide_one
        code, out = decide_one(self._values_at(x), u, ends)
        if code < 0:
            raise _undefined(code, 0)
        k, m, count = self._k, self._m, self._barriers
        if self._is_single:
            active, feasible = out[m + 1] > 0.0, code & 1 == 1
            return FilterDecision(out[:m], [out[m]], [active], feasible, [out[m + 2]], 0, u)
        return FilterDecision(
            list(out[:m]),
            list(out[m : m + count]),
            [entry > 0.0 for entry in out[m + k : m + k + count]],
            code & 1 == 1,
            list(out[m + 2 * k : m + 2 * k + count]),
            (code >> 1) - 1,
            list(out[m + 3 * k :]) if self._goal else u,
        )

    def _values_at(self, x: Sequence[float]) -> Sequence[float]:
        """Return the values at a state."""
        try:
            given = x
            if self._qp.terms:
                state = tuple(x[: self._qp.model.n])
                given = [*x, *[v for term in self._qp.terms for v in term.floats(state)]]
            values = self._floats(*given)
            if not self._demands:
                return values
            values = list(values)
            for place, levels, demand in self._demands:
                if all(values[i] > 0.0 for i in levels):
                    values[place] = demand(*given)[0]
            return values
        except NO_VALUE:
            # Plain floats raise where arrays overflow or give no number.
            return self._table([np.array([c]) for c in x], 1)[:, 0].tolist()

    def _decide_single(
        self, values: Sequence[float], u: Sequence[float], ends: Sequence[float] | None
    ) -> _Answer:
        """Decide on one plain constraint as `decide` does, without what only others need."""
        m, made = self._m, self.values
        out, work = [0.0] * (m + 3), [0.0] * self._scratch_size
        bounds = made.ends if ends is None else ends
        try:
            feasible = project(1, m, values, u, bounds, made.weights, out, work)
        except ArithmeticError:
            return self._decide_one(values, u, ends)
        return conclude_single(m, u, feasible, out), out

    def _decide_one(
        self, values: Sequence[float], u: Sequence[float], ends: Sequence[float] | None
    ) -> _Answer:
        # Where Python is as fast, a control loop waits for no compilation.
        run = self._run or (self._count(0) if self._at_once else None)
        if run is None:
            return self._interpret(values, u, ends)
        frame = self._machine_frame()
        answer = frame.decide(run, values, u, ends)
        self._machine_frames.append(frame)
        return answer

    def _interpret(
        self, values: Sequence[float], u: Sequence[float], ends: Sequence[float] | None
    ) -> _Answer:
        made = self.values
        if self._solver is not None:
            return self._by_library(self._solver, values, u, made.ends if ends is None else ends)
        # Each call has scratch arrays to itself, also in threads.
        try:
            scratch = self._frames.pop()
        except IndexError:
            scratch = [[0.0] * n for n in made.lengths]
        out, bounds = [0.0] * made.answer, made.ends if ends is None else ends
        try:
            code = decide(made.shape, made.weights, values, u, bounds, out, scratch)
        except ArithmeticError:  # NumPy's numbers overflow, and have quotients by 0
            with np.errstate(all="ignore"):
                given, proposed, answer = np.array(values), np.array(u), np.array(out)
                arrays = [np.array(part) for part in scratch]
                code = decide(made.shape, made.weights, given, proposed, bounds, answer, arrays)
            out = answer.tolist()
        self._frames.append(scratch)
        return code, out

    def _by_library(
        self, solver: str, values: Sequence[float], u: Sequence[float], ends: Sequence[float]
    ) -> _Answer:
        """Return the answer of another solver, in the form of ours."""
        k, m, weights = self._k, self._m, self.values.weights
        if not math.isfinite(sum(values) + sum(u)):
            return kernel.UNDEFINED, []
        a, b = np.reshape(values[: k * m], (k, m)), np.array(values[k * m :])
        action, feasible = solve_with(solver, np.column_stack([a, b]), u, ends, weights)
        margin, start = a @ action + b, np.clip(u, ends[:m], ends[m:])
        slack = np.zeros(k) if feasible else np.maximum(-margin, 0.0)
        near = margin <= BINDING * (np.abs(a) @ np.abs(action) + np.abs(b))
        active = near & bool((a @ start + b < 0.0).any())
        out = [*action, *margin.tolist(), *active.astype(float).tolist(), *slack.tolist()]
        cause = kernel.furthest(k, m, list(values), list(values), k * m, list(u), weights, out)
        if self.values.shape[kernel.OWNED] > 0.0:
            cause = kernel.gather_barriers(k, m, self.values.shape, cause, out)
        return 2 * cause + 2 + int(feasible), out

    def _machine_frame(self) -> CallFrame:
        """Return arrays that no other thread uses."""
        try:
            return self._machine_frames.pop()
        except IndexError:
            made = self.values
            return CallFrame(made.shape, made.weights, made.ends, len(made.expressions))

    def _table(self, x: Sequence[Any], size: int) -> np.ndarray:
        """Return the values at a batch, shape (values, B)."""
        with np.errstate(all="ignore"):
            if self._qp.terms:
                state = tuple(x[: self._qp.model.n])
                x = (*x, *[v for term in self._qp.terms for v in term.arrays(state)])
            table = np.empty((len(self.values.expressions), size))
            for row, value in zip(table, self._arrays(*x), strict=True):
                row[:] = value
        return table

    def arrays(self, x: Components, u: Components, bounds: Bounds | None = None) -> FilterDecision:
        """Decide for a batch; see `floats`.

        Args:
            x: components of the states, arrays (B,).
            u: m components of the proposed inputs, likewise.
            bounds: each a float or an array (B,).
        """
        k, m, count, size = self._k, self._m, self._barriers, len(u[0])
        table, inputs = self._table(x, size), np.empty((m, size))
        for row, entry in zip(inputs, u, strict=True):
            row[:] = entry
        ends = None
        if bounds is not None:
            ends = np.empty((2 * m, size))
            for row, entry in zip(ends, (*bounds[0], *bounds[1]), strict=True):
                row[:] = entry
        run = self._run or self._count(size)
        if run is not None:
            frame = self._machine_frame()
            codes, out = frame.decide_all(run, table, inputs, ends)
            self._machine_frames.append(frame)
        else:
            codes, out = self._interpret_all(table, inputs, ends)
        if size and codes.min() < 0:
            bad = int(np.flatnonzero(codes < 0)[0])
            raise _undefined(int(codes[bad]), bad)
        return FilterDecision(
            tuple(out[:m]),
            tuple(out[m : m + count]),
            tuple(out[m + k : m + k + count] > 0.0),
            (codes & 1) == 1,
            tuple(out[m + 2 * k : m + 2 * k + count]),
            (codes >> 1) - 1,
            tuple(out[m + 3 * k :]) if self._goal else u,
        )

    def _interpret_all(
        self, table: np.ndarray, inputs: np.ndarray, ends: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        own = itertools.repeat(None) if ends is None else ends.T.tolist()
        rows = zip(table.T.tolist(), inputs.T.tolist(), own, strict=False)
        found = [self._interpret(*row) for row in rows]
        out = np.array([out for _, out in found]).reshape(-1, self.values.answer)
        return np.array([code for code, _ in found], dtype=np.int64), out.T.copy()

    def undefined_at(self, x: Sequence[float]) -> list[int]:
        """Return the constraints that have no finite value at a state; all where that is unclear.

        Args:
            x: components of the state, followed by those of `FilterQP.runtime`.
        """
        values = self._table([np.array([c]) for c in x], 1)[:, 0]
        for place, levels, _ in self.values.demands:
            if not (values[list(levels)] > 0.0).all():
                values[place] = 0.0
        found = []
        for i, places in enumerate(self.values.owners):
            own = values[places]
            if i in self._qp.partial and not math.isfinite(own[: self._m + 1].sum()):
                continue
            found += [] if np.isfinite(own).all() else [i]
        return found or list(range(self._k))


class CallFrame:
    """Arrays of one call in machine code.

    Args:
        shape: see `safe_envs.engine.decide.shape_of`.
        weights: see `safe_envs.engine.decide`, like the ends.
        ends: lower and upper bounds.
        size: number of values.
    """

    def __init__(
        self, shape: Sequence[float], weights: Sequence[float], ends: Sequence[float], size: int
    ) -> None:
        k, m, goal = (int(shape[i]) for i in (kernel.K, kernel.M, kernel.GOAL))
        self._ends, self._length = ends, answer_length(k, m, goal)
        parts = [size, m, 2 * m, self._length, *scratch_lengths(shape)]
        starts = [0, *itertools.accumulate(parts)]
        block = np.zeros(starts[-1])
        self._block = block.data
        self._constants = np.array(shape), np.array(weights), np.array(ends)
        self._given = struct.Struct(f"{size + m}d")
        self._bounds = struct.Struct(f"{2 * m}d")
        self._answer = struct.Struct(f"{self._length}d")
        self._places = [8 * start for start in starts]
        places = [_address(block) + place for place in self._places[:-1]]
        of_shape, of_weights, self._own_ends = map(_address, self._constants)
        numbers = [1, size, 0, of_shape, of_weights, *places[:4], 0, places[0], *places[4:]]
        self._one, self._many = array("q", numbers), array("q", numbers)
        self._of_one, self._of_many = (each.buffer_info()[0] for each in (self._one, self._many))
        self._bounds.pack_into(self._block, self._places[2], *ends)

    def decide(
        self,
        run: MachineCode,
        values: Sequence[float],
        u: Sequence[float],
        ends: Sequence[float] | None,
    ) -> _Answer:
        """Decide for one state."""
        self._given.pack_into(self._block, 0, *values, *u)
        if ends is None:
            code = run.one(self._of_one)
        else:
            self._bounds.pack_into(self._block, self._places[2], *ends)
            code = run.one(self._of_one)
            self._bounds.pack_into(self._block, self._places[2], *self._ends)
        return code, self._answer.unpack_from(self._block, self._places[3])

    def decide_all(
        self,
        run: MachineCode,
        values: np.ndarray,
        inputs: np.ndarray,
        ends: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Decide for a batch; return the results (B,) and the answers (length, B)."""
        count = values.shape[1]
        codes, out = np.empty(count), np.empty((self._length, count))
        numbers = self._many
        numbers[0], numbers[2] = count, int(ends is not None)
        numbers[5], numbers[6] = _address(values), _address(inputs)
        numbers[7] = self._own_ends if ends is None else _address(ends)
        numbers[8], numbers[9] = _address(out), _address(codes)
        code = run.many(self._of_many)
        if count == 1:
            codes[0] = code
        self._bounds.pack_into(self._block, self._places[2], *self._ends)
        return codes.astype(np.int64), out


def _address(numbers: np.ndarray) -> int:
    return numbers.__array_interface__["data"][0]


def _undefined(code: int, index: int) -> UndefinedConstraintError:
    what = "the goal" if code == kernel.UNDEFINED_GOAL else "the constraint"
    return UndefinedConstraintError(index, what)


def solved_as_cones(qp: FilterQP) -> bool:
    """Return whether uncertain constraints are solved as they are, not by planes above them."""
    uncertain = any(c.uncertainty is not None for c in qp.constraints)
    return uncertain and qp.model.m == 1 and qp.clf is None


def domain_of(constraint: AffineConstraint) -> tuple[sp.Expr, ...]:
    """Return what is positive where a constraint's demand has a meaning."""
    return constraint.domain or (_beyond_rounding(constraint.chain[0]),)


def functions_of(constraint: AffineConstraint) -> list[sp.Expr]:
    """Return a, b and the level of each function of a barrier that is their maximum.

    The level is not negative in the set that the function's own condition keeps.
    """
    return [
        e for c in constraint.alternatives for e in (*c.coefficient, c.offset, sp.Min(*c.chain))
    ]


def _beyond_rounding(h: sp.Expr) -> sp.Expr:
    """Return h less its own rounding."""
    # Where that is not positive, a state and a batch may find h on either side of 0.
    return h - sp.Float(ROUNDING, 17) * _size(h)


def _size(expression: sp.Expr) -> sp.Expr:
    """Return the sum of the sizes of an expression's terms."""
    parts: Any = expression.args
    if expression.is_Add or expression.is_Mul:
        return expression.func(*map(_size, parts))
    if isinstance(expression, sp.Max | sp.Min):
        return sp.Max(*map(_size, parts))
    return sp.Abs(expression)


def change_coefficients(qp: FilterQP, i: int) -> list[sp.Expr]:
    """Return the coefficients of a constraint's change: of 1, of u_j, and of u_j u_n, j <= n."""
    change: Any = sp.sympify(qp.constraints[i].change)
    inputs = qp.model.inputs
    at_zero = dict.fromkeys(inputs, sp.Integer(0))
    slopes: list[Any] = [sp.diff(change, u) for u in inputs]
    bends = [
        sp.diff(slope, other) / (2 if u == other else 1)
        for j, (u, slope) in enumerate(zip(inputs, slopes, strict=True))
        for other in inputs[j:]
    ]
    return [*(e.xreplace(at_zero) for e in (change, *slopes)), *bends]
