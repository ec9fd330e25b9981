"""A reduced problem moves, and judges, as the simulation does."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, define_problem
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.integrators import Integrator
from safe_envs.envs.simulation import Simulation
from safe_envs.problem.signals import TIME
from safe_envs.registry import make_problem
from safe_envs.values.reduction import reduced

COORDINATES = {
    "DubinsDisk": ("distance", "phi"),
    "DubinsObstacle": ("x", "y", "theta"),
    "StochasticDubins": ("distance", "phi"),
    "QuadrotorAltitude": ("z", "zdot"),
    "ACC": ("x_1", "x_3"),
    "ACCGap": ("v", "z"),
    "Pendulum": ("theta", "thetadot"),
    "CubicSDE": ("x_1", "x_2"),
    "CubicSDEDisk": ("x_1", "x_2"),
    "Scalar": ("x",),
}
QUICK = ("Scalar", "StochasticDubins", "DubinsObstacle", "ACC")
x, y, p, u, a, b, s = sp.symbols("x y p u a b s", real=True)
NUMBERS = {"input_bounds": (-1.0, 1.0), "dt": 0.1, "horizon": 1.0}


def problem_of(name: str, **options):
    return make_problem(f"safe_envs/{name}-v0", **options)


def sampled(problem, count: int = 50):
    """Return states, in the workspace, and inputs."""
    random = np.random.default_rng(1)
    low, high = np.array(
        [(v.low, v.high) if math.isfinite(v.low) else (-9.0, 9.0) for v in problem.states]
    ).T
    states = low[:, None] + (high - low)[:, None] * random.random((len(low), count))
    box = np.array(problem.input_bounds)
    return states, box[:, :1] + (box[:, 1:] - box[:, :1]) * random.random((len(box), count))


def stepped(found, q, inputs, draws, instant: int, values=()):
    """Apply a sub-step that begins at an instant."""
    symbols = (*found.symbols, *found.inputs, *found.noise, *found.known, *found.intervals)
    step = compile_function(symbols, found.step, "arrays")
    return step(*q, *inputs, *draws, *(v[instant] for v in found.known.values()), *values)


def require_same(found, q, wanted):
    for coordinate, value, right in zip(found.coordinates, q, wanted, strict=True):
        apart = value - right
        if coordinate.period:
            apart = (apart + coordinate.period / 2) % coordinate.period - coordinate.period / 2
        scale = max(1.0, abs(coordinate.low), abs(coordinate.high))
        assert abs(apart).max() < 1e-12 * scale, coordinate.symbol


def put_known(found, states, instant: int):
    """Set the states that are known in advance to their values at an instant."""
    problem = found.problem
    start = problem.starts[problem.start].state
    for i, state in enumerate(problem.plant.states):
        if state in found.known:
            states[i] = found.known[state][instant]
        elif found.note == "" and problem.frame is None and state not in found.symbols:
            states[i] = float(start[i])
    return states


@pytest.mark.parametrize(
    ("name", "options", "knowledge"),
    [
        *(
            pytest.param(name, {}, "plant", marks=[] if name in QUICK else [pytest.mark.oracle])
            for name in COORDINATES
        ),
        ("DubinsObstacle", {}, "model"),
        ("StochasticDubins", {"substeps": 3}, "plant"),
        ("DubinsDisk", {"noise": 0.1, "substeps": 2}, "model"),
        ("DubinsObstacle", {"substeps": 2, "noise": 0.1}, "plant"),
        ("DubinsObstacles", {"start": (-5.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0)}, "plant"),
    ],
)
def test_a_step_in_coordinates_is_the_step_of_the_simulation(name, options, knowledge):
    problem = problem_of(name, **options)
    if knowledge == "model":
        problem = replace(problem, plant=problem.model)
    found = reduced(problem, knowledge)
    if not options:
        assert tuple(map(str, found.symbols)) == COORDINATES[name]
    instant = 5 * problem.substeps
    states, inputs = sampled(problem)
    x, inputs = tuple(put_known(found, states, instant)), tuple(inputs)
    random = np.random.default_rng(2)
    channels = len(found.noise)
    assert channels * problem.substeps == Simulation(problem, "arrays").integrator.channels
    integrator = Integrator(problem.plant, problem.dt / problem.substeps, 1, "arrays")
    q, draws, seen = found.of_states(x), [], x
    for k in range(problem.substeps):
        w = random.standard_normal((channels, inputs[0].size))
        seen_w = turned(w, seen) if found.problem.frame and channels else w
        q = stepped(found, q, inputs, seen_w, instant + k)
        seen = integrator.step(seen, inputs, w)
        draws += [*w]
    simulation = Simulation(problem, "arrays")
    after = simulation.integrator.step(x, inputs, draws)
    require_same(found, q, found.of_states(after))
    require_same_readings(found, simulation, x, instant)


def require_same_readings(found, simulation, x, instant: int):
    """Check barriers, goal and workspace at states against those of the simulation."""
    problem = found.problem
    _, h, _, outside, goal = simulation.measure(x, [0.0] * len(problem.inputs), 0.0)
    read = (*found.barriers, sp.sympify(found.goal if found.goal is not None else -1))
    function = compile_function((*found.symbols, *found.known), (*read, found.outside), "arrays")
    values = function(*found.of_states(x), *(v[instant] for v in found.known.values()))
    for value, right in zip(values[:-1], (*h, goal), strict=True):
        np.testing.assert_allclose(value, right, rtol=1e-11, atol=1e-11)
    if problem.frame is None:
        np.testing.assert_allclose(values[-1], np.broadcast_to(outside, x[0].shape), rtol=1e-12)
    else:
        assert (h[0][outside > 0.0] < 0.0).all()
        assert values[-1] == -1.0


def turned(w, x):
    """Return noise as it is seen from a state that is turned onto the first axis: as likely."""
    angle = np.arctan2(x[1], x[0])
    cos, sin = np.cos(angle), np.sin(angle)
    return cos * w[0] + sin * w[1], cos * w[1] - sin * w[0]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("DubinsObstacle", {"noise": 0.1}),
        ("DubinsObstacles", {"start": (-5.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0)}),
    ],
)
def test_known_states_are_those_of_the_simulation(name, options):
    problem = problem_of(name, substeps=2, horizon=3.0, **options)
    found, simulation = reduced(problem), Simulation(problem, "floats")
    paths = [tuple(map(float, problem.starts[problem.start].proposals(1)[0]))]
    draws = [0.3] * simulation.integrator.channels
    for _ in range(problem.steps):
        paths.append(simulation.integrator.step(paths[-1], (0.2,), draws))
    assert found.known
    for state, values in found.known.items():
        assert values.shape == (problem.steps * 2 + 1,)
        path = np.array(paths)[:, problem.plant.states.index(state)]
        np.testing.assert_allclose(values[::2], path, rtol=1e-13, atol=1e-13)


def test_coordinates_of_one_state_are_those_of_a_batch():
    found = reduced(problem_of("StochasticDubins"))
    assert found.of_states((3.0, 4.0, 1.0)) == pytest.approx((5.0, 1.0 - math.atan2(4.0, 3.0)))
    assert found.of_states((0.0, 0.0, 1.0)) == (0.0, 1.0)
    batch = found.of_states((np.array([3.0]), np.array([4.0]), np.array([1.0])))
    assert np.concatenate(batch).tolist() == list(found.of_states((3.0, 4.0, 1.0)))


def test_constant_states_become_numbers():
    found = reduced(problem_of("ACC"))
    assert not found.known
    assert {e.name for e in found.step[1].free_symbols} == {"x_1", "x_3"}
    assert reduced(problem_of("ACC", start=(15.0, 25.0, 150.0))).step[1] != found.step[1]


def custom(rate, start, barriers=1 - x**2, diffusion=None, states=(x, y), parameters=None, **rest):
    system = ControlAffineSDE.from_rate(states, (u,), rate, diffusion, parameters or {})
    return define_problem(system, barriers, start=start, **{**NUMBERS, **rest})


def test_a_state_is_known_only_if_all_that_moves_it_is():
    # p follows y, y follows the clock b; with a start of b that is drawn none of them is known.
    def problem_from(start_of_b):
        workspace = dict.fromkeys((x, y, p, b), (-9.0, 9.0))
        rate = [u + y, p, -b * y, 1]
        start = [0, 1, 0, start_of_b]
        return custom(rate, start, states=(x, y, p, b), workspace=workspace)

    assert list(map(str, reduced(problem_from(0.5)).symbols)) == ["x"]
    assert list(map(str, reduced(problem_from((0.0, 0.5))).symbols)) == ["x", "y", "p", "b"]
    # Noise and uncertain parameters are no knowledge.
    clock = {"start": [0, 0], "workspace": dict.fromkeys((x, y), (-9.0, 9.0)), "parameters": {a: 1}}
    drifting = custom([u + y, a], **clock)
    assert list(map(str, reduced(drifting).symbols)) == ["x"]
    assert list(map(str, reduced(drifting, intervals={"a": (1, 2)}).symbols)) == ["x", "y"]
    noisy = custom([u + y, 0], diffusion=[0, a], **clock)
    assert list(map(str, reduced(noisy).symbols)) == ["x", "y"]


def test_time_in_a_goal_is_known():
    found = reduced(replace(problem_of("Scalar"), goal=TIME - 1, substeps=4))
    assert found.goal == TIME - 1
    problem = found.problem
    np.testing.assert_allclose(found.known[TIME][::4], np.arange(problem.steps + 1) * problem.dt)
    assert TIME not in reduced(problem_of("Scalar")).known


def test_intervals_keep_parameters_symbolic_in_drift_and_noise():
    problem = problem_of("ACCGap")
    found = reduced(problem, intervals={"M": (1500, 1800), "sigma_2": (0.1, 0.9)})
    assert {s.name: ends for s, ends in found.intervals.items()} == {
        "M": (1500.0, 1800.0),
        "sigma_2": (0.1, 0.9),
    }
    states, inputs = sampled(problem)
    draws = np.random.default_rng(3).standard_normal((2, len(states[0])))
    q = stepped(found, states, inputs, draws, 0, values=(1700.0, 0.2))
    changed = problem_of("ACCGap", plant={"M": 1700.0, "sigma_2": 0.2})
    after = Simulation(changed, "arrays").integrator.step(tuple(states), tuple(inputs), draws)
    require_same(found, q, after)


def test_an_interval_keeps_the_symbol_of_a_positive_parameter_apart():
    mass = sp.Symbol("mass", positive=True)
    problem = custom(
        [y, u / mass], [0, 0], parameters={mass: 2.0}, workspace={y: (-9, 9), x: (-9, 9)}
    )
    found = reduced(problem, intervals={"mass": (1.0, 3.0)})
    (symbol,) = found.intervals
    assert symbol.name == "mass"
    assert symbol in found.step[1].free_symbols
    with pytest.raises(ConfigurationError, match="parameter mass = -1"):
        reduced(problem, intervals={"mass": (-1.0, 3.0)})


@pytest.mark.parametrize(
    ("intervals", "fragment"),
    [
        ({"speed": (1, 2)}, "'speed'"),
        ({"a": (2, 1)}, "low end"),
        ({"a": 1}, r"\(low, high\)"),
        ({"a": (0, math.inf)}, "finite"),
        ({"a": (-1, 2)}, "division"),
        ({"s": (0, 2)}, "above 0"),
    ],
)
def test_intervals_that_are_refused(intervals, fragment):
    bounds = {"workspace": dict.fromkeys((x, y), (-9, 9)), "parameters": {a: 1.0, s: 0.5}}
    problem = custom([y, u / a], [0, 0], diffusion=[0, s], **bounds)
    assert reduced(problem, intervals={"a": (1, 2), "s": (0.1, 2)}).intervals
    with pytest.raises(ConfigurationError, match=fragment):
        reduced(problem, intervals=intervals)


@pytest.mark.parametrize(
    ("name", "knowledge", "fragment"),
    [
        ("Quadrotor", "plant", "12 coordinates .*psidot"),
        ("DubinsObstacles", "plant", "8 coordinates .*phase_5"),
        ("Scalar", "planet", "'planet'"),
    ],
)
def test_problems_that_no_grid_covers_are_refused(name, knowledge, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        reduced(problem_of(name), knowledge)


@pytest.mark.parametrize("rate", [sp.sin(y), sp.cos(2 * y)])
def test_what_repeats_is_periodic(rate):
    found = reduced(custom([rate + u, 1 + u], [0, (0.0, 0.5)], workspace={x: (-9, 9)}))
    angle = found.coordinates[1]
    assert (angle.low, angle.high, angle.period) == (-math.pi, math.pi, 2 * math.pi)


@pytest.mark.parametrize(
    ("rates", "options"),
    [
        ([sp.sin(y / 2) + u, 1 + u], {}),
        ([y + u, 1 + u], {}),
        # Read though nothing else depends on it; bounded on one side; judged.
        ([sp.sin(y) + u, -y + u], {}),
        ([sp.sin(y) + u, u], {"workspace": {x: (-9, 9), y: (-1, math.inf)}}),
        ([sp.sin(y) + u, u], {"barriers": [1 - x**2, 1 + y]}),
    ],
)
def test_what_does_not_repeat_needs_bounds(rates, options):
    with pytest.raises(ConfigurationError, match="y lacks finite bounds"):
        reduced(custom(rates, [0, (0.0, 0.5)], **{"workspace": {x: (-9, 9)}, **options}))


def test_fingerprints_tell_chains_apart():
    plain = reduced(problem_of("DubinsObstacle")).fingerprint
    assert len(plain) == 64
    assert reduced(problem_of("DubinsObstacle")).fingerprint == plain
    others = [
        reduced(problem_of("DubinsObstacle"), "model"),
        *(reduced(problem_of("DubinsObstacle"), intervals={"v": (0.5, e)}) for e in (0.8, 0.9)),
        *(
            reduced(problem_of("DubinsObstacle", **options))
            for options in (
                {"dt": 0.1},
                {"substeps": 2},
                {"horizon": 10.0},
                {"input_bounds": (-1.0, 1.0)},
                {"noise": 0.1},
                {"plant": {"v_o": 0.6}},
                {"start": (0.0, 0.0, 0.0, 1.0, 0.0)},
                {"radius": 0.6},
            )
        ),
        reduced(replace(problem_of("DubinsObstacle"), goal=TIME - 1)),
    ]
    fingerprints = [found.fingerprint for found in others]
    assert plain not in fingerprints
    assert len(set(fingerprints)) == len(fingerprints)
    # Start and reward do not matter where nothing is known in advance.
    assert (
        reduced(problem_of("Scalar", start=(0.5,))).fingerprint
        == reduced(problem_of("Scalar")).fingerprint
    )


def test_fingerprints_are_the_same_in_every_process():
    names = ("StochasticDubins", "DubinsObstacle")
    script = (
        "from safe_envs.registry import make_problem\n"
        "from safe_envs.values.reduction import reduced\n"
        f"for name in {names}:\n"
        "    print(reduced(make_problem(f'safe_envs/{name}-v0')).fingerprint)\n"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "12345"}
    told = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert told.stdout.split() == [reduced(problem_of(name)).fingerprint for name in names]
