"""Barriers that are minima and maxima of functions."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, SafeEnv, define_problem
from safe_envs.agents import evaluate
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.proofs.posterior import guarantee_of
from safe_envs.wrappers import (
    SafetyFilter,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    parse_conditions,
)
from tests.oracles.programs import decision_of

x, y, v, u, w = sp.symbols("x y v u w", real=True)
PLANE = ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 1]])
CART = ControlAffineSDE((x, v), (u,), [v, 0], [0, 1])
BOUNDS = (-2.0, 2.0)


def disk(center: float) -> sp.Expr:
    return 1 - (x - center) ** 2 - y**2


KEPT: dict[str, Any] = {
    "ridge": sp.Min(1 - x - y, 1 - x + y),
    "input_bounds": 1 - sp.Max(x, y),
    "wedge": 1 - x - sp.Abs(y),
    "strip": 1 - sp.Abs(x),
    "diamond": 1 - sp.Abs(x) - sp.Abs(y) / 2,
    "pieces": 1 - sp.Piecewise((2 * x, x > 0), (x, True)),
    "lens": sp.Min(disk(0.5), disk(-0.5)),
    "touching disks": sp.Max(disk(1.0), disk(-1.0)),
    "overlapping disks": sp.Max(disk(0.9), disk(-0.9)),
    "around a square": sp.Max(-1.5 - x, x - 1, y - 1, -1 - y),
    "either, and both": sp.Min(sp.Max(disk(0.9), disk(-0.9)), 1 - x - y, 1 - x + y),
}
STARTS = {"lens": (0.0, 0.0), "around a square": (-2.5, 0.2)}


@pytest.mark.parametrize("dt", [0.1, pytest.param(0.01, marks=pytest.mark.oracle)])
@pytest.mark.parametrize("name", KEPT)
def test_paths_toward_the_edge_stay_safe(name, dt):
    safety_filter = SafetyFilter(PLANE, KEPT[name], "cbf:alpha=2", BOUNDS)
    state, least = np.array(STARTS.get(name, (-0.9, 0.01))), np.inf
    for _ in range(round(4 / dt)):
        found = safety_filter.filter(state, np.clip([9.0, 0.0] - 3 * state, -3, 3))
        assert found.feasible
        least = min(least, found.barrier.item())
        state = state + dt * found.action
    # They go as far as the edge, through the gap between the disks: no more is kept than h.
    assert least >= 0.0
    assert safety_filter.filter(state, [0.0, 0.0]).barrier < 0.01
    assert name != "overlapping disks" or state[0] > 1.8


@pytest.mark.parametrize(
    "text", ["cbf:alpha=2", "rcbf", "szcbf", "cbf:sampling_margin=first-order"]
)
def test_a_minimum_is_decided_like_the_list_of_its_pieces(text):
    rng = np.random.default_rng(0)
    states, inputs = rng.normal(size=(400, 2)), 3 * rng.normal(size=(400, 2))
    rest = {"dt": 0.1, "input_bounds": BOUNDS}
    whole = SafetyFilter(PLANE, [1 - x - sp.Abs(y), 2 - x], text, priorities=[2.0, 1.0], **rest)
    pieces = [1 - x - y, 1 - x + y, 2 - x]
    listed = SafetyFilter(PLANE, pieces, text, priorities=[2.0, 2.0, 1.0], **rest)
    found, expected = (each.filter(states, inputs) for each in (whole, listed))
    np.testing.assert_allclose(found.action, expected.action, atol=1e-12)
    assert (found.feasible == expected.feasible).all()
    assert text in ("szcbf", "cbf:sampling_margin=first-order") or not found.feasible.all()
    both = slice(0, 2)
    np.testing.assert_allclose(found.slack[:, 0], expected.slack[:, both].max(axis=1), atol=1e-12)
    np.testing.assert_allclose(found.margin[:, 0], expected.margin[:, both].min(axis=1), atol=1e-12)
    np.testing.assert_allclose(found.barrier[:, 0], expected.barrier[:, both].min(axis=1))
    assert (found.active[:, 0] == expected.active[:, both].any(axis=1)).all()
    assert (found.cause == np.array([0, 0, 1, -1])[expected.cause]).all()
    np.testing.assert_allclose(whole.by_constraint().filter(states, inputs).slack, expected.slack)
    again = pickle.loads(pickle.dumps(whole))
    for i in range(50):
        for part, batch in zip(again.filter(states[i], inputs[i]), found, strict=True):
            np.testing.assert_allclose(part, batch[i], atol=1e-12)


def test_one_function_of_a_maximum_is_enough():
    safety_filter = SafetyFilter(PLANE, sp.Max(1 - x, 1 - y), "cbf:alpha=1", [(-1, 1), (0.5, 1)])

    decide = decision_of(safety_filter)

    def action(state, proposed):
        found = safety_filter.filter(state, proposed)
        assert found.action.tolist() == pytest.approx(decide(state, proposed).action)
        return found.action.tolist()

    # y may rise as fast as it likes while x stays away from 1, and x has to where only that counts.
    assert action([0.5, 0.6], [0.4, 1.0]) == [0.4, 1.0]
    assert action([0.9, 1.5], [0.6, 0.7]) == pytest.approx([0.1, 0.7])
    # The larger function cannot be met: its input is at least .5, where .3 is allowed.
    assert action([0.8, 0.7], [0.9, 0.6]) == pytest.approx([0.2, 0.6])
    # A function that is below 0 does not keep the maximum, however near it is.
    assert action([1.1, 0.9], [-0.4, 0.8]) == pytest.approx([-0.4, 0.5])
    assert not safety_filter.filter([1.1, 0.9], [-0.4, 0.8]).feasible


def test_pieces_of_relative_degree_two():
    for h, pieces in ((1 - sp.Abs(x), 2), (sp.Min(1 - x, x + 1, 5), 2), (disk(0.0).subs(y, 0), 1)):
        safety_filter = SafetyFilter(CART, h, "hocbf:alpha=2,2", (-5, 5))
        assert len(safety_filter.constraints) == pieces
        state, least = np.array([0.0, 0.5]), np.inf
        for _ in range(800):
            found = safety_filter.filter(state, [3.0])
            state = state + 0.01 * np.array([state[1], found.action[0]])
            least = min(least, found.barrier.item())
        assert 0.0 <= least < 0.02


def test_pieces_that_meet_smoothly_keep_their_chain_across_the_edge():
    """The second derivative of h jumps where x = 0, which states only pass."""
    h = 1 - x - sp.Max(x, 0) ** 2
    safety_filter = SafetyFilter(CART, h, "hocbf:alpha=2,2", (-5, 5))
    first_of_chain = sp.lambdify((x, v), safety_filter.constraints[0].chain[1])
    for dt in (0.01, 0.001):
        state, least = np.array([-0.3, 0.0]), np.inf
        for k in range(round(8 / dt)):
            found = safety_filter.filter(state, [4 * np.sin(k * dt) - state[1] / 4])
            assert found.feasible
            assert first_of_chain(*state) > 0.0
            state = state + dt * np.array([state[1], found.action[0]])
            least = min(least, found.barrier.item())
        assert 0.0 < least < 0.05


@pytest.mark.parametrize("engine", ["numpy", pytest.param("compiled", marks=pytest.mark.oracle)])
def test_envs_report_a_barrier_that_is_a_minimum_as_one(engine):
    problem = define_problem(
        PLANE,
        [1 - x - sp.Abs(y), 2 + x],
        input_bounds=BOUNDS,
        start=[(-0.2, 0.2), (-0.2, 0.2)],
        dt=0.05,
        horizon=2.0,
        nominal=[3, 0],
    )
    one = SafetyFilterWrapper(SafeEnv(problem), "cbf:alpha=2")
    one.reset(seed=0)
    for _ in range(40):
        *_, info = one.step(np.ones(2, dtype=np.float32))
    assert info["h_min"] >= 0.0
    assert (info["slacks"].shape, info["barrier"].shape) == ((2,), (2,))
    assert info["active_barrier"] == 0
    envs: Any = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 8, engine=engine), "cbf")
    envs.reset(seed=0)
    for _ in range(20):
        *_, infos = envs.step(np.ones((8, 2), dtype=np.float32))
    assert infos["slacks"].shape == (8, 2)
    assert set(infos["active_barrier"].tolist()) == {0}
    assert (infos["barrier"] >= 0.0).all()


def test_bounds_are_those_of_the_pieces():
    numbers: dict[str, Any] = {"input_bounds": BOUNDS, "start": [(0, 0.5), (0, 0.5)], "dt": 0.1}
    numbers |= {"horizon": 2.0, "nominal": [3, 3], "workspace": {x: (-3, 3), y: (-3, 3)}}
    (row,) = evaluate(
        define_problem(PLANE, 1 - sp.Max(x, y), **numbers), filters=["cbf:alpha=2"], episodes=20
    ).rows
    assert (row.safety_rate, row.continuous_bound, row.continuous_word) == (1.0, 1.0, "proved")
    problem = define_problem(PLANE, sp.Max(1 - x, 1 - y), **numbers)
    (row,) = evaluate(problem, filters=["cbf:alpha=2"], episodes=20).rows
    assert (row.safety_rate, row.continuous_bound) == (1.0, None)
    assert "h is a maximum" in row.continuous_note


@pytest.mark.slow
def test_the_bound_of_a_minimum_under_noise_is_that_of_the_list():
    system = ControlAffineSDE((x,), (u,), [0], [1], [0.3])
    found = []
    for h in (1 - sp.Abs(x), [1 - x, 1 + x]):
        problem = define_problem(system, h, input_bounds=(-3, 3), start=[0.0], dt=0.05, horizon=0.5)
        bound = guarantee_of(problem, parse_conditions("szcbf:alpha=1", problem))
        found.append((bound.note, bound.at(np.array([[0.0], [0.3]]), 0.5).tolist()))
    assert found[0] == found[1]
