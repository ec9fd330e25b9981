"""Measurements as options: texts, names and numbers, and what they say when they are wrong."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, SafeEnv, SystemDefinitionError
from safe_envs.agents.evaluation.attainable import attainable_safety
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.builder import define_problem
from safe_envs.problem.measurement import Channel, Measurement, default_measurement
from safe_envs.problem.signals import TIME, Feature
from safe_envs.values.reduction import reduced
from safe_envs.values.tables import ValueSettings
from tests.conftest import problem_of

ACC, SCALAR = "safe_envs/ACC-v0", "safe_envs/Scalar-v0"


OWN = """
import sympy as sp
from safe_envs import ControlAffineSDE, define_problem

x, v, u = sp.symbols("x v u", real=True)
system = ControlAffineSDE.from_rate((x, v), (u,), [v, u])
problem = define_problem(system, 1 - x, input_bounds=(-1, 1), start=[0.0, 0.0], dt=0.1, horizon=1.0)
"""


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
        ("", "nothing"),
        ([], "0 items"),
        (["gap"] * 101, "101 items"),
        (5, "measurement = 5"),
        ("speed:noise=1", "'speed'"),
        ("x_1", "'x_1' has no noise"),
        ("f_0:noise=1", "depends on no state.* x_1, x_2, x_3"),
        ("x_1:noise=nan", "not finite"),
        ("x_1:noise=x", "not a number"),
        ("x_1:noise=1e39", r"noise = 1e\+39 of the measurement x_1"),
        ("x_1:noise=1:noise=1", "noise comes twice"),
        ("x_1:nois=1", "'nois'; did you mean 'noise'"),
        ("x_1:noise=1:dropout=1", "= 1; give a probability"),
        ("x_1:noise=1:period=1e-20", "1e-09"),
        ("default:period=3", "leave it out"),
        ("noise=1", "none of noise"),
        *(
            (f"{name}:noise=1", "NAME=EXPR")
            for name in ("default=x_1", "a b=x_1", "a=b=x_1", "=x_1")
        ),
        *((f"delay={n}", "from 0 to 1000") for n in ("-1", "1e9", "1.5")),
        ("delay=2:noise=1", "alone, like delay=2"),
        ({"delay": "soon"}, "not a number"),
        (["delay=1", "delay=2"], "'delay' more than once"),
        (["gap", "gap"], "'gap' more than once"),
        (["default", "gap"], "own_speed, relative_speed, gap, gap"),
        # Texts from strangers run no code, and take no time.
        ("__import__('os').getcwd():noise=1", "is not allowed"),
        ("x_1.__class__:noise=1", "is not allowed"),
        ("x_1**x_2:noise=1", "exponent x_2"),
        ("x_1**9**9**9:noise=1", "exponent"),
        ("(" * 300 + "x_1" + ")" * 300 + ":noise=1", "is no expression"),
        ("x_1+" * 20000 + "x_1:noise=1", "at most 1000 characters"),
        ("x\u2081:noise=1", "beyond ASCII"),
        ("log(x_1 - x_1):noise=1", "not real"),
    ],
)
def test_what_is_wrong_is_named(given, message):
    with pytest.raises(ConfigurationError, match=message):
        problem_of(ACC).configured(measurement=given)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"measurement": "default", "sensor_noise": f}, "sensor_noise") for f in (-1, math.nan)),
        ({"measurement": "default", "sensor_noise": "two"}, "sensor_noise"),
        ({"sensor_noise": 2.0}, "nothing is measured"),
    ],
)
def test_a_factor_of_the_noise_is_a_number_from_zero_and_needs_a_sensor(options, message):
    with pytest.raises(ConfigurationError, match=message):
        problem_of(ACC).configured(**options)


@pytest.mark.parametrize(
    ("expression", "message"), [(sp.Symbol("w"), "symbol w"), (sp.Integer(1), "no state")]
)
def test_channels_of_unknown_symbols_or_without_a_state_are_refused(expression, message):
    with pytest.raises(SystemDefinitionError, match=message):
        problem_of(ACC).configured(measurement=Measurement((Channel("y", expression, 1.0),)))


def own_problem(**options):
    x, v, u = sp.symbols("x v u", real=True)
    system = ControlAffineSDE((x, v), (u,), [v, 0], [0, 1], [0, 0])
    given = {"input_bounds": (-1, 1), "start": (0, 0), "dt": 0.1, "horizon": 1.0, **options}
    return define_problem(system, 1 - x, **given)


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
    (tmp_path / "own.py").write_text(OWN)
    place = f"{tmp_path / 'own.py'}:problem"
    env = gym.make("safe_envs/Custom-v0", system=place, measurement=["default", "delay=1"])
    observation, _ = env.reset(seed=0)
    assert observation.tolist() == [0.0, 0.0]
    assert [c.name for c in env.unwrapped.problem.measurement.channels] == ["x", "v"]


def test_tables_of_a_problem_do_not_depend_on_its_sensor():
    plain, measured = (problem_of(SCALAR, measurement=m) for m in (None, "default"))
    assert reduced(measured, "plant").fingerprint == reduced(plain, "plant").fingerprint


@pytest.mark.oracle
def test_what_is_attainable_does_not_depend_on_the_sensor():
    settings = ValueSettings(knowledge="plant", cells=(41,), inputs=5)
    plain, measured = (problem_of(SCALAR, measurement=m) for m in (None, "default"))
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
    low, high = problem_of(ACC).input_bounds[0]
    expected = 1e-3 * (high - low) if given == "default" else 2.0
    assert found["u"].noise == pytest.approx(expected)
    SafeEnv(problem).reset(seed=0)


def test_what_was_measured_stays_when_rates_are_limited():
    before = problem_of(ACC).configured(measurement="default")
    assert before.configured(rate_limit=(-5000, 5000)).measurement == before.measurement


x, y, theta, k = sp.symbols("x y theta k", real=True)
p = sp.Symbol("p", positive=True)
TURN = 2 * math.pi
BEARING = sp.atan2(y, x)


@pytest.mark.parametrize(
    ("expression", "period"),
    [
        (BEARING, TURN),
        (180 / sp.pi * BEARING, 360.0),
        (90 - 180 / math.pi * BEARING, 360.0),
        (BEARING - theta, TURN),
        (theta - BEARING / 2, math.pi),
        (BEARING - 2 * sp.atan2(y - 1, x), TURN),
        (sp.atan2(sp.sin(theta - BEARING), sp.cos(theta - BEARING)), TURN),
        (sp.atan(y / x), math.pi),
        (2 * sp.atan(y / (x + sp.sqrt(x**2 + y**2))), TURN),
        (sp.atan(sp.tan(theta)), math.pi),
        (5 * sp.acot(x), 5 * math.pi),
        (sp.Mod(180 / sp.pi * BEARING, 360), 360.0),
        (sp.Mod(theta, TURN), TURN),
        (sp.frac(theta / 7), 1.0),
        # These have no jump.
        (sp.cos(BEARING), 0.0),
        (sp.Abs(BEARING), 0.0),
        (BEARING**2, 0.0),
        (sp.atan(x), 0.0),
        (sp.atan(y / (1 + x**2)), 0.0),
        (sp.atan2(y, p), 0.0),
        (100 * theta, 0.0),
    ],
)
def test_the_period_of_a_measured_angle_is_the_size_of_its_jump(expression, period):
    assert Channel("b", expression, 0.1).period == pytest.approx(period, rel=1e-14)


@pytest.mark.parametrize(
    "expression",
    [
        x * BEARING,
        k * BEARING,
        BEARING + sp.sqrt(2) * sp.atan2(y - 1, x),
        sp.Piecewise((BEARING, BEARING > 0), (BEARING + 2 * sp.pi, True)),
        sp.atan2(BEARING, x),
        sp.Mod(BEARING, 3),
        sp.floor(BEARING),
        sp.Max(BEARING, x),
    ],
)
def test_a_period_that_does_not_follow_has_to_be_stated(expression):
    with pytest.raises(ConfigurationError, match=r"measurement b does not follow .*period="):
        Channel("b", expression, 0.1)
    assert Channel("b", expression, 0.1, period=0).period == 0.0


def test_a_stated_period_fits_the_jump():
    for period in (TURN, math.pi, 6.28319, 0):
        assert Channel("b", BEARING, 0.1, period=period).period == period
    for period in (6.28, 360, 2 * TURN):
        with pytest.raises(ConfigurationError, match=r"jumps by 6.28319"):
            Channel("b", BEARING, 0.1, period=period)
    with pytest.raises(SystemDefinitionError, match="measurement b is a text"):
        Channel("b", "x", 0.1)  # pyright: ignore[reportArgumentType]


def test_texts_and_features_have_the_period_of_their_expression():
    disk = "safe_envs/DubinsDisk-v0"
    texts = [
        "b=180/pi*atan2(y, x):noise=.1",
        "c=atan(y/x):noise=1",
        "d=atan2(y, x):noise=1:period=0",
    ]
    assert [c.period for c in channels(texts, disk).values()] == [360.0, math.pi, 0.0]
    with pytest.raises(ConfigurationError, match="measurement b does not follow"):
        channels("b=v*atan2(y, x):noise=.1", disk)
    feature = Feature("course", 3 * sp.atan2(*own_problem().plant.states), -10.0, 10.0)
    found = default_measurement(own_problem(features=(feature,))).channels
    assert [c.period for c in found] == pytest.approx([6 * math.pi])
    for c in problem_of("safe_envs/DubinsObstacle-v0", measurement="default").measurement.channels:
        assert c.period == (TURN if c.name in ("theta", "bearing") else 0.0)
