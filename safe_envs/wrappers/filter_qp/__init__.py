"""The quadratic program (QP) of a filter, compiled from its constraints and solved exactly."""

from safe_envs.wrappers.filter_qp.decision import FilterDecision, UndefinedConstraintError
from safe_envs.wrappers.filter_qp.qp import FilterQP
from safe_envs.wrappers.filter_qp.solver import FilterQPSolver

__all__ = ["FilterDecision", "FilterQP", "FilterQPSolver", "UndefinedConstraintError"]
