"""The default sensor of every system: documented, and enough to see all states."""

from __future__ import annotations

import inspect
import re

import numpy as np
import sympy as sp

from safe_envs import SafeVectorEnv
from safe_envs.dynamics.codegen import compile_function
from safe_envs.problem.measurement import default_measurement
from safe_envs.registry import env_class
from tests.conftest import problem_of


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
