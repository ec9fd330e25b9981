"""The filter as a function of a compiled program."""

from __future__ import annotations

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source, formulas
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers.filter_qp.qp import FilterQP
from safe_envs.wrappers.qp.kernels.one_constraint import project_scalar


def unfiltered_source() -> Source:
    """Return the function `decide` of `safe_envs.compiled.slots` that lets every input pass."""
    return Source("def decide(x, u, data, work):\n    return u, u, False, True, (0.0,), 0, True\n")


def filter_source(qp: FilterQP, data: Data) -> Source:
    """Return the function `decide` of `safe_envs.compiled.slots`, which solves a QP.

    Args:
        qp: the QP.
        data: receives its numbers.

    Raises:
        NotCompilableError: There is no kernel for such a QP.
    """
    if len(qp.constraints) > 1 or qp.model.m > 1 or qp.terms or not qp.plain:
        raise NotCompilableError("this filter has no kernel yet")
    return _one_scalar_constraint(qp, data)


def _one_scalar_constraint(qp: FilterQP, data: Data) -> Source:
    (constraint,) = qp.constraints
    values = formulas(
        "filter_constraint",
        {"x": qp.model.states},
        [qp.model.numeric(e) for e in (*constraint.coefficient, constraint.offset)],
        data,
    )
    low = data.add([qp.low[0], qp.high[0]])
    return values + Source(
        "def decide(x, u, data, work):\n"
        "    a, b = filter_constraint(x, data)\n"
        "    action, margin, active, feasible ="
        f" project_scalar(a, b, u[0], data[{low}], data[{low + 1}])\n"
        "    slack = 0.0 if feasible else -margin\n"
        "    return (action,), u, active, feasible, (slack,), 0, isfinite(margin)\n",
        (project_scalar,),
    )
