"""Input bounds, signals, adjustable parameters and the time at each call of a filter."""

from __future__ import annotations

import math

import numpy as np
import pytest
import sympy as sp

from safe_envs import (
    CLF,
    ConfigurationError,
    ControlAffineSDE,
    InvalidInputError,
    NumericalError,
    SafeEnvsError,
)
from safe_envs.problem.signals import TIME
from safe_envs.wrappers import CBF, HOCBF, RCBF, SCBF, SRCBF, SafetyFilter
from tests.conftest import problem_of
from tests.oracles.filter_cases import Corrected, Doubtful, Measured
from tests.oracles.programs import decision_of

x, y, u, w, p, q = sp.symbols("x y u w p q", real=True)
gain, wind = sp.Symbol("gain", positive=True), sp.Symbol("wind", real=True)
STATES, PROPOSALS = (part.normal(size=(30, 2)) for part in map(np.random.default_rng, (0, 1)))
MOVING = {
    "p": np.random.default_rng(2).normal(size=30),
    q: np.random.default_rng(3).normal(size=30),
    "gain": np.linspace(0.5, 2.0, 30),
}
NOW = np.linspace(0.0, 2.0, 30)
LOW = -np.random.default_rng(4).uniform(0.1, 3.0, (30, 2))
BOUNDS = np.stack([LOW, LOW + np.random.default_rng(5).uniform(0.0, 4.0, (30, 2))], axis=-1)
EARLY = {"sampling_margin": "first-order"}


def chased(drift: sp.Expr = wind) -> ControlAffineSDE:
    """Two integrators in a wind, chased by something that moves along p at the speed q."""
    return ControlAffineSDE(
        (x, y),
        (u, w),
        [drift, 0],
        [[gain, 0], [0, 1]],
        [[0.2], [0.1]],
        parameters={gain: 1.0, wind: 0.5},
        signals={p: q, q: 0},
    )


def fixed(i: int) -> ControlAffineSDE:
    """The same at one instant: what moves has its values as numbers, and its rates in the drift."""
    return ControlAffineSDE(
        (x, y, p, q, sp.Symbol("clock", real=True)),
        (u, w),
        [0.5, 0, q, 0, 1],
        [[MOVING["gain"][i], 0], [0, 1], [0, 0], [0, 0], [0, 0]],
        [[0.2], [0.1], [0], [0], [0]],
    )


BARRIERS = ((x - p) ** 2 + y**2 - 1 + 0.1 * TIME, 3 - x - 0.2 * p)


@pytest.mark.parametrize(
    ("conditions", "settings"),
    [
        (CBF(2.0), {}),
        ((SCBF(), CBF(1.0)), {"weights": (1.0, 3.0)}),
        ((CBF(1.0, **EARLY), CBF(2.0)), {"dt": 0.1}),
        ((RCBF(), CBF(1.0)), {}),
        ((SRCBF(), SCBF(**EARLY)), {"dt": 0.05}),
        (CBF(1.0), {"clf": CLF((x - p) ** 2 + y**2)}),
    ],
    ids=str,
)
def test_decisions_are_those_of_a_system_where_what_is_given_stands(conditions, settings):
    barriers = BARRIERS if isinstance(conditions, tuple) else BARRIERS[:1]
    moving = SafetyFilter(chased(), barriers, conditions, (-2, 2), adjustable=("gain",), **settings)
    batch = moving.filter(STATES, PROPOSALS, input_bounds=BOUNDS, parameters=MOVING, t=NOW)
    clock = {TIME: sp.Symbol("clock", real=True)}
    for i in range(0, 30, 3):
        values = {key: array[i] for key, array in MOVING.items()}
        one = moving.filter(
            STATES[i], PROPOSALS[i], input_bounds=BOUNDS[i], parameters=values, t=NOW[i]
        )
        there = SafetyFilter(
            fixed(i), [h.subs(clock) for h in barriers], conditions, BOUNDS[i], **settings
        )
        state = [*STATES[i], MOVING["p"][i], MOVING[q][i], NOW[i]]
        expected = there.filter(state, PROPOSALS[i])
        for found in (one, type(batch)(*[part[i] for part in batch])):
            for name in ("action", "margin", "slack", "proposed", "barrier"):
                np.testing.assert_allclose(
                    getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-9
                )
            assert found.feasible == expected.feasible
            assert found.active.tolist() == expected.active.tolist()
    assert batch.active.any(axis=1).sum() > 0
    assert batch.feasible.any()
    assert (batch.action >= BOUNDS[..., 0]).all()
    assert (batch.action <= BOUNDS[..., 1]).all()


@pytest.mark.parametrize("m", [1, 2])
def test_bounds_at_a_call_are_those_of_an_uncertain_constraint(m):
    form = (0.1, 0.0, 0.2) if m == 1 else (0.1, 0.0, 0.0, 0.2, 0.1, 0.2)
    condition = Doubtful(1.0, form=form)
    system = ControlAffineSDE((x, y), (u, w)[:m], [0, 0], np.eye(2, m, dtype=int).tolist(), [0, 0])
    h = [1 - x, x + 3] if m == 1 else [1 - x - y**2, x + y + 3]
    given = SafetyFilter(system, h, condition, (-9, 9))
    limits = BOUNDS[:, :m]
    batch = given.filter(STATES, PROPOSALS[:, :m], input_bounds=limits)
    for i in range(0, 30, 3):
        made = SafetyFilter(system, h, condition, limits[i])
        expected = made.filter(STATES[i], PROPOSALS[i, :m])
        one = given.filter(STATES[i], PROPOSALS[i, :m], input_bounds=limits[i])
        np.testing.assert_allclose(one.action, expected.action, atol=1e-12)
        np.testing.assert_allclose(batch.action[i], expected.action, atol=1e-9)
        assert one.feasible == batch.feasible[i] == expected.feasible
    held = given.filter(STATES[0], PROPOSALS[0, :m], input_bounds=(0.25, 0.25))
    assert held.action.tolist() == [0.25] * m


def test_adjustable_parameters_have_the_systems_values_where_none_are_given():
    by_hand = SafetyFilter(chased(), 1 - x, "cbf", (-2, 2), adjustable=[gain, "wind"])
    values = {"p": 0.0, "q": 0.0}
    default = by_hand.filter([0.5, 0.0], [1.0, 0.0], parameters=values)
    # 1 - x >= wind + gain u
    assert default.action.tolist() == [0.0, 0.0]
    found = by_hand.filter([0.5, 0.0], [1.0, 0.0], parameters={**values, wind: 0.0, "gain": 2.0})
    assert found.action.tolist() == [0.25, 0.0]


def test_a_filter_for_a_problem_takes_its_models_parameters():
    problem = problem_of("safe_envs/Pendulum-v0")
    name = next(iter(problem.model.parameters)).name
    value = problem.model.parameter_values[name]
    usual = SafetyFilter.for_problem(problem, "hocbf")
    adjustable = SafetyFilter.for_problem(problem, "hocbf", adjustable=(name,))
    other = SafetyFilter(
        problem.model.with_parameters(**{name: 1.3 * value}),
        problem.barriers,
        HOCBF(problem.gains_of(0)),
        problem.input_bounds,
    )
    states = np.random.default_rng(0).normal(size=(20, problem.model.n))
    inputs = np.random.default_rng(1).normal(size=(20, problem.model.m))
    for made, given in ((usual, None), (other, {name: 1.3 * value})):
        found = adjustable.filter(states, inputs, parameters=given)
        np.testing.assert_allclose(found.action, made.filter(states, inputs).action, atol=1e-12)


def test_the_shape_of_bounds():
    plain = SafetyFilter(
        ControlAffineSDE((x, y), (u, w), [0, 0], [[1, 0], [0, 1]], [0, 0]), 9 - x, "cbf", (-9, 9)
    )
    proposals = np.full((2, 3, 2), 8.0)
    states = np.zeros((2, 3, 2))
    for bounds, expected in (
        ((-1, 1), [1.0, 1.0]),
        ([(-1, 1), (-1, 2)], [1.0, 2.0]),
        (np.array([[-1, 1], [-1, math.inf]]), [1.0, 8.0]),
    ):
        assert (plain.filter(states, proposals, input_bounds=bounds).action == expected).all()
        assert plain.filter(states[0, 0], [8, 8], input_bounds=bounds).action.tolist() == expected
    each = np.zeros((2, 3, 2, 2))
    each[..., 1] = np.arange(12.0).reshape(2, 3, 2)
    found = plain.filter(states, proposals, input_bounds=each).action
    np.testing.assert_array_equal(found, np.minimum(each[..., 1], 8.0))


POINT = {"p": 0.0, "q": 1.0}


@pytest.mark.parametrize(
    ("given", "advice"),
    [
        ({}, r"the signals p, q have no value; give parameters=\{'p': \.\.\., 'q'"),
        ({"parameters": {"p": 1.0}}, "the signals q have no value"),
        ({"parameters": {**POINT, "mass": 1.0}}, "parameters gives 'mass'; .*allowed: p, q, gain"),
        ({"parameters": {**POINT, 3: 1.0}}, "parameters gives 3"),
        ({"parameters": {**POINT, "wind": 1.0}}, r"make the filter with adjustable=\('wind',\)"),
        ({"parameters": {**POINT, "t": 1.0}}, "the time is an argument of its own"),
        ({"parameters": {**POINT, p: 1.0}}, "gives p twice"),
        ({"parameters": [0.0, 1.0]}, "give a dict of values by name"),
        ({"parameters": {**POINT, "p": math.nan}}, "value of p is nan; give finite"),
        ({"parameters": {**POINT, "p": "0"}}, "the value of p is '0'"),
        (
            {"parameters": {**POINT, "p": [0.0, 1.0]}},
            r"value of p has the shape \(2,\); give a number",
        ),
        ({"parameters": {**POINT, "gain": 0.0}}, "declared positive"),
        ({"parameters": POINT, "t": None}, "the time is missing"),
        ({"parameters": POINT, "t": -1.0}, "declared nonnegative"),
        ({"parameters": POINT, "t": math.inf}, "time t is inf; give finite"),
        ({"input_bounds": (1, -1)}, "the lower one first"),
        ({"input_bounds": (-1, 1e200)}, "within 1e\\+100"),
        ({"input_bounds": np.zeros((3, 2))}, r"bounds has the shape \(3, 2\)"),
        ({"input_bounds": "wide"}, "the pair of bounds is 'wide'"),
    ],
)
@pytest.mark.parametrize("batch", [(), (4,)])
def test_what_is_wrong_at_a_call_is_told(given, advice, batch):
    moving = SafetyFilter(chased(), BARRIERS[0], "cbf", (-2, 2), adjustable="gain")
    given = {"t": 0.0, **({"parameters": POINT} if "bounds" in given else {}), **given}
    with pytest.raises(SafeEnvsError, match=advice):
        moving.filter(np.zeros((*batch, 2)), np.zeros((*batch, 2)), **given)


def test_arrays_have_the_shape_of_the_batch():
    moving = SafetyFilter(chased(), BARRIERS[0], "cbf", (-2, 2))
    states = np.zeros((2, 3, 2))
    for values in (np.zeros(6), np.zeros((3, 2)), np.zeros((2, 3, 1))):
        with pytest.raises(InvalidInputError, match=r"an array \(2, 3\), one for each state"):
            moving.filter(states, states, parameters={"p": values, "q": 0.0}, t=0.0)
    with pytest.raises(InvalidInputError, match=r"\(2, 3, 2, 2\) for each state"):
        moving.filter(states, states, input_bounds=np.zeros((6, 2, 2)), parameters=POINT, t=0.0)
    found = moving.filter(states, states, parameters={"p": np.zeros((2, 3)), "q": 0}, t=1.0)
    assert found.action.shape == (2, 3, 2)


def test_bounds_are_finite_where_the_filter_may_go_to_their_ends():
    goal = SafetyFilter(chased(), 1 - x, "cbf", (-2, 2), clf=CLF(x**2))
    with pytest.raises(ConfigurationError, match="needs finite ones"):
        goal.filter([0, 0], [0, 0], input_bounds=(-math.inf, 1), parameters=POINT)


def test_constraints_without_a_value_are_told_with_what_was_given():
    without = SafetyFilter(chased(), 1 - x + sp.log(p), "cbf", (-2, 2))
    found = without.filter([0.0, 0.0], [0.0, 0.0], parameters={"p": -1.0, "q": 1.0})
    assert not found.feasible
    assert found.slack == [np.inf]
    singular = SafetyFilter(chased(sp.log(p)), 1 - x, "cbf", (-2, 2))
    with pytest.raises(NumericalError, match="p = -1, q = 1"):
        singular.filter([0.0, 0.0], [0.0, 0.0], parameters={"p": -1.0, "q": 1.0})
    with pytest.raises(NumericalError, match="p = -1, q = 1"):
        singular.filter(np.zeros((3, 2)), np.zeros((3, 2)), parameters={"p": -1.0, "q": 1.0})


def test_the_time_is_not_looked_at_where_nothing_depends_on_it():
    still = SafetyFilter(chased(), 1 - x, "cbf", (-2, 2))
    for t in ({}, {"t": 12.0}):
        found = still.filter([0.0, 0.0], [1.0, 0.0], parameters=POINT, **t)
        assert found.action.tolist() == [0.5, 0.0]


LEARNED = Measured(ControlAffineSDE((x, y), (u,), [0, 0], [[1], [0]], [0, 0]), [1.5 + x**2, y])


@pytest.mark.parametrize(
    "conditions",
    ["cbf", ["cbf", CBF(1.0, sampling_margin="first-order")], Corrected(1.0, learned=LEARNED)],
    ids=["one", "sampled", "learned terms of the state"],
)
def test_a_program_takes_what_is_given_after_the_state(conditions):
    count = len(conditions) if isinstance(conditions, list) else 1
    moving = SafetyFilter(
        chased(), list(BARRIERS[:count]), conditions, (-2, 2), dt=0.1, adjustable=("gain",)
    )
    decide = decision_of(moving)
    for i in range(10):
        values = {key: array[i] for key, array in MOVING.items()}
        expected = moving.filter(STATES[i], PROPOSALS[i], parameters=values, t=NOW[i])
        state = [*STATES[i], *values.values(), *([NOW[i]] if TIME in moving.qp.runtime else [])]
        found = decide(state, PROPOSALS[i])
        np.testing.assert_allclose(found.action, expected.action, atol=1e-12)
        assert (found.active, found.feasible) == (expected.active.any(), expected.feasible)
