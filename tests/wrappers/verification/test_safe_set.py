"""Regions, samples of a set, and the search."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import Barrier
from safe_envs.problem.starts import Start
from safe_envs.proofs.analysis import SafeSetAnalysis
from safe_envs.proofs.feasibility import verify
from safe_envs.proofs.safe_set import Formulas, largest, region_of, repeats, sample, towards_zero
from safe_envs.wrappers import parse_conditions
from tests.conftest import problem_of
from tests.wrappers.verification.verified import (
    CUBIC_DISK,
    STOCHASTIC,
    problem_with,
    system_in_a_box,
    x,
    y,
)


def test_a_tiny_safe_set_is_found():
    problem = replace(
        system_in_a_box(count=3, half_width=0.004), starts={"middle": Start.at((0.0, 0.0, 0.0))}
    )
    formulas = Formulas(problem, parse_conditions("scbf", problem), "model")
    region = region_of(problem, formulas.system, formulas.expressions)
    found = sample("C", formulas.barrier_level, region, 256, np.random.default_rng(0))
    assert len(found.points) >= 256
    # All of it, not the part where the search arrived.
    assert abs(found.points).max(axis=0) == pytest.approx([0.004] * 3, rel=0.1)


def test_an_empty_safe_set_is_an_error():
    problem = system_in_a_box()
    (x,) = problem.plant.states
    with pytest.raises(ConfigurationError, match="no point of C was found"):
        verify(replace(problem, barriers=(Barrier(-1 - x**2),)), parse_conditions("scbf", problem))


def test_ranges_of_unbounded_states():
    problem = problem_of(STOCHASTIC)
    theta = problem.plant.states[2]
    periodic = region_of(problem, problem.plant, [sp.cos(theta)])
    assert periodic.periodic.tolist() == [False, False, True]
    assert periodic.high[2] - periodic.low[2] == pytest.approx(2 * math.pi)
    assert "a period" in periodic.notes[0]
    grown = region_of(problem, problem.plant, [theta])
    assert not grown.periodic.any()
    assert grown.high[2] - grown.low[2] > 20.0
    assert "its workspace is unbounded" in grown.notes[0]
    wider = periodic.scaled(10.0)
    assert wider.high[0] == pytest.approx(60.0)
    assert wider.high[2] == periodic.high[2]


def test_search_follows_a_ridge_to_a_corner():
    problem = problem_of(CUBIC_DISK)
    formulas = Formulas(problem, parse_conditions("scbf", problem), "model")
    region = region_of(problem, formulas.system, formulas.expressions)
    rng = np.random.default_rng(0)

    def score(x):
        return np.where(x[:, 0] + x[:, 1] <= 1.0, x[:, 0] - 100 * abs(x[:, 1] - 0.25), -np.inf)

    value, state = largest(score, region.draw(8, rng), region, rng)
    np.testing.assert_allclose(state, [0.75, 0.25], atol=1e-6)
    assert value == pytest.approx(0.75, abs=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_search_reaches_a_whole_ridge(seed):
    problem = problem_of(STOCHASTIC)
    region = region_of(problem, problem.plant, [])
    rng = np.random.default_rng(seed)

    def score(x):
        return -abs(x[:, 0] * np.sin(x[:, 2]) - x[:, 1] * np.cos(x[:, 2]))

    assert largest(score, region.draw(12, rng), region, rng)[0] > -1e-9


@pytest.mark.parametrize(
    ("expression", "periodic"),
    [
        (sp.sin(y) + sp.cos(3 * y + x) * x, True),
        (x, True),
        (sp.tan(2.0 * y), True),
        (sp.sin(y / 2), False),
        (sp.Max(y - 15, 0), False),
        (sp.sin(y) + sp.Piecewise((0, y < 40), (1, True)), False),
        (sp.sin(x * y), False),
        (sp.sin(y**2), False),
        (sp.floor(sp.sin(y)) + sp.Heaviside(y - 100), False),
    ],
)
def test_only_waves_are_periodic(expression, periodic):
    assert repeats(expression, y) is periodic


def test_newtons_steps_end_where_the_function_is_zero():
    problem = problem_of(STOCHASTIC)
    region = region_of(problem, problem.plant, [])
    states = region.draw(6, np.random.default_rng(0))

    def off(z):
        return (z[:, 0] * np.sin(z[:, 2]) - z[:, 1] * np.cos(z[:, 2]))[:, None]

    moved = towards_zero(off, states, region)
    assert np.median(abs(off(moved))) < 1e-12
    assert abs(off(moved)).max() <= abs(off(states)).max()


@pytest.mark.parametrize("seed", range(3))
def test_a_narrow_peak_is_found_by_the_survey(seed):
    z = sp.Symbol("z", real=True)
    peak = 5 * sp.exp(-((x - 0.3) ** 2 + (y - 0.4) ** 2 + (z + 0.3) ** 2) / 0.05**2)
    problem = problem_with(
        [0 * x, 0 * x, 0 * x],
        [1 - x**2 + peak],
        noise=(0.1, 0.3, 0.3),
        states=(x, y, z),
        inputs=((1.0,), (0.0,), (0.0,)),
        ranges=((-2.0, 2.0),) * 3,
        box=(-1000.0, 1000.0),
    )
    survey = SafeSetAnalysis(
        Formulas(problem, parse_conditions("szcbf", problem), "model"), 8192, seed
    )
    assert survey.suprema[0] == pytest.approx(5.91, abs=0.01)
