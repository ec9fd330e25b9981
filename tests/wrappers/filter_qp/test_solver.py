"""The short way of plain programs decides as the general one."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE
from safe_envs.wrappers import SafetyFilter


@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize("k", [2, 3, 5])
def test_plain_programs_of_several_constraints(m: int, k: int) -> None:
    rng = np.random.default_rng(10 * m + k)
    x, u = sp.symbols(f"x:{m}", real=True), sp.symbols(f"u:{m}", real=True)
    system = ControlAffineSDE(x, u, [0] * m, np.eye(m, dtype=int).tolist(), [0] * m)
    h = [
        1 - sum(float(a) * s**power for a, s in zip(row, x, strict=True))
        for row, power in zip(rng.normal(size=(k, m)).round(2), (1, 2, 3, 2, 1), strict=False)
    ]
    made = SafetyFilter(system, h, "cbf", (-1, 1), priorities=rng.uniform(0.5, 2.0, k))
    kinds = set()
    states, inputs = 1.5 * rng.normal(size=(150, m)), 2.0 * rng.normal(size=(150, m))
    for state, proposal in zip(states.tolist(), inputs.tolist(), strict=True):
        bounds = ([-0.5] * m, [0.75] * m) if len(kinds) % 2 else None
        found = made.decide_floats(state, proposal, bounds)
        expected = made._floats.solve(state, proposal, bounds)
        assert tuple(map(list, found[:3])) == tuple(map(list, expected[:3]))
        assert (found.feasible, list(found.slack)) == (expected.feasible, list(expected.slack))
        assert found.cause == expected.cause
        kinds.add((found.feasible, sum(found.active) > 1))
    assert {True, False} == {feasible for feasible, _ in kinds}
