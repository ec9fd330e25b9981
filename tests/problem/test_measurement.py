"""Measurements as options: texts, names and numbers, and what they say when they are wrong."""

from __future__ import annotations

import math
import time

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, SafeEnv, SystemDefinitionError
from safe_envs.agents.evaluation.attainable import attainable_safety
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.builder import state_problem
from safe_envs.problem.measurement import Channel, Measurement, default_measurement
from safe_envs.problem.signals import TIME, Feature
from safe_envs.values.reduction import reduced
from safe_envs.values.tables import ValueSettings
from tests.conftest import problem_of
from tests.scripts.own_system import SYSTEM

ACC, SCALAR = "safe_envs/ACC-v0", "safe_envs/Scalar-v0"


def channels(given, env_id=ACC, **options):
    problem = problem_of(env_id).configured(measurement=given, **options)
    return {c.name: c for c in problem.measurement.channels}


@pytest.mark.parametrize(
    ("given", "names", "delay"),
    [
        ("default", ["own_speed", "relative_speed", "gap"], 0),
        ("delay=4", ["own_speed", "relative_speed", "gap"], 4),
        (["gap", "delay = 2"], ["gap"], 2),
        (["default", "x_1:noise=1"], ["own_speed", "relative_speed", "gap", "x_1"], 0),
        ({"x_1": 0.5, "q=x_3*x_1": {"noise": 2, "bias": -1}, "delay": 1}, ["x_1", "q"], 1),
        (" far = x_3 : noise = 2 ", ["far"], 0),
    ],
)
def test_texts_lists_and_mappings_name_channels(given, names, delay):
    found = problem_of(ACC).configured(measurement=given).measurement
    assert [c.name for c in found.channels] == names
    assert found.delay == delay


def test_settings_of_texts_are_those_of_channels():
    x_1, x_2, x_3 = problem_of(ACC).plant.states
    found = channels(["default:bias=.1:dropout=.25", "r=sqrt(x_1**2+x_3**2):noise=2:period=7"])
    assert found["gap"] == Channel("gap", x_3, 0.5, 0.1, 0.25)
    assert found["relative_speed"].expression == x_2 - x_1
    assert found["r"] == Channel("r", sp.sqrt(x_1**2 + x_3**2), 2.0, period=7.0)
    # A channel of the default sensor brings its settings along, under another name too.
    assert channels("radar=gap:bias=1")["radar"] == Channel("radar", x_3, 0.5, 1.0)


def test_bearings_have_the_period_of_a_turn_unless_another_is_stated():
    texts = ["a=atan2(y, x):noise=.1", "b=atan2(y, x):noise=.1:period=0"]
    found = channels(texts, "safe_envs/DubinsDisk-v0")
    assert [c.period for c in found.values()] == [2.0 * math.pi, 0.0]


def test_the_factor_of_the_noise_multiplies_every_deviation():
    usual, twice = channels("default"), channels("default", sensor_noise=2.0)
    for name, channel in usual.items():
        assert twice[name].noise == 2.0 * channel.noise
    problem = problem_of(ACC).configured(measurement="default").configured(sensor_noise=0)
    assert [c.noise for c in problem.measurement.channels] == [0.0] * 3


def test_the_problem_without_its_sensor_is_the_one_it_was_made_of():
    problem = problem_of(ACC)
    assert problem.unmeasured is problem
    assert problem.configured(measurement="default").unmeasured == problem


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("", "names nothing that is measured"),
        ([], "has 0 items; give 1 to 100"),
        (["gap"] * 101, "has 101 items"),
        (5, "measurement = 5; give 'default'"),
        ([1], r"measurement = \[1\]; give 'default'"),
        (b"default", "give 'default'"),
        ("speed:noise=1", "unknown name 'speed'"),
        ("x_1", "'x_1' has no noise; give its standard deviation, x_1:noise=S"),
        ("f_0:noise=1", "depends on no state; give an expression of the states x_1, x_2, x_3"),
        ("3:noise=1", "depends on no state"),
        ("x_1:noise=nan", "not finite"),
        ("x_1:noise=-1", "= -1; give a number from 0"),
        ("x_1:noise=x", "not a number"),
        ("x_1:noise=1e39", r"noise = 1e\+39 of the measurement x_1"),
        ("x_1:noise=1:noise=1", "noise comes twice"),
        ("x_1:nois=1", "unknown setting 'nois'; did you mean 'noise'"),
        ("x_1:noise=1:dropout=1", "= 1; give a probability from 0, below 1"),
        ("x_1:noise=1:period=1e-20", "give 0 for none, or a number from 1e-09"),
        ("default:period=3", "leave it out"),
        ("noise=1", "none of noise, bias, dropout, period, default, delay"),
        ("default=x_1:noise=1", "give NAME=EXPR"),
        ("a b=x_1:noise=1", "give NAME=EXPR"),
        ("a=b=x_1:noise=1", "give NAME=EXPR"),
        ("=x_1:noise=1", "give NAME=EXPR"),
        ("delay=-1", "from 0 to 1000"),
        ("delay=1e9", "from 0 to 1000"),
        ("delay=1.5", "from 0 to 1000"),
        ("delay=2:noise=1", "alone, like delay=2"),
        ({"delay": "soon"}, "not a number"),
        (["delay=1", "delay=2"], "'delay' more than once"),
        (["gap", "gap"], "'gap' more than once"),
        (["default", "gap"], "channels own_speed, relative_speed, gap, gap"),
        ("__import__('os').getcwd():noise=1", "is not allowed"),
        ("x_1.__class__:noise=1", "is not allowed"),
        ("x_1**x_2:noise=1", "the exponent x_2 is no number"),
        ("x_1**9**9**9:noise=1", "exponent"),
        ("(" * 300 + "x_1" + ")" * 300 + ":noise=1", "is no expression"),
        ("x_1+" * 20000 + "x_1:noise=1", "in at most 1000 characters"),
        ("x\u2081:noise=1", "beyond ASCII"),
        ("log(x_1 - x_1):noise=1", "not real"),
    ],
)
def test_what_is_wrong_is_said_soon(given, message):
    problem = problem_of(ACC)
    begun = time.process_time()
    with pytest.raises(ConfigurationError, match=message):
        problem.configured(measurement=given)
    assert time.process_time() - begun < 1.0


@pytest.mark.parametrize("factor", [-1, math.nan, "two"])
def test_a_factor_of_the_noise_is_a_number_from_zero(factor):
    with pytest.raises(ConfigurationError, match="sensor_noise"):
        problem_of(ACC).configured(measurement="default", sensor_noise=factor)


def test_a_factor_needs_a_sensor():
    with pytest.raises(ConfigurationError, match="nothing is measured; give measurement='default'"):
        problem_of(ACC).configured(sensor_noise=2.0)


def test_channels_of_unknown_symbols_or_without_a_state_are_refused():
    for expression, message in ((sp.Symbol("w"), "unknown symbol w"), (sp.Integer(1), "no state")):
        with pytest.raises(SystemDefinitionError, match=message):
            problem_of(ACC).configured(measurement=Measurement((Channel("y", expression, 1.0),)))


def own_problem(**options):
    x, v, u = sp.symbols("x v u", real=True)
    system = ControlAffineSDE((x, v), (u,), [v, 0], [0, 1], [0, 0])
    given = {"box": (-1, 1), "start": (0, 0), "dt": 0.1, "horizon": 1.0, **options}
    return state_problem(system, 1 - x, **given)


def test_a_system_without_ranges_has_a_sensor_of_its_states():
    found = default_measurement(own_problem())
    assert [(c.name, c.noise) for c in found.channels] == [("x", 0.01), ("v", 0.01)]
    env = SafeEnv(own_problem().configured(measurement="default"))
    assert np.isfinite(env.observation_space.low).all()
    env.reset(seed=0)


def test_a_system_of_ones_own_states_its_sensor(tmp_path):
    v = sp.Symbol("v", real=True)
    problem = own_problem(sensors=(Channel("speed", v, 0.3),))
    found = problem.configured(measurement=["default:bias=1", "x:noise=1"]).measurement
    assert [(c.name, c.noise, c.bias) for c in found.channels] == [
        ("speed", 0.3, 1.0),
        ("x", 1.0, 0.0),
    ]
    with pytest.raises(SystemDefinitionError, match="unknown symbol w"):
        own_problem(sensors=(Channel("speed", sp.Symbol("w"), 0.3),))
    with pytest.raises(ConfigurationError, match="give a Channel for each number"):
        own_problem(sensors=(v,))
    (tmp_path / "own.py").write_text(SYSTEM)
    place = f"{tmp_path / 'own.py'}:problem"
    env = gym.make("safe_envs/Custom-v0", system=place, measurement=["default", "delay=1"])
    observation, _ = env.reset(seed=0)
    assert observation.tolist() == [0.0, 0.0]
    assert [c.name for c in env.unwrapped.problem.measurement.channels] == ["x", "v"]


def test_tables_of_a_problem_do_not_depend_on_its_sensor():
    plain, measured = (problem_of(SCALAR, measurement=m) for m in (None, "default"))
    assert reduced(measured, "plant").fingerprint == reduced(plain, "plant").fingerprint
    settings = ValueSettings(knowledge="plant", cells=(41,), inputs=5)
    found = [attainable_safety(p, settings, episodes=0)[0] for p in (plain, measured)]
    assert (found[0].lower, found[0].upper) == (found[1].lower, found[1].upper)


def test_features_of_time_are_no_part_of_a_sensor():
    x, v = sp.symbols("x v", real=True)
    features = (
        Feature("ahead", sp.sin(TIME) - x, -5.0, 5.0),
        Feature("clock", TIME, 0.0, 1.0),
        Feature("twice", 2 * v, -3.0, 3.0),
    )
    problem = own_problem(features=features, workspace={x: (-2.0, 3.0)}, name="timed")
    found = default_measurement(problem)
    assert [(c.name, c.noise) for c in found.channels] == [("twice", 0.06), ("x", 0.05)]
    for name in ("ahead", "clock"):
        with pytest.raises(ConfigurationError, match="depends on t"):
            problem.configured(measurement=f"{name}:noise=1")
    env = SafeEnv(problem.configured(measurement=["default:noise=0", "delay=1"]))
    env.reset(seed=0)
    before = env.state
    observation, *_ = env.step(np.array([1.0]))
    np.testing.assert_allclose(observation, [2 * before[1], before[0]])


def test_ranges_of_channels_leave_room_for_their_errors():
    texts = ["x_1:noise=.5:bias=-2", "x_1*x_3:noise=1"]
    box = SafeEnv(problem_of(ACC, measurement=texts)).observation_space
    np.testing.assert_allclose(box.low, [0 - 2 - 5, -1e6 - 10])
    np.testing.assert_allclose(box.high, [50 + 2 + 5, 1e6 + 10])


@pytest.mark.parametrize("given", ["default", ["x_1:noise=1", "u:noise=2"]])
def test_inputs_of_limited_rate_are_measured_with_the_states(given):
    problem = problem_of(ACC).configured(rate_limit=(-5000, 5000), measurement=given)
    found = {c.name: c for c in problem.measurement.channels}
    low, high = problem_of(ACC).box[0]
    expected = 1e-3 * (high - low) if given == "default" else 2.0
    assert found["u"].noise == pytest.approx(expected)
    SafeEnv(problem).reset(seed=0)


def test_what_was_measured_stays_when_rates_are_limited():
    before = problem_of(ACC).configured(measurement="default")
    assert before.configured(rate_limit=(-5000, 5000)).measurement == before.measurement
