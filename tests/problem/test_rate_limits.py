"""Inputs of limited rate become states, and all else follows."""

from __future__ import annotations

import functools

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, SafeEnv, SafeVectorEnv
from safe_envs.dynamics.codegen import compile_function
from safe_envs.errors import ConfigurationError, InvalidInputError, SystemDefinitionError
from safe_envs.filters.conditions import parse_conditions
from safe_envs.problem.builder import define_problem
from safe_envs.problem.problem import Barrier
from safe_envs.wrappers import SafetyFilter, SafetyFilterVectorWrapper
from tests.conftest import problem_of

x, y, u, w, k = sp.symbols("x y u w k", real=True)
v = sp.Symbol("u_rate", real=True)
SYSTEM = ControlAffineSDE((x, y), (u,), [y, -k * sp.sin(x)], [0, 1], [0, 0], {k: 2.0})


def oscillator(**rest):
    given = {"input_bounds": (-2.0, 3.0), "start": [0.0, 0.0], "dt": 0.1, "horizon": 2.0}
    return define_problem(SYSTEM, 1 - x**2, **{**given, "gains": (1.0, 3.0), **rest})


def test_the_constraint_is_that_of_the_system_augmented_by_hand():
    limited = oscillator().configured(rate_limit=(-4.0, 6.0))
    rates = [y, -k * sp.sin(x) + u, 0]
    by_hand = ControlAffineSDE((x, y, u), (v,), rates, [0, 0, 1], [0, 0, 0], {k: 2.0})
    pairs = [(Barrier(1 - x**2), *parse_conditions("hocbf:alpha=1,3,5", limited))]
    hand = SafetyFilter(by_hand, pairs, input_bounds=(-4.0, 6.0))
    ours = SafetyFilter.for_problem(limited, "hocbf:alpha=1,3,5")
    # Where no bound of u is within reach of one period: -2 + .4 <= u <= 3 - .6.
    states = np.random.default_rng(0).uniform([-0.9, -1.0, -1.59], [0.9, 1.0, 2.39], (500, 3))
    proposed = np.random.default_rng(1).uniform(-4.0, 6.0, (500, 1))
    mine, theirs = (each.filter(states, proposed) for each in (ours, hand))
    np.testing.assert_allclose(mine.action, theirs.action, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(mine.slack, theirs.slack, rtol=1e-9, atol=1e-9)
    assert 0 < np.count_nonzero(mine.active) < 500


@pytest.mark.parametrize("own", [-1.0, 2.0])
def test_near_a_bound_the_rates_that_cross_it_are_left_out(own):
    limited = oscillator().configured(rate_limit=(-40.0, 40.0))
    rate = limited.plant.numeric(limited.plant.drift + limited.plant.input_matrix * sp.Matrix([v]))
    found = compile_function((u, v), [rate[2]], "floats")
    # From -2 to 3 in periods of .1 s: a rate of 40 may go as far as 4.
    assert found(own, -40.0)[0] == pytest.approx(max(-40.0, (-2.0 - own) / 0.1), rel=1e-12)
    assert found(own, 40.0)[0] == pytest.approx(min(40.0, (3.0 - own) / 0.1), rel=1e-12)


@pytest.mark.parametrize("sigma", [0.0, 0.3])
@pytest.mark.parametrize("substeps", [1, 3])
def test_inputs_and_rates_stay_within_their_bounds_for_thousands_of_steps(sigma, substeps):
    noisy = ControlAffineSDE((x,), (u, w), [-x], [[1, 1]], [[sigma]])
    given = {"start": [0.0], "dt": 0.1, "horizon": 100.0, "substeps": substeps}
    bounds = [(-1.0, 3.0), (0.2, 0.3)]
    problem = define_problem(noisy, 100 - x**2, input_bounds=bounds, **given)
    problem = problem.configured(rate_limit=[(-3.0, 8.0), (-5.0, 5.0)])
    env = SafeVectorEnv(problem, 10, autoreset_mode="Disabled")
    env.reset(seed=0)
    low, high = np.array([(-1.0, 0.2), (3.0, 0.3)])
    rates = np.array(problem.rates)
    rng, before = np.random.default_rng(0), env.state[:, 1:]
    np.testing.assert_array_equal(before, np.tile([0.0, 0.2], (10, 1)))
    for _ in range(400):
        # Long runs at the ends too.
        actions = np.sign(rng.uniform(-1.0, 1.0, (10, 2))) * rng.choice([0.3, 1.0, 1.0], (10, 2))
        env.step(actions if rng.random() < 0.3 else np.ones((10, 2)) * rng.choice([-1.0, 1.0]))
        now = env.state[:, 1:]
        assert (now >= low - 1e-14).all()
        assert (now <= high + 1e-14).all()
        assert ((now - before) / 0.1 >= rates[:, 0] - 1e-12).all()
        assert ((now - before) / 0.1 <= rates[:, 1] + 1e-12).all()
        before = now
    assert not env.episodes.ended.any()


def test_one_step_of_euler_reaches_what_a_slewing_actuator_reaches():
    noisy = ControlAffineSDE((x,), (u,), [-x], [1], [sp.Rational(1, 10)])
    given = {"start": [0.0], "dt": 0.1, "horizon": 90.0, "nominal": x * 5 - 0.3}
    problem = define_problem(noisy, 100 - x**2, input_bounds=(-1.0, 1.0), **given)
    env = SafeEnv(problem.configured(rate_limit=(-2.0, 3.0)))
    env.reset(seed=0)
    law = compile_function(
        tuple(f.symbol for f in env.problem.features), env.problem.nominal, "floats"
    )
    rng = np.random.default_rng(0)
    for _ in range(60):
        state = rng.uniform([-0.4, -1.0], [0.4, 1.0])
        env.reset(options={"state": state})
        command = float(np.clip(state[0] * 5 - 0.3, -1.0, 1.0))
        env.step_physical(law(*state))
        slewed = np.clip(command, state[1] - 0.2, state[1] + 0.3)
        assert env.state[1] == pytest.approx(slewed, abs=1e-14)


def test_what_else_follows():
    problem = problem_of("safe_envs/DubinsDisk-v0")
    limited = problem.configured(rate_limit=(-5.0, 5.0))
    assert [f.name for f in limited.features][-1] == "omega"
    assert limited.gains == (*problem.gains, 1.0 / problem.dt)
    assert [str(i.symbol) for i in limited.inputs] == ["omega_rate"]
    assert limited.inputs[0].unit == "rad/s/s"
    assert limited.frame is not None
    assert limited.frame.section[-1] == problem.inputs[0].symbol
    assert limited.configured(dt=problem.dt, input_bounds=limited.input_bounds) == limited
    assert limited.configured(noise=0.1).rates == ((-5.0, 5.0),)
    given = problem.configured(rate_limit=(-5.0, 5.0), start=[0.1, 0.0, 0.0, 1.0])
    assert SafeEnv(given).reset(seed=0)[0][-1] == 1.0
    given = problem.configured(rate_limit=(-5.0, 5.0), start=[0.1, 0.0, 0.0])
    assert SafeEnv(given).reset(seed=0)[0][-1] == 0.0
    several = define_problem(
        SYSTEM, [1 - x, 2 - y], input_bounds=(-1, 1), start=[0, 0], dt=0.1, horizon=1.0
    ).configured(rate_limit=(-1, 1))
    assert [len(gains) for gains in several.gains] == [3, 2]
    acc = problem_of("safe_envs/ACC-v0").configured(rate_limit=(-1e4, 1e4))
    assert (acc.filter, acc.clf) == ("szcbf", None)


@pytest.mark.oracle
def test_compiled_programs_have_the_same_rates():
    pytest.importorskip("numba")
    make = functools.partial(gym.make_vec, "safe_envs/Pendulum-v0", num_envs=2)
    options = {"autoreset_mode": "SameStep", "rate_limit": (-20.0, 50.0), "horizon": 0.06}
    envs = [
        SafetyFilterVectorWrapper(make(engine=engine, **options), "szcbf:alpha=1,50")
        for engine in ("numpy", "compiled")
    ]
    for env in envs:
        env.reset(seed=1)
    for _ in range(9):
        (ours, *_, mine), (theirs, *_, other) = [env.step(np.full((2, 1), 0.7)) for env in envs]
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)
        np.testing.assert_allclose(mine["safe_action"], other["safe_action"], rtol=1e-9)


@pytest.mark.parametrize(
    "options", [{"dt": 0.01}, {"input_bounds": (-1, 1)}, {"rate_limit": (-1, 1)}]
)
def test_what_the_rates_come_from_is_changed_together_or_not_at_all(options):
    limited = oscillator().configured(rate_limit=(-4.0, 6.0))
    with pytest.raises(ConfigurationError, match=f"{next(iter(options))}: "):
        limited.configured(**options)
    together = oscillator().configured(**{"rate_limit": (-4.0, 6.0), **options})
    assert len(together.states) == 3


def test_names_that_are_taken_are_refused():
    system = ControlAffineSDE((x, v), (u,), [v, 0], [0, 1], [0, 0])
    problem = define_problem(
        system, 1 - x**2, input_bounds=(-1, 1), start=[0, 0], dt=0.1, horizon=1.0
    )
    with pytest.raises(SystemDefinitionError, match="u_rate"):
        problem.configured(rate_limit=(-1.0, 1.0))


@pytest.mark.parametrize("make", [SafeEnv, lambda problem: SafeVectorEnv(problem, num_envs=2)])
def test_episodes_begin_with_inputs_within_their_bounds(make):
    env = make(oscillator().configured(rate_limit=(-1.0, 1.0)))
    for given in (3.0 + 1e-6, -2.0 - 1e-6, 4.0):
        with pytest.raises(InvalidInputError, match=r"\[-2.0, 3.0\]"):
            env.reset(options={"state": [0.1, 0.2, given]})
    for given in (3.0, -2.0, np.nextafter(3.0, 4.0)):  # as a simulation may have rounded it
        state = np.ravel(env.reset(options={"state": [0.1, 0.2, given]})[0])[:3]
        np.testing.assert_allclose(state, [0.1, 0.2, given])
