"""What a filter executes lies in the intervals of the boxes."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError
from safe_envs.filters.conditions.text import conditions_for
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.values.closed_loop import ExecutedInputs
from tests.values.systems import scalar, x

RNG = np.random.default_rng(3)


PROBLEMS = {
    "noise": lambda: scalar(x, 0.3, nominal=-2 * x),
    # The effect of the input on h changes its sign at x = 1/2, and vanishes at x = -1.
    "two signs": lambda: scalar(
        0, 0.2, barriers=x * (1 - x) + 0.5, gain=x + 1, nominal=sp.sin(5 * x)
    ),
    "mostly infeasible": lambda: scalar(3, 0.2, barriers=1 - x, nominal=1),
}


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("policy", ["any", "nominal"])
@pytest.mark.filterwarnings("ignore::safe_envs.SystemDefinitionWarning")
def test_executed_inputs_are_in_the_intervals(name, policy):
    problem = PROBLEMS[name]()
    condition = conditions_for(problem, "scbf")[0]
    executed = ExecutedInputs(problem, condition, policy)
    low = RNG.uniform(-1.0, 1.9, 200)
    high = low + RNG.exponential(0.05, 200)
    first, last = executed.of_boxes([low], [high])
    assert (first >= -1).all()
    assert (last <= 1).all()
    filter_ = SafetyFilter.for_problem(problem, condition)
    law = sp.lambdify(x, problem.model.numeric(problem.nominal[0]))
    for _ in range(20):
        states = RNG.uniform(low, high)
        own = np.clip(np.broadcast_to(law(states.astype(np.float32)), 200), -1.0, 1.0)
        proposed = own if policy == "nominal" else RNG.uniform(-1.0, 1.0, 200)
        found = filter_.filter(states[:, None], proposed[:, None]).action[:, 0]
        assert (found >= first).all()
        assert (found <= last).all()
    # They say something.
    assert (last - first).mean() < 1.9


def test_what_is_not_bounded_is_refused():
    problem = scalar()
    with pytest.raises(ConfigurationError, match="policy = 'best'"):
        ExecutedInputs(problem, None, "best")
    two = scalar(barriers=(x, 2 - x))
    condition = conditions_for(two, "scbf")[0]
    with pytest.raises(ConfigurationError, match="2 barriers"):
        ExecutedInputs(two, condition, "any")
    margin = conditions_for(problem, "scbf:sampling_margin=first-order")[0]
    with pytest.raises(ConfigurationError, match=r"a u \+ b"):
        ExecutedInputs(problem, margin, "any")
