"""Decisions by components: floats of one state, or arrays of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safe_envs.dynamics.codegen import Components, filled
from safe_envs.dynamics.defined import NO_VALUE
from safe_envs.errors import NumericalError
from safe_envs.wrappers.filter_qp.compiled import Bounds
from safe_envs.wrappers.filter_qp.decision import FilterDecision, UndefinedConstraintError
from safe_envs.wrappers.filter_qp.per_barrier import PerBarrier
from safe_envs.wrappers.filter_qp.qp import FilterQP
from safe_envs.wrappers.filter_qp.solver import FilterQPSolver
from safe_envs.wrappers.qp import dispatch


class ComponentFilter:
    """Solves a QP by the fastest of its solvers.

    Args:
        qp: the QP.
        names: of the barriers, for messages.
    """

    def __init__(self, qp: FilterQP, names: Sequence[str]) -> None:
        self.qp, self._names = qp, names
        self._floats, self._arrays = FilterQPSolver(qp, "floats"), FilterQPSolver(qp, "arrays")
        goal = int(qp.clf is not None)
        self._size = len(qp.constraints) + goal, qp.model.m + goal
        single = len(qp.constraints) == 1 and qp.plain
        self._solve_arrays = self._arrays.solve_single if single else self._arrays.solve
        self._solve_floats = self._floats.solve_single if single else self._floats.solve
        if qp.plain and not single and not any(c.uncertainty for c in qp.constraints):
            self._solve_floats = self._floats.solve_plain
        if qp.owners:
            self._solve_floats = PerBarrier(self._solve_floats, qp, "floats")
            self._solve_arrays = PerBarrier(self._solve_arrays, qp, "arrays")

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        # Another process has not imported yet what decisions may need.
        self.compile()

    def compile(self) -> None:
        """Import and compile all that any decision may need."""
        dispatch.prepare(*self._size)
        for solver in (self._floats, self._arrays):
            solver.compile()

    def decide_floats(
        self, x: Sequence[float], u: Sequence[float], bounds: Bounds | None = None
    ) -> FilterDecision:
        """Decide for one state.

        Args:
            x: finite components of the state, followed by those of `FilterQP.runtime`.
            u: m finite components of the proposed input.
            bounds: m lower and m upper input bounds; by default those of the QP.

        Returns:
            The decision in components.

        Raises:
            NumericalError: The constraint has no finite value.
        """
        try:
            found = self._solve_floats(x, u, bounds)
        except UndefinedConstraintError as error:
            raise self.undefined(error.what, x) from error
        except NO_VALUE:
            # Plain floats raise where arrays overflow or give no number; the batch decides then.
            found = self._decide_one_of_batch(x, u, bounds)
        return found

    def _decide_one_of_batch(
        self, x: Sequence[float], u: Sequence[float], bounds: Bounds | None
    ) -> FilterDecision:
        one, of_one = [tuple(np.array([c]) for c in part) for part in (x, u)]
        found = self.decide_arrays(one, of_one, bounds)
        *parts, cause, proposed = [
            [filled(c, (1,)).item() for c in (part if isinstance(part, Sequence) else (part,))]
            for part in found[:-1]
        ]
        action, margin, active, (feasible,), slack = parts
        return FilterDecision(action, margin, active, feasible, slack, cause[0], proposed)

    def decide_arrays(
        self, x: Components, u: Components, bounds: Bounds | None = None
    ) -> FilterDecision:
        """Decide for a batch; as `decide_floats`, with an array (B,) for each component.

        Args:
            x: components of the states, followed by those of `FilterQP.runtime`.
            u: m components of the proposed inputs.
            bounds: m lower and m upper input bounds, each a float or an array (B,); by default
                those of the QP.

        Returns:
            The decisions in components.
        """
        # What overflows or has no value is found below, which says where.
        with np.errstate(all="ignore"):
            return self._decide(x, u, bounds)

    def _decide(self, x: Components, u: Components, bounds: Bounds | None) -> FilterDecision:
        try:
            return self._solve_arrays(x, u, bounds)
        except UndefinedConstraintError as error:
            raise self.undefined(error.what, [float(c[error.index]) for c in x]) from error

    def undefined(
        self, what: str, x: Sequence[float], which: Sequence[int] | None = None
    ) -> NumericalError:
        """Return the error of something without a finite value.

        Args:
            what: the constraint, the goal or the barrier.
            x: components of the state, followed by those of `FilterQP.runtime`.
            which: of the barriers; None to find out.
        """
        at = ", ".join(f"{s} = {value:.6g}" for s, value in zip(self.qp.symbols, x, strict=True))
        if which is None and "goal" not in what:
            owners = self.qp.owner_of_each
            which = list(dict.fromkeys(owners[i] for i in self._arrays.undefined_at(x)))
        names = f" on {', '.join([self._names[i] for i in which])}" if which else ""
        return NumericalError(
            f"{what}{names} has no finite value at {at}; check it and the model there"
        )
