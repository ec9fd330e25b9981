"""Promise filters of real tables that are pickled: they decide the same."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.promise_filter import PromiseFilter, PromiseSettings
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings
from tests.oracles.walks import walk


@pytest.mark.parametrize("specification", ["", "always safe & eventually goal"])
def test_the_same_is_decided_after_pickling(specification):
    problem = walk(moves=False, goal=bool(specification))
    settings = ValueSettings(specification=specification, cells=(160,), inputs=17)
    look_ahead = LookAhead(solve(problem, settings), problem)
    given = PromiseFilter(look_ahead, PromiseSettings(0.9, specification=specification), problem)
    before = pickle.loads(pickle.dumps(given))
    x, u = np.linspace(-0.7, 0.6, 200), np.linspace(-2.0, 2.0, 200)
    k, a = np.arange(200) % (problem.steps - 1), look_ahead.first_states((x,))
    at = (x, a) if specification else (x,)
    first = given.choose(k, given.attainable(k, at), at, (u,))
    for other in (before, pickle.loads(pickle.dumps(given))):
        again = other.choose(k, other.attainable(k, at), at, (u,))
        np.testing.assert_array_equal(again.action, first.action)
        np.testing.assert_array_equal(again.expected, first.expected)
        np.testing.assert_array_equal(again.level, first.level)
