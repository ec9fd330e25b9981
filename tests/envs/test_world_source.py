"""The world as functions of compiled programs: the numbers of `Simulation`."""

from __future__ import annotations

import math

import numpy as np
import pytest
import sympy as sp

from safe_envs.engine.program import Program
from safe_envs.engine.slots import Data
from safe_envs.envs.simulation import Simulation
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.envs.world_source import noise_channels, world_source
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.starts import Start
from tests.conftest import problem_of
from tests.envs import world_kernels

ENTRIES = (world_kernels.moved, world_kernels.looked_at, world_kernels.started)


def world_of(problem: SafetyProblem) -> tuple[Program, np.ndarray]:
    data = Data()
    return Program(problem.name, ENTRIES, world_source(problem, data)), data.array()


def check(problem: SafetyProblem, functions: dict, data: np.ndarray, points: int = 6) -> None:
    simulation, n = Simulation(problem, "floats"), problem.plant.n
    center, half = center_and_half_width(problem)
    rng, channels = np.random.default_rng(0), noise_channels(problem)
    assert channels == simulation.integrator.channels
    start = problem.starts[problem.start].proposals(points).tolist()
    for x in ([a + 0.3 * rng.standard_normal() for a in row] for row in start):
        u = tuple(c + w * rng.uniform(-1.0, 1.0) for c, w in zip(center, half, strict=True))
        noise, out = rng.standard_normal(1 + channels), np.empty(n)
        functions["moved"](tuple(x), u, noise, out, data)
        expected = simulation.integrator.step(tuple(x), u, noise[1:].tolist())
        np.testing.assert_allclose(out, expected, rtol=1e-14, atol=1e-300)
        features, barriers, reward, outside, goal = simulation.measure(tuple(x), center, 0.3)
        out = np.empty(len(features) + len(barriers) + 3)
        assert functions["looked_at"](tuple(x), 0.3, out, data)
        seen = np.array(features, dtype=np.float32)
        ended = outside > 0.0 or goal >= 0.0
        np.testing.assert_array_equal(out[: len(seen)], seen)
        expected = (*barriers, min(barriers), reward, float(ended))
        np.testing.assert_allclose(out[len(seen) :], expected, rtol=1e-14)


def test_the_world_of_every_id(env_id: str) -> None:
    problem = problem_of(env_id)
    program, data = world_of(problem)
    check(problem, program.plain(), data)


def test_substeps_and_missing_noise() -> None:
    for options in ({"substeps": 3}, {"noise": 0.0, "substeps": 2}):
        problem = problem_of("safe_envs/StochasticDubins-v0", **options)
        program, data = world_of(problem)
        check(problem, program.plain(), data, points=2)


@pytest.mark.oracle
def test_compiled_worlds(env_id: str) -> None:
    problem = problem_of(env_id)
    program, data = world_of(problem)
    check(problem, program.compiled(), data, points=50)


def test_starts_meet_their_condition_and_depend_on_key_and_episode() -> None:
    problem = problem_of("safe_envs/StochasticDubins-v0")
    program, data = world_of(problem)
    start, uniforms = program.plain()["started"], np.empty(3)
    found = np.empty((4, 3))
    for row, (key, episode) in zip(found, ((1, 0), (1, 1), (2, 0), (1, 0)), strict=True):
        start(key, episode, uniforms, row, data)
    np.testing.assert_array_equal(found[0], found[3])
    assert len({tuple(row) for row in found}) == 3
    condition = problem.starts[problem.start].condition
    assert condition is not None
    for row in found:
        values = dict(zip(problem.model.states, row, strict=True))
        assert problem.model.numeric(condition).subs(values) > 0


def test_a_start_that_is_never_allowed_is_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of("safe_envs/Scalar-v0")
    monkeypatch.setitem(vars(problem), "starts", {"never": Start.at([0.0])})
    monkeypatch.setitem(vars(problem), "start", "never")
    object.__setattr__(problem.starts["never"], "condition", sp.Integer(-1))
    program, data = world_of(problem)
    out = np.empty(problem.plant.n)
    program.plain()["started"](1, 0, np.empty(0), out, data)
    assert np.isnan(out).all()


def test_what_is_not_finite_is_found() -> None:
    problem = problem_of("safe_envs/StochasticDubins-v0")
    program, data = world_of(problem)
    look, out = program.plain()["looked_at"], np.empty(8)
    assert look((0.1, 0.2, 0.3), 0.0, out, data)
    assert not look((math.nan, 0.2, 0.3), 0.0, out, data)
    assert not look((1e39, 0.2, 0.3), 0.0, out, data)
