"""The filter as a function of a compiled program."""

from __future__ import annotations

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source
from safe_envs.wrappers.filter_qp.array_decision import ArrayDecision
from safe_envs.wrappers.filter_qp.decision_text import Body, Values
from safe_envs.wrappers.filter_qp.qp import FilterQP
from safe_envs.wrappers.qp.kernels.one_constraint import project_scalar


def unfiltered_source(m: int) -> Source:
    """Return the function `decide` of `safe_envs.compiled.slots` that lets every input pass.

    Args:
        m: number of inputs.
    """
    action = "".join(f"u[{j}], " for j in range(m))
    return Source(
        f"def decide(x, u, data, work):\n    return ({action}), u, False, True, (0.0,), 0, True\n"
    )


def filter_source(qp: FilterQP, data: Data) -> Source:
    """Return the function `decide` of `safe_envs.compiled.slots`, which solves a QP.

    Args:
        qp: the QP.
        data: receives its numbers.

    Raises:
        NotCompilableError: Learned terms have no compiled form.
    """
    only = qp.constraints[0] if len(qp.constraints) == 1 else None
    if only and qp.model.m == 1 and qp.plain and only.uncertainty is None:
        return _scalar_decision(qp, data)
    return ArrayDecision(qp, data).source()


def _scalar_decision(qp: FilterQP, data: Data) -> Source:
    values, bounds = Values(qp, data), data.add([qp.low[0], qp.high[0]])
    body = Body(data)
    body.add(
        *values.lines,
        "action, margin, active, feasible = project_scalar("
        f"values[0], values[1], u[0], data[{bounds}], data[{bounds + 1}])",
        "slack = 0.0 if feasible else -margin",
        "return (action,), u, active, feasible, (slack,), 0, isfinite(margin)",
    )
    body.uses.append(project_scalar)
    return values.source + body.source(ArrayDecision.parameters)
