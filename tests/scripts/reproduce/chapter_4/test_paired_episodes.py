"""The same episodes under several filters."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.evaluation.statistics import paired_difference_interval
from safe_envs.agents.policies.nominal import ZeroController
from safe_envs.registry import make_problem
from safe_envs.scripts.reproduce.chapter_4.paired_episodes import (
    difference,
    exits,
    is_above,
    is_below,
    with_interval,
)


def test_exits_are_those_of_an_evaluation() -> None:
    """The same episodes, counted the same way, at each instant and in more than one wave."""
    problem = make_problem("safe_envs/StochasticDubins-v0", start="uniform", horizon=0.5)
    found = exits(problem, "scbf", ZeroController(problem), 1100, 3)
    row = evaluate(problem, "zero", ["scbf"], episodes=1100, seed=3, bounds=False).rows[0]
    assert [found.safe(k).sum() for k in range(problem.steps + 1)] == row["curve"]["safe"]
    assert found.infeasible == pytest.approx(row["infeasible_rate"])
    assert found.rate("here", problem.steps).ours == pytest.approx(100 * row["safety_rate"])


def test_difference_is_of_pairs() -> None:
    """Pairs that agree make its interval narrower than that of two samples would be."""
    first, second = np.arange(100) < 60, np.arange(100) < 50
    number = difference("gap", first, second)
    assert (number.name, number.unit, number.ours) == ("gap", "points", 10.0)
    assert is_above(number)
    assert is_below(difference("", second, first))
    assert not is_above(difference("", first, first))
    assert not is_below(difference("", first, first))
    assert (number.low, number.high) == pytest.approx(
        [100 * end for end in paired_difference_interval(50, 10, 0, 40)]
    )
    assert with_interval(number).startswith("+10.0 [")
    assert not is_above(difference("", first, second[::-1]))
