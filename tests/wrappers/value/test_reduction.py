"""A reduced problem moves, and judges, as the simulation does."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.integrators import Integrator
from safe_envs.envs.simulation import Simulation
from safe_envs.registry import make_problem
from safe_envs.wrappers.value.reduction import reduced

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
x, y, p, u, w, a, b, s = sp.symbols("x y p u w a b s", real=True)
NUMBERS = {"box": (-1.0, 1.0), "dt": 0.1, "horizon": 1.0}


def problem_of(name: str, **options):
    return make_problem(f"safe_envs/{name}-v0", **options)


def sampled(problem, count: int = 50):
    """Return states, in the workspace, and inputs."""
    random = np.random.default_rng(1)
    low, high = np.array(
        [(v.low, v.high) if math.isfinite(v.low) else (-9.0, 9.0) for v in problem.states]
    ).T
    states = low[:, None] + (high - low)[:, None] * random.random((len(low), count))
    box = np.array(problem.box)
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


@pytest.mark.parametrize("knowledge", ["plant", "model"])
@pytest.mark.parametrize(
    ("name", "options"),
    [
        *((name, {}) for name in COORDINATES),
        ("StochasticDubins", {"substeps": 3}),
        ("DubinsDisk", {"substeps": 2}),
        ("DubinsDisk", {"noise": 0.1}),
        ("DubinsObstacle", {"substeps": 2, "noise": 0.1}),
        ("DubinsObstacles", {"num_obstacles": 1}),
        ("DubinsObstacles", {"start": (-5.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0)}),
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
    x, inputs = sampled(problem)
    x, inputs = tuple(put_known(found, x, instant)), tuple(inputs)
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
    after = Simulation(problem, "arrays").integrator.step(x, inputs, draws)
    require_same(found, q, found.of_states(after))


def turned(w, x):
    """Return noise as it is seen from a state that is turned onto the first axis: as likely."""
    angle = np.arctan2(x[1], x[0])
    cos, sin = np.cos(angle), np.sin(angle)
    return cos * w[0] + sin * w[1], cos * w[1] - sin * w[0]
