"""The controller of a control Lyapunov function."""

from __future__ import annotations

import math

import numpy as np

from safe_envs.agents.policies.base import CHOOSE, StatelessPolicy
from safe_envs.agents.policies.clf_kernel import best_inputs_for_goal, work_of_goal
from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source, formulas
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.errors import ConfigurationError, NumericalError
from safe_envs.problem.clf import CLF
from safe_envs.problem.measurement import require_full_state
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.filter_qp import FilterQP, FilterQPSolver, UndefinedConstraintError


class CLFController(StatelessPolicy):
    """Minimizes w_u |u|^2 + w_d d^2 subject to AV + rate V <= d and the input bounds, exactly.

    It is the joint QP of `safe_envs.wrappers.SafetyFilter` without barriers: put a filter with
    `objective="clf"` over `ZeroController` for the one with them. With a single input there is no
    difference between that and a filter over this controller, since the cost is convex; with
    several there is, since the nearest action is not the cheapest one.

    Args:
        problem: whose model, input bounds and features are taken.
        clf: the goal; that of the problem by default.

    Raises:
        ConfigurationError: the problem is measured, there is no goal, or the observation does not
            hold the states.

    Source: the CLF part of the quadratic programs in thesis Sec. 4.3.1 and 5.4.2.
    """

    def __init__(self, problem: SafetyProblem, clf: CLF | None = None) -> None:
        require_full_state(problem, "CLF controllers")
        goal = clf or problem.clf
        if goal is None:
            raise ConfigurationError(
                f"{problem.name} has no control Lyapunov function; use the policy nominal, or"
                " give one"
            )
        super().__init__(len(problem.features))
        self._name = problem.name
        self._columns = _columns_of_states(problem)
        self._center, self._half = center_and_half_width(problem)
        low, high = [pair[0] for pair in problem.box], [pair[1] for pair in problem.box]
        qp = FilterQP(problem.model, (), low, high, [1.0] * problem.model.m, [], problem.dt, goal)
        self._qp, self._goal = qp, goal
        self._floats, self._arrays = FilterQPSolver(qp, "floats"), FilterQPSolver(qp, "arrays")

    def actions(self, given: np.ndarray) -> np.ndarray:
        """Solve the QP; see `StatelessPolicy.actions`.

        Raises:
            NumericalError: The goal has no finite value at an observation.
        """
        x = np.ascontiguousarray(given[..., self._columns].T)
        try:
            if given.ndim == 1:
                inputs = self._floats.best(tuple(x.tolist()), [0.0] * len(self._half))
            else:
                with np.errstate(all="ignore"):
                    inputs = self._arrays.best(tuple(x), [np.zeros(len(given))] * len(self._half))
        except (ArithmeticError, ValueError) as error:
            row = (
                given[error.index]
                if given.ndim == 2 and isinstance(error, UndefinedConstraintError)
                else given
            )
            raise NumericalError(
                f"the goal of {self._name!r} has no finite value at the observation {row.tolist()}"
            ) from error
        return np.stack(
            [(u - c) / w for u, c, w in zip(inputs, self._center, self._half, strict=True)], axis=-1
        )

    def source(self, data: Data) -> Source:
        """See `Policy.source`."""
        model, m = self._qp.model, len(self._half)
        growth, along = self._goal.growth(model)
        rates = formulas(
            "goal_rates", {"x": model.states}, [model.numeric(e) for e in (growth, *along)], data
        )
        weight, slack_weight = (
            float(model.numeric(w)) for w in (self._goal.input_weight, self._goal.slack_weight)
        )
        unit = math.sqrt(weight / slack_weight)
        place = data.add([*self._qp.low, *self._qp.high, weight, unit])
        scales = data.add([*self._center, *self._half])
        x = "".join(f"observation[{column}], " for column in self._columns)
        entries = "".join(
            f"(work[{j}] - data[{scales + j}]) / data[{scales + m + j}], " for j in range(m)
        )
        return rates + Source(
            f"{CHOOSE}    best_inputs_for_goal(goal_rates(({x}), data), {place}, data, work)\n"
            f"    return ({entries})\n",
            (best_inputs_for_goal,),
            work_of_goal(m),
        )


def _columns_of_states(problem: SafetyProblem) -> list[int]:
    expressions = [feature.expression for feature in problem.features]
    hidden = [str(state) for state in problem.model.states if state not in expressions]
    if hidden:
        raise ConfigurationError(
            f"the observation of {problem.name} does not hold {', '.join(hidden)}, which a CLF"
            " controller needs"
        )
    return [expressions.index(state) for state in problem.model.states]
