"""The quadratic program (QP) of a filter, compiled from its constraints and solved exactly."""

from safe_envs.filters.qp import FilterDecision, FilterQP, UndefinedConstraintError
from safe_envs.filters.solver import FilterQPSolver

__all__ = ["FilterDecision", "FilterQP", "FilterQPSolver", "UndefinedConstraintError"]
