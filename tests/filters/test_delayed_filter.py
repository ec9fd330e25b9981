"""A filter over a delay is, for a plant that the model predicts, the filter without one."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE
from safe_envs.dynamics.integrators import Integrator
from safe_envs.errors import ConfigurationError, InvalidInputError, NumericalError
from safe_envs.filters.conditions import HOCBF
from safe_envs.filters.delayed_filter import Prediction
from safe_envs.problem.problem import Barrier
from safe_envs.problem.signals import TIME
from safe_envs.wrappers import DelayedFilter, SafetyFilter

x, y, u, w = sp.symbols("x y u w", real=True)
DT = 0.1
LINEAR = ControlAffineSDE(
    (x, y), (u, w), [y, -x], [[0, 0], [1, sp.Rational(1, 2)]], sp.zeros(2, 1), {}
)
NOISY = ControlAffineSDE((x, y), (u, w), [y, -x], [[0, 0], [1, 0.5]], [sp.Rational(1, 5), 0], {})
BOX = [(-2.0, 1.0), (0.5, 3.0)]
REST = (0.0, 0.5)


def plain_filter(model=LINEAR):
    return SafetyFilter(model, [(Barrier(1 - x**2), HOCBF((2.0, 4.0)))], input_bounds=BOX)


def proposals(steps=60):
    return np.random.default_rng(0).uniform([-2.0, 0.5], [1.0, 3.0], (steps, 2))


def loop(safety_filter, delay, start, proposed, system=LINEAR):
    """States and decisions of a plant that executes each input `delay` periods after it is sent."""
    plant, state = Integrator(system, DT, 1, "floats"), tuple(start)
    line, states, decisions = [REST] * delay, [state], []
    for each in proposed:
        decision = safety_filter.filter(np.array(state), each)
        line.append(tuple(decision.action.tolist()))
        state = plant.step(state, line.pop(0), [0.0] * plant.channels)
        states.append(state)
        decisions.append(decision)
    return states, decisions


@pytest.mark.parametrize("delay", [1, 4])
def test_a_deterministic_plant_is_filtered_as_without_delay_to_the_last_bit(delay):
    start, proposed = (0.2, 0.1), proposals()
    late, made = loop(DelayedFilter(plain_filter(), delay, DT), delay, start, proposed)
    # The first inputs are at rest for both; then the plant without delay is filtered.
    resting = Integrator(LINEAR, DT, 1, "floats")
    state = start
    for k in range(delay):
        assert late[k] == state
        state = resting.step(state, REST, ())
    prompt, wanted = loop(plain_filter(), 0, state, proposed)
    assert late[delay:] == prompt[: len(late) - delay]
    for mine, other in zip(made, wanted, strict=True):
        for name, a, b in zip(mine._fields, mine, other, strict=True):
            np.testing.assert_array_equal(a, b, err_msg=name)
    assert any(d.active.any() for d in made)
    # A filter that knows nothing of the delay decides otherwise.
    assert loop(plain_filter(), delay, start, proposed)[0] != late


def test_no_delay_is_the_filter_itself():
    start, proposed = (0.2, 0.1), proposals(10)
    late = DelayedFilter(plain_filter(), 0, DT)
    assert loop(late, 0, start, proposed)[0] == loop(plain_filter(), 0, start, proposed)[0]
    with pytest.raises(InvalidInputError, match="nan"):
        late.filter([0.0, np.nan], REST)
    # Nothing is under way that could be unknown.
    late.override(REST)
    late.filter([0.0, 0.0], REST)
    assert late.sent.shape == (0, 2)


def test_a_batch_is_filtered_as_its_states_one_by_one():
    rng = np.random.default_rng(2)
    many, ones = DelayedFilter(plain_filter(), 2, DT), []
    ones = [DelayedFilter(plain_filter(), 2, DT) for _ in range(6)]
    for _ in range(5):
        states, proposed = rng.uniform(-0.8, 0.8, (2, 3, 2)), rng.uniform(-2.0, 3.0, (2, 3, 2))
        together = many.filter(states, proposed)
        assert together.action.shape == (2, 3, 2)
        rows = zip(ones, states.reshape(6, 2), proposed.reshape(6, 2), strict=True)
        apart = [one.filter(state, each).action for one, state, each in rows]
        np.testing.assert_allclose(together.action.reshape(6, 2), apart, rtol=1e-12, atol=1e-12)
    assert many.sent.shape == (2, 3, 2, 2)
    np.testing.assert_allclose(many.sent.reshape(6, 2, 2), [one.sent for one in ones], atol=1e-12)


def test_signals_parameters_and_the_time_are_predicted_with_their_rates():
    p, q, mass = sp.symbols("p q mass", real=True)
    cart = ControlAffineSDE(
        (x, y), (u,), [y, 0], [0, 1 / mass], [0, 0], {mass: 1.0}, signals={p: q, q: 0}
    )
    wall = p - x - sp.sin(TIME) / 5
    prompt = SafetyFilter(
        cart, wall, "hocbf:alpha=2,8", input_bounds=(-5.0, 5.0), adjustable=("mass",)
    )
    late = DelayedFilter(prompt, 3, DT)
    many = DelayedFilter(prompt, 3, DT)
    heavy = ControlAffineSDE((x, y), (u,), [y, 0], [0, 1 / mass], [0, 0], {mass: 2.0})
    plant, state, line = Integrator(heavy, DT, 1, "floats"), (0.0, 1.0), [(0.0,)] * 3
    due, binding = [], 0
    for k in range(25):
        t = k * DT
        if k >= 3:
            # What was decided three periods ago is what would be decided now.
            given = {"p": 1.0 - 0.3 * t, "q": -0.3, "mass": 2.0}
            now = prompt.filter(state, [2.0], input_bounds=(-4.0, 3.0), parameters=given, t=t)
            np.testing.assert_allclose(due.pop(0), now.action, rtol=1e-9, atol=1e-9)
            binding += bool(now.active.any())
        given = {p: 1.0 - 0.3 * t, q: -0.3, mass: 2.0}
        decision = late.filter(state, [2.0], input_bounds=(-4.0, 3.0), parameters=given, t=t)
        batch = {key: np.full(2, value) for key, value in given.items()}
        both = many.filter(
            np.tile(state, (2, 1)), [[2.0]] * 2, input_bounds=(-4.0, 3.0), parameters=batch, t=t
        )
        np.testing.assert_allclose(both.action, [decision.action] * 2, rtol=1e-12, atol=1e-12)
        due.append(decision.action)
        line.append(tuple(decision.action.tolist()))
        state = plant.step(state, line.pop(0), ())
    assert binding > 3
    with pytest.raises(ConfigurationError, match="signals p, q have no value"):
        late.filter(state, [2.0], t=0.0)


def test_the_prediction_is_the_mean_of_what_is_simulated():
    inputs = [(0.5, 1.0), (-1.0, 2.0), (1.0, 0.5)]
    expected = Prediction(NOISY, DT, 2).of_one((0.3, -0.2), inputs)
    simulated = Integrator(NOISY, DT, 2, "arrays")
    count, rng = 200_000, np.random.default_rng(0)
    state = tuple(np.full(count, c) for c in (0.3, -0.2))
    for each in inputs:
        draws = rng.standard_normal((simulated.channels // 2, count))
        # Opposite draws, whose mean is exact in a linear system.
        draws = np.concatenate([draws, rng.standard_normal(draws.shape)])
        state = simulated.step(state, each, draws)
    errors = [np.std(c) / np.sqrt(count) for c in state]
    for mean, wanted, error in zip(map(np.mean, state), expected, errors, strict=True):
        assert abs(mean - wanted) < 5.0 * error + 1e-12


def test_what_was_sent_in_place_of_the_decision_counts():
    first, second = (DelayedFilter(plain_filter(), 2, DT) for _ in range(2))
    state, proposed = np.array([0.4, 0.3]), np.array([0.5, 1.0])
    for each in (first, second):
        each.filter(state, proposed)
    np.testing.assert_array_equal(first.sent[0], REST)
    first.override([-2.0, 3.0])
    np.testing.assert_array_equal(first.sent[-1], [-2.0, 3.0])
    decisions = [each.filter(state, proposed) for each in (first, second)]
    assert decisions[0].barrier != decisions[1].barrier
    first.reset()
    assert first.sent.shape == (0, 2)
    with pytest.raises(ConfigurationError, match="call filter"):
        first.override([0.0, 1.0])


@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("at", [0, 2])
def test_a_period_without_a_decision_is_not_forgotten(batch, at):
    # Two filters send the same; in one period, the first one fails, and its user falls back.
    first, second = (DelayedFilter(plain_filter(), 2, DT) for _ in range(2))
    state, fall_back = np.full((*batch, 2), 0.3), np.full((*batch, 2), 0.9)
    proposed = np.broadcast_to([0.5, 1.0], (*batch, 2))
    lost = state.copy()
    lost[..., -1] = np.nan
    for k in range(6):
        if k == at:
            with pytest.raises(InvalidInputError, match="the entry nan"):
                first.filter(lost, proposed)
            first.override(fall_back)
            second.filter(state, proposed)
            second.override(fall_back)
        else:
            mine, other = (each.filter(state, proposed) for each in (first, second))
            np.testing.assert_array_equal(mine.barrier, other.barrier)
        np.testing.assert_array_equal(first.sent, second.sent)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_nothing_is_decided_while_an_input_under_way_is_unknown(batch):
    late, state = DelayedFilter(plain_filter(), 2, DT), np.full((*batch, 2), 0.3)
    proposed = np.broadcast_to([0.5, 1.0], (*batch, 2))
    late.filter(state, proposed)
    known = late.sent
    with pytest.raises(ConfigurationError, match="parameters"):
        late.filter(state, proposed, parameters={"mass": 1.0})
    for count in (2, 3):
        with pytest.raises(ConfigurationError, match=f"the last {count} control periods"):
            late.filter(state, proposed)
    np.testing.assert_array_equal(late.sent, known)
    for value in (0.6, 0.7):
        late.override(np.full((*batch, 2), value))
    with pytest.raises(ConfigurationError, match="the last 2 control periods"):
        late.filter(state, proposed)
    for value in (0.8, 0.9):
        late.override(np.full((*batch, 2), value))
    np.testing.assert_array_equal(late.sent[..., 0], np.broadcast_to([0.8, 0.9], (*batch, 2)))
    late.override(np.full((*batch, 2), 1.0))  # and this in place of the last one
    np.testing.assert_array_equal(late.sent[..., 0], np.broadcast_to([0.8, 1.0], (*batch, 2)))
    late.filter(state, proposed)
    late.reset()
    late.filter(state, proposed)


def test_what_is_under_way_is_no_array_of_the_user():
    one = ControlAffineSDE((x,), (u,), [0], [1], [0])
    late = DelayedFilter(SafetyFilter(one, 1 - x**2, "cbf:alpha=1", (-1.0, 1.0)), 2, DT)
    late.filter(np.zeros((3, 1)), np.zeros((3, 1))).action[:] = 5.0
    sent = np.full((3, 1), 0.5)
    np.testing.assert_array_equal(late.sent, np.zeros((3, 2, 1)))
    late.override(sent)
    sent[:] = 7.0
    np.testing.assert_array_equal(late.sent[:, -1], np.full((3, 1), 0.5))


@pytest.mark.parametrize("remake", [copy.deepcopy, lambda f: pickle.loads(pickle.dumps(f))])
def test_a_copied_filter_goes_on_with_what_it_sent(remake):
    late = DelayedFilter(plain_filter(), 2, DT)
    state, proposed = np.array([0.4, 0.3]), np.array([0.9, 1.0])
    late.filter(state, proposed)
    again = remake(late)
    for _ in range(3):
        mine, other = again.filter(state, proposed), late.filter(state, proposed)
        np.testing.assert_array_equal(mine.action, other.action)
        np.testing.assert_array_equal(mine.barrier, other.barrier)


def made(*arguments, late=None, **more):
    return DelayedFilter(plain_filter() if late is None else late, *arguments, **more)


@pytest.mark.parametrize(
    ("call", "error", "fragment"),
    [
        (lambda: made(-1, DT), ConfigurationError, "delay = -1"),
        (lambda: made(1, 0.0), ConfigurationError, "dt = 0.0"),
        (lambda: made(1, "fast"), ConfigurationError, "dt"),
        (lambda: made(1, DT, 0), ConfigurationError, "substeps = 0"),
        (lambda: made(1, DT, rest=[0.0]), InvalidInputError, "rest"),
        (lambda: made(1, DT, rest=[0.0, 0.0]), ConfigurationError, "bounds"),
        *(
            (lambda other=other: made(1, DT, late=other), ConfigurationError, "SafetyFilter")
            for other in ("x", LINEAR)
        ),
        (lambda: made(1, DT).filter([0.0, np.nan], REST), InvalidInputError, r"nan at \[1\]"),
        (lambda: made(1, DT).filter([0.0], REST), InvalidInputError, "2"),
        (lambda: made(2, DT).filter(np.zeros((3, 2)), REST), InvalidInputError, "fit"),
        (lambda: made(2, DT).override([0.0]), ConfigurationError, "call filter"),
        (lambda: DelayedFilter(None, 1, DT), ConfigurationError, "SafetyFilter"),
    ],
)
def test_what_does_not_fit_is_refused(call, error, fragment):
    with pytest.raises(error, match=fragment):
        call()


@pytest.mark.parametrize("state", [[1e60], [[0.0], [1e60]]])
def test_a_prediction_without_a_value_is_an_error(state):
    fast = ControlAffineSDE((x,), (u,), [x**3], [1], [0], {})
    blown = DelayedFilter(SafetyFilter(fast, 1 - x**2, "cbf:alpha=1", (-1.0, 1.0)), 3, 1.0)
    with pytest.raises(NumericalError, match="prediction"):
        blown.filter(state, np.zeros_like(state))


def test_another_number_of_plants_needs_a_reset():
    late = made(2, DT)
    with pytest.raises(InvalidInputError, match="fit"):  # a call that fails says nothing of it
        late.filter(np.zeros((3, 2)), REST)
    late.override(REST)
    assert late.filter([0.0, 0.0], REST).action.shape == (2,)
    for call in (
        lambda: late.filter(np.zeros((3, 2)), np.zeros((3, 2))),
        lambda: late.override([1.0]),
    ):
        with pytest.raises(InvalidInputError, match=r"reset|\(2,\)"):
            call()
    late.reset()
    assert late.filter(np.zeros((3, 2)), np.zeros((3, 2)) + REST).action.shape == (3, 2)
