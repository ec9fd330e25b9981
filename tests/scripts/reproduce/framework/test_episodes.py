"""Episodes period by period."""

from __future__ import annotations

import pytest

from safe_envs.agents import evaluate, load_problem
from safe_envs.scripts.reproduce.framework.episodes import violations


def test_violations_are_those_of_an_evaluation() -> None:
    """The same episodes, counted the same way, at each instant and in more than one batch."""
    problem = load_problem("safe_envs/StochasticDubins-v0", {"start": "uniform", "horizon": 0.5})
    found = violations(problem, "scbf", "zero", 1100, 3)
    row = evaluate(problem, "zero", ["scbf"], episodes=1100, seed=3, bounds=False).rows[0]
    assert [found.safe(k).sum() for k in range(problem.steps + 1)] == row.curve.safe
    assert found.infeasible == pytest.approx(row.infeasible_rate)
    assert found.rate("here", problem.steps).ours == pytest.approx(100 * row.safety_rate)
