"""The shipped systems: their summaries and sensors, and the task of DubinsReach."""

from __future__ import annotations

import inspect
import re

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, SafeEnvsError, SafeVectorEnv
from safe_envs.agents import NominalController
from safe_envs.dynamics.codegen import compile_function
from safe_envs.problem.measurement import default_measurement
from safe_envs.registry import env_class, make_problem
from safe_envs.systems.summary import summaries, summary_of
from tests.conftest import problem_of

DUBINS = "safe_envs/StochasticDubins-v0"


def test_it_is_what_the_problem_says(env_id):
    advice = "run `python -m safe_envs.systems.summary`, which writes summaries.json"
    assert summaries()[env_id] == summary_of(env_id), advice
    problem = problem_of(env_id)
    assert summary_of(env_id).parameters == tuple(p.name for p in problem.model.parameters)
    assert len(summary_of(env_id).degree) == len(problem.barriers)
    assert summaries()[env_id].sensors == {c.name: c.noise for c in problem.sensors}


REFUSED = (
    {"plant": {"vv": 1.0}},
    {"model": {"v": float("inf")}},
    {"barrier": {"raduis": 2.0}},
    *({"noise": noise} for noise in (-1.0, [1.0, 2.0, 3.0], float("nan"))),
    *({"input_bounds": box} for box in ([2.0, 1.0], [[0.0, 1.0], [0.0, 1.0]])),
    *({"start": start} for start in ("inwrd", [1.0, 2.0])),
    {"dt": 0.0},
    {"nois": 1.0},
)
TAKEN = (
    {},
    {"plant": {"v": 1.5}, "model": {"sigma_1": 0.1}},
    *({"noise": noise} for noise in (0.0, [0.1, 0.2])),
    *({"input_bounds": box} for box in ([[-1.0, 1.0]], [-1.0, 1.0])),
    *({"start": start} for start in ("uniform", [0.0, 0.0, 0.0])),
    {"barrier": {"radius": 2.0}},
    {"rate_limit": [-1.0, 1.0], "start": [0.0, 0.0, 0.0]},
    {"dt": 0.1, "horizon": 1.0, "delay": 2},
)


@pytest.mark.parametrize("options", REFUSED, ids=str)
def test_what_it_refuses_the_problem_refuses_in_the_same_words(options):
    with pytest.raises(SafeEnvsError) as early:
        summaries()[DUBINS].require_options("StochasticDubins", options)
    with pytest.raises(ConfigurationError) as late:
        make_problem(DUBINS, **options)
    assert str(early.value) == str(late.value)


@pytest.mark.parametrize("options", TAKEN, ids=str)
def test_what_the_problem_takes_it_takes(options):
    make_problem(DUBINS, **options)
    summaries()[DUBINS].require_options("StochasticDubins", options)


# The default sensor of every system: documented, and enough to see all states.


def test_every_system_states_its_sensor(env_id):
    problem = problem_of(env_id)
    assert problem.sensors
    assert default_measurement(problem).channels == problem.sensors
    text = inspect.getdoc(env_class(env_id)) or ""
    section = text.split("## Sensor\n")[1].split("\n## ")[0]
    assert 'measurement="default"' in section
    # Each standard deviation stands in the text, as .05 or 2.
    stated = set(re.findall(r"(?<![\d.])(?:\d+\.\d+|\.\d+|\d+)(?![\d])", section))
    for channel in problem.sensors:
        assert f"{channel.noise:g}".removeprefix("0") in stated, channel.name


def test_all_states_are_observable(env_id):
    """The derivatives of what is measured, along the drift under some input, have full rank."""
    problem, plant = problem_of(env_id), problem_of(env_id).plant
    field = plant.numeric(plant.drift + plant.input_matrix * sp.Matrix(plant.inputs))
    rng = np.random.default_rng(0)
    u = [float(rng.uniform(low, high)) for low, high in problem.input_bounds]
    field = field.subs(dict(zip(plant.inputs, u, strict=True)))
    rows = sp.Matrix([plant.numeric(c.expression) for c in problem.sensors])
    found, x = np.empty((0, plant.n)), problem.starts[problem.start].proposals(1)[0]
    x = x + rng.uniform(0.01, 0.02, plant.n)
    for _ in range(3):
        slopes = rows.jacobian(plant.states)
        values = compile_function(plant.states, list(slopes), "floats")(*x.tolist())
        found = np.concatenate([found, np.reshape(values, slopes.shape)])
        rows = slopes * field
    assert np.linalg.matrix_rank(found, tol=1e-9 * np.abs(found).max()) == plant.n


def test_samples_of_starts_lie_within_the_space(env_id):
    env = SafeVectorEnv(problem_of(env_id, measurement="default"), 200)
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    box = env.single_observation_space
    assert ((observation > box.low) & (observation < box.high)).all()
    assert info["received"].all()
    assert np.isfinite(np.array(env.measured.values)).all()


# The vehicle that is to reach a goal before a moving obstacle hits it.


ENV_ID = "safe_envs/DubinsReach-v0"
MANY = 4000


def test_obstacle_is_known_in_advance_and_the_noises_are_equal() -> None:
    env = SafeVectorEnv(problem_of(ENV_ID, start="fixed"), MANY, "Disabled")
    env.reset(seed=1)
    env.step(np.zeros((MANY, 1)))
    found = env.state
    np.testing.assert_allclose(found[:, 2:], np.tile([0.4, 0.0, -1.06], (MANY, 1)), atol=1e-15)
    moved = found[:, :2] - [-1.5 + 0.2 * np.cos(0.4), -1.0 + 0.2 * np.sin(0.4)]
    scale = 0.2 * np.sqrt(0.2)
    np.testing.assert_allclose(moved.mean(axis=0) / scale, 0.0, atol=4 / np.sqrt(MANY))
    np.testing.assert_allclose(np.cov(moved.T) / scale**2, np.eye(2), atol=6 / np.sqrt(MANY))


def test_nominal_controller_arrives_and_is_hit_on_its_way() -> None:
    env = SafeVectorEnv(problem_of(ENV_ID), 200, "Disabled")
    policy = NominalController(env.problem)
    observation, _ = env.reset(seed=0)
    arrived, hit, ended = (np.zeros(200, dtype=bool) for _ in range(3))
    for _ in range(env.problem.steps):
        observation, _, terminated, _, info = env.step(policy.predict(observation)[0])
        hit |= info["violation"] & ~ended
        at = np.hypot(env.state[:, 0] - 1.4, env.state[:, 1] - 1.0)
        arrived |= (at <= 0.3) & ~ended
        ended |= terminated
        env.episodes.ended[:] = False
        if ended.all():
            break
    assert arrived.mean() > 0.97
    assert hit.mean() > 0.7


def test_passing_behind_the_obstacle_is_possible_in_time() -> None:
    problem = problem_of(ENV_ID, noise=0.0, start="fixed")
    env = SafeVectorEnv(problem, 1, "Disabled")
    env.reset(seed=0)
    terminated, lowest = np.array([False]), np.inf
    for _ in range(problem.steps):
        px, py, heading = env.state[0, :3]
        goal = np.array([0.3, -1.1]) if px < 0.1 else np.array([1.4, 1.0])
        course = np.arctan2(goal[1] - py, goal[0] - px) - heading
        rate = 5.0 * np.arctan2(np.sin(course), np.cos(course))
        _, _, terminated, _, info = env.step(np.clip([[rate / 3.0]], -1.0, 1.0))
        lowest = min(lowest, float(info["barrier"][0, 0]))
        if terminated[0]:
            break
    assert terminated[0]
    assert np.hypot(*(env.state[0, :2] - [1.4, 1.0])) <= 0.3
    assert lowest > 0.0
