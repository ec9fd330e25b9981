"""The cases of the benchmarks: calls of filters and estimators, and two hand-written loops."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import sympy as sp

from benchmarks.hand_written_loop import LIMIT, step_by_hand
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Program
from safe_envs.envs.sensor import Sample
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.filters.estimation import BeliefTracker, ExtendedKalmanFilter, InitialBelief
from safe_envs.problem.measurement import Channel, Measurement
from safe_envs.problem.problem import Barrier
from safe_envs.registry import make_problem
from safe_envs.scripts.reports.installation import ENV_ID, NUM_ENVS, Case
from safe_envs.wrappers import CBF, HOCBF, SafetyFilter

_BATCHES = (1, 32, 1024, 10_000)


def filter_calls() -> dict[str, Case]:
    """Return calls of a filter with one constraint, over batches of several sizes."""
    safety_filter = SafetyFilter.for_problem(make_problem(ENV_ID), "scbf")
    rng = np.random.default_rng(0)
    cases = {}
    for batch in _BATCHES:
        leading = () if batch == 1 else (batch,)
        x, u = rng.uniform(-2.0, 2.0, (*leading, 3)), rng.uniform(-10.0, 10.0, (*leading, 1))
        cases[f"filter call, {batch} state{'s' * (batch > 1)}"] = Case(
            lambda x=x, u=u: safety_filter.filter(x, u), batch
        )
    return cases


def obstacle_course(constraints: int, states: int) -> tuple[SafetyFilter, np.ndarray, np.ndarray]:
    """Return the filter of a point mass in the plane, with states and proposed inputs.

    Args:
        constraints: how many, from 1 to 3: an obstacle, a wall, a limit of its speed.
        states: how many, all outside the obstacle.

    Returns:
        The filter, the states (B, 4), and the inputs (B, 2).
    """
    x, y, v, w, a, b = sp.symbols("x y v w a b", real=True)
    point = ControlAffineSDE(
        (x, y, v, w), (a, b), [v, w, 0, 0], [[0, 0], [0, 0], [1, 0], [0, 1]], [0, 0, 0, 0]
    )
    barriers = [
        (Barrier(x**2 + y**2 - 1), HOCBF((2, 2))),
        (Barrier(3 - x), HOCBF((1, 1))),
        (Barrier(1 - v**2 - w**2), CBF(1.0)),
    ]
    safety_filter = SafetyFilter(point, barriers[:constraints], input_bounds=(-2.0, 2.0))
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, states), rng.uniform(1.1, 2.0, states)
    drawn = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), *rng.uniform(-0.6, 0.6, (2, states))],
        axis=1,
    )
    return safety_filter, drawn, rng.uniform(-3.0, 3.0, (states, 2))


def flights_within_limits(
    deviation: float, states: int
) -> tuple[SafetyFilter, np.ndarray, np.ndarray]:
    """Return the filter of QuadrotorLimits, with states around its starts and proposed inputs.

    Args:
        deviation: standard deviation of each state from a start.
        states: how many.

    Returns:
        The filter, the states (B, 12), and inputs (B, 4) anywhere within the bounds.
    """
    problem, rng = make_problem("safe_envs/QuadrotorLimits-v0"), np.random.default_rng(0)
    low, high = np.transpose(problem.input_bounds)
    envs = SafeVectorEnv(problem, states)
    envs.reset(seed=0)
    drawn = envs.state + rng.normal(0.0, deviation, envs.state.shape)
    inputs = rng.uniform(low, high, (states, len(low)))
    return SafetyFilter.for_problem(problem, "hocbf"), drawn, inputs


def several_constraints() -> dict[str, Case]:
    """Return filter calls with three constraints: of a point mass in the plane, and a quadrotor."""
    in_plane, states, inputs = obstacle_course(3, NUM_ENVS)
    acting = np.flatnonzero(in_plane.filter(states, inputs).active.any(axis=1))[0]
    limits, flying, rotors = flights_within_limits(0.7, NUM_ENVS)
    return {
        "three constraints, two inputs, 1 state": Case(
            lambda: in_plane.filter(states[acting], inputs[acting])
        ),
        f"three constraints, two inputs, {NUM_ENVS} states": Case(
            lambda: in_plane.filter(states, inputs), NUM_ENVS
        ),
        f"three constraints, four inputs, {NUM_ENVS} states": Case(
            lambda: limits.filter(flying, rotors), NUM_ENVS
        ),
    }


def estimator_steps() -> dict[str, Case]:
    """Return steps of an extended Kalman filter: a prediction and the update with a sample."""
    return {
        f"extended Kalman filter, four states, {title}": estimator_step(batch)
        for batch, title in ((None, "1 robot"), (NUM_ENVS, f"{NUM_ENVS} robots"))
    }


def estimator_step(batch: int | None) -> Case:
    """Return a step of a filter of robots with an own speed, whose places are measured.

    Args:
        batch: how many robots; None for one, in plain floats.
    """
    x, y, theta, v, turn, push = sp.symbols("x y theta v omega a", real=True)
    robot = ControlAffineSDE(
        (x, y, theta, v),
        (turn, push),
        [v * sp.cos(theta), v * sp.sin(theta), 0, 0],
        [[0, 0], [0, 0], [1, 0], [0, 1]],
        [[0.05], [0.05], [0.05], [0.1]],
    )
    sensor = Measurement((Channel("x", x, 0.1), Channel("y", y, 0.1)))
    initial = InitialBelief.of([0.0, 0.0, 0.5, 1.0], 0.1 * np.eye(4))
    tracker = BeliefTracker(ExtendedKalmanFilter(robot, sensor, 0.02, initial=initial), batch)
    if batch is None:
        u, sample = (0.1, 0.0), Sample((0.01, -0.02), (True, True))
    else:
        drawn = np.random.default_rng(0).normal(0.0, 0.1, (4, batch))
        u, sample = (drawn[0], drawn[1]), Sample([*drawn[2:]], [np.full(batch, True)] * 2)
    return Case(
        lambda: tracker.advance(u, sample),
        batch or 1,
        prepare=lambda: tracker.begin(sample),
    )


def hand_written_loop() -> Case:
    """Return a step of the Dubins SCBF by a kernel that is written by hand."""
    program = Program("the hand-written loop", [step_by_hand], Source(""))
    step, n = program.compiled()["step_by_hand"], NUM_ENVS
    actions, keys = np.full((n, 1), 0.3, dtype=np.float32), np.arange(n, dtype=np.uint64)
    episodes, steps = np.zeros((2, n), dtype=np.int64)
    states, spare, counters = np.zeros((n, 3)), np.zeros((n, 2)), np.zeros((n, 4))
    observations, rewards = np.empty((n, 4), dtype=np.float32), np.empty(n)
    ended = np.ones(n, dtype=bool)
    return Case(
        lambda: step(
            actions,
            keys,
            episodes,
            steps,
            states,
            spare,
            counters,
            observations,
            rewards,
            ended,
        ),
        n,
        calls=10 * (LIMIT + 1),
    )


def fused_loop() -> Case:
    """Return a step of the Dubins SCBF by a NumPy loop, without reward, info, reset and checks."""
    problem = gym.make(ENV_ID).unwrapped.problem  # pyright: ignore[reportAttributeAccessIssue]
    values = {parameter.name: value for parameter, value in problem.plant.parameters.items()}
    v, dt, (low, high) = values["v"], problem.dt, problem.input_bounds[0]
    root = values["sigma_1"] * dt**0.5
    rng = np.random.default_rng(0)
    x, y, theta = rng.uniform(-1.0, 1.0, (3, NUM_ENVS))
    nominal = np.full(NUM_ENVS, 3.0)

    def step() -> None:
        nonlocal x, y, theta
        cos, sin = np.cos(theta), np.sin(theta)
        # A A h = a u + b, with a = 2 v (x sin - y cos) and b = -2 v^2: thesis Eq. (4.25).
        a, b = 2 * v * (x * sin - y * cos), -2 * v * v
        u = np.clip(np.where(a * nominal + b >= 0, nominal, -b / a), low, high)
        w = rng.standard_normal((2, NUM_ENVS))
        x = x + v * cos * dt + root * w[0]
        y = y + v * sin * dt + root * w[1]
        theta = theta + u * dt

    return Case(step, NUM_ENVS)
