"""Decisions by components: floats of one state, or arrays of a batch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.dynamics.codegen import Components, filled
from safe_envs.errors import NumericalError
from safe_envs.wrappers.filter_qp.decision import FilterDecision, UndefinedConstraintError
from safe_envs.wrappers.filter_qp.qp import FilterQP
from safe_envs.wrappers.filter_qp.solver import FilterQPSolver

NO_VALUE = (ArithmeticError, ValueError, TypeError)
"""Raised by formulas in plain floats: on overflow, outside a domain, comparing complex roots."""


class ComponentFilter:
    """Solves a QP by the fastest of its solvers.

    Args:
        qp: the QP.
        names: of the barriers, for messages.
    """

    def __init__(self, qp: FilterQP, names: Sequence[str]) -> None:
        self.qp, self._names = qp, names
        self._floats, self._arrays = FilterQPSolver(qp, "floats"), FilterQPSolver(qp, "arrays")
        self._single = len(qp.constraints) == 1 and qp.plain

    def decide_floats(self, x: Sequence[float], u: Sequence[float]) -> FilterDecision:
        """Decide for one state.

        Args:
            x: n finite components of the state.
            u: m finite components of the proposed input.

        Returns:
            The decision in components.

        Raises:
            NumericalError: The constraint has no finite value.
        """
        try:
            found = self._floats.solve_single(x, u) if self._single else self._floats.solve(x, u)
        except UndefinedConstraintError as error:
            raise self.undefined(error.what, x) from error
        except NO_VALUE:
            # Plain floats raise where arrays overflow or give no number; the batch decides then.
            found = self._decide_one_of_batch(x, u)
        return found

    def _decide_one_of_batch(self, x: Sequence[float], u: Sequence[float]) -> FilterDecision:
        found = self.decide_arrays(*[tuple(np.array([c]) for c in part) for part in (x, u)])
        *parts, cause, proposed = [
            [filled(c, (1,)).item() for c in (part if isinstance(part, Sequence) else (part,))]
            for part in found[:-1]
        ]
        action, margin, active, (feasible,), slack = parts
        return FilterDecision(action, margin, active, feasible, slack, cause[0], proposed)

    def decide_arrays(self, x: Components, u: Components) -> FilterDecision:
        """Decide for a batch; as `decide_floats`, with an array (B,) for each component.

        Args:
            x: n components of the states.
            u: m components of the proposed inputs.

        Returns:
            The decisions in components.
        """
        # What overflows or has no value is found below, which says where.
        with np.errstate(all="ignore"):
            return self._decide(x, u)

    def _decide(self, x: Components, u: Components) -> FilterDecision:
        try:
            return self._arrays.solve_single(x, u) if self._single else self._arrays.solve(x, u)
        except UndefinedConstraintError as error:
            raise self.undefined(error.what, [float(c[error.index]) for c in x]) from error

    def undefined(self, what: str, x: Sequence[float]) -> NumericalError:
        """Return the error of something without a finite value.

        Args:
            what: the constraint, the goal or the barrier.
            x: n components of the state.
        """
        at = ", ".join(
            f"{s} = {value:.6g}" for s, value in zip(self.qp.model.states, x, strict=True)
        )
        names = "" if "goal" in what else f" on {', '.join(self._names)}"
        return NumericalError(
            f"{what}{names} has no finite value at {at}; check it and the model there"
        )
