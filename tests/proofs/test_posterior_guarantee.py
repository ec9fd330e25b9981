"""Bounds over posteriors: by hand, against a dense grid, and against what happens."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from scipy import stats

from safe_envs import Barrier, ConfigurationError, ControlAffineSDE, define_problem
from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.dynamics.codegen import compile_function
from safe_envs.filters.learning.bayesian import identify
from safe_envs.proofs.posterior import posterior_guarantee
from safe_envs.wrappers import SCBF, BayesianSCBF, SafetyFilter, SafetyFilterVectorWrapper
from tests.conftest import problem_of
from tests.proofs.verified import hurry

pytestmark = pytest.mark.slow

START = (0.0, 0.6)


@pytest.fixture(scope="module")
def cubic():
    return problem_of("safe_envs/CubicSDEDisk-v0")


@pytest.fixture(scope="module")
def posterior(cubic):
    return identify(cubic)


@pytest.fixture(scope="module")
def found(cubic, posterior):
    with pytest.MonkeyPatch.context() as patch:
        hurry(patch)
        return posterior_guarantee(cubic, [BayesianSCBF(posterior, simultaneous=0.95)])


def best_rows(problem, posterior, simultaneous, x):
    """The most over the inputs of the box of the least that A h may be, at states of a disk,
    without the filter or its rows."""
    share = 0.5 * (1.0 - simultaneous)
    levels = posterior.diffusion.sigma_intervals(share)[:, 1]
    widest = levels**2 * posterior.diffusion.count / posterior.diffusion.squares
    factors = stats.chi2.ppf(1.0 - share, 2 * posterior.mean.shape[1]) * widest
    phi, slopes = posterior.features.matrix(x), -2.0 * x

    def row(u):
        design = np.hstack((phi, posterior.input_scale[0] * u[:, None] * phi))
        mean = (slopes * (design @ posterior.mean.T)).sum(axis=1) - (levels**2).sum()
        variance = sum(
            factors[i]
            * slopes[:, i] ** 2
            * ((design @ posterior.covariance[i]) * design).sum(axis=1)
            for i in range(2)
        )
        return mean - np.sqrt(variance)

    # The row is concave in the input, so that the best one is a step from the best that was tried.
    low, high = (np.full(len(x), end) for end in problem.input_bounds[0])
    for _ in range(3):
        tried = low + (high - low) * np.linspace(0.0, 1.0, 21)[:, None]
        best = np.array([row(u) for u in tried])
        at, step = tried[best.argmax(axis=0), np.arange(len(x))], (high - low) / 20.0
        low, high = np.maximum(at - step, low), np.minimum(at + step, high)
    return best.max(axis=0)


def test_the_shortfall_is_the_worst_of_a_dense_grid(cubic, posterior, found):
    # Where the input does little, and everywhere.
    axis = np.linspace(-1, 1, 81)
    grid = np.concatenate(
        [
            np.stack(np.meshgrid(axis, along), -1).reshape(-1, 2)
            for along in (np.linspace(-0.1, 0.1, 21), axis[::2])
        ]
    )
    grid = grid[(grid**2).sum(axis=1) <= 1.0]
    worst = -best_rows(cubic, posterior, 0.95, grid).min()
    assert worst > 0.05
    # The inputs of the last grid are less than .01 from the best one: its slope is that of the row,
    # a few units.
    assert worst - 1e-4 <= found.shortfall <= 1.05 * worst


def test_the_probability_by_hand(found):
    assert found.word == "proved"
    assert found.delta == pytest.approx(0.05, abs=1e-15)
    # A proved upper bound of sup h = 1, and so not below it.
    assert 1.0 <= found.supremum <= 1.001
    starts = np.array([[0.0, 0.0], [-0.1, 0.7], [0.6, -0.5], [0.0, 1.0], [0.9, 0.9], [1.5, 0.0]])
    for horizon in (0.0, 0.5, 1.0, 5.0, 50.0):
        h = 1.0 - (starts**2).sum(axis=1)
        expected = 0.95 * np.clip((h - found.shortfall * horizon) / found.supremum, 0.0, 1.0)
        expected[3:] = 0.0
        np.testing.assert_allclose(found.at(starts, horizon), expected, atol=1e-12)
    assert found.at(starts, 1.0)[0] > 0.5
    assert (found.at(starts, 50.0) == 0.0).all()
    assert ((found.at(starts, 0.0) >= 0.0) & (found.at(starts, 0.0) <= 0.95)).all()


def test_what_has_no_bound_is_refused(cubic, posterior):
    robust = BayesianSCBF(posterior, simultaneous=0.9)
    twice = replace(
        cubic, barriers=(cubic.barriers[0], Barrier(2 * cubic.barriers[0].expression, "twice"))
    )
    for problem, conditions in (
        (twice, [robust, robust]),
        (cubic, [BayesianSCBF(posterior)]),
        (cubic, [BayesianSCBF(posterior, confidence=0.9)]),
        (cubic, [SCBF()]),
        (cubic, []),
    ):
        with pytest.raises(ConfigurationError, match="bayesian-scbf:simultaneous=P"):
            posterior_guarantee(problem, conditions)


@pytest.mark.parametrize("identifications", [1, pytest.param(12, marks=pytest.mark.oracle)])
def test_the_bound_is_below_what_happens(cubic, monkeypatch, identifications):
    """From one start, with identifications that know little; a shorter search finds less of the
    shortfall, and promises more."""
    hurry(monkeypatch)
    envs, horizon, promised = 100, 0.5, []
    for seed in range(identifications):
        condition = BayesianSCBF(
            identify(cubic, starts=800, repetitions=50, degree=3, seed=seed), simultaneous=0.9
        )
        (bound,) = posterior_guarantee(cubic, [condition]).at(np.array([START]), horizon)
        env = SafetyFilterVectorWrapper(
            gym.make_vec("safe_envs/CubicSDEDisk-v0", num_envs=envs, start=START, horizon=horizon),
            condition,
        )
        env.reset(seed=seed)
        safe = np.ones(envs, dtype=bool)
        for _ in range(round(horizon / cubic.dt)):
            _, _, _, _, info = env.step(np.zeros((envs, 1), dtype=np.float32))
            safe &= info["cost"] == 0.0
        promised.append(bound)
        assert rate_interval(np.count_nonzero(safe), envs, 0.99)[1] >= bound
    assert min(promised) > 0.2
    assert max(promised) < 0.9


def unstable(rate=3, noise=0.05, **options):
    """dx = (rate x + u) dt + noise dW, inside of |x| < 1."""
    x, u = sp.symbols("x u", real=True)
    system = ControlAffineSDE.from_rate((x,), (u,), [rate * x + u], diffusion=[noise])
    return define_problem(
        system,
        [1 - x**2],
        input_bounds=(-10, 10),
        workspace={x: (-2, 2)},
        start=(0.5,),
        horizon=1.0,
        nominal=0,
        **options,
    )


def test_an_unbounded_set_has_none():
    problem = problem_of("safe_envs/CubicSDE-v0")
    # Its noise varies with the state: no intervals of sigma are known.
    varying = identify(problem, starts=100, repetitions=20, degree=3, diffusion_degree=2)
    with pytest.raises(ConfigurationError, match="constant noise"):
        posterior_guarantee(problem, [BayesianSCBF(varying, simultaneous=0.9)])
    problem = unstable(dt=0.01)
    (x,) = problem.plant.states
    condition = BayesianSCBF(
        identify(problem, starts=50, repetitions=20, degree=1), simultaneous=0.9
    )
    half_line = replace(problem, barriers=(Barrier(1 - x, "h"),))
    endless = replace(
        half_line, states=tuple(replace(s, low=-np.inf, high=np.inf) for s in problem.states)
    )
    with pytest.raises(ConfigurationError, match="beyond"):
        posterior_guarantee(endless, [condition])
    # To leave a workspace ends an episode, so that h counts inside of it only: at most 3 at -2.
    supremum = posterior_guarantee(half_line, [condition]).supremum
    assert supremum == pytest.approx(3.0, rel=1e-9)


def test_the_bound_is_of_the_posterior_and_grows_with_what_it_knows():
    problem = unstable(dt=0.01)
    many = identify(problem, starts=200, repetitions=50, degree=1)
    few = identify(problem, starts=20, repetitions=5, degree=1)

    def bound(posterior, simultaneous, of=problem):
        return posterior_guarantee(of, [BayesianSCBF(posterior, simultaneous=simultaneous)])

    found = bound(many, 0.95)
    other = bound(many, 0.95, unstable(rate=9, noise=3.0, dt=0.01))
    assert (other.shortfall, other.supremum) == (found.shortfall, found.supremum)
    start = np.array([[0.5]])
    surer = bound(few, 0.95)
    assert surer.shortfall > 1.2 * found.shortfall
    assert 0.0 < surer.at(start, 0.1) < found.at(start, 0.1)
    looser = bound(many, 0.5)
    assert looser.shortfall < found.shortfall
    assert looser.delta == pytest.approx(0.5)


@pytest.mark.parametrize("identifications", [1, pytest.param(8, marks=pytest.mark.oracle)])
def test_long_steps_bias_what_is_identified_and_are_allowed_for(identifications):
    """Data of .05 s that are integrated finely: the posterior is surer of the wrong rates than its
    probability says."""
    problem, (x, u) = (
        unstable(dt=0.05, substeps=10),
        np.meshgrid(np.linspace(-1.0, 1.0, 21), [-10.0, 0.0, 10.0]),
    )
    truth = -2 * x * (3 * x + u) - 0.05**2
    covered = allowed = 0
    for seed in range(identifications):
        posterior = identify(problem, starts=200, repetitions=50, degree=1, seed=seed)
        condition = BayesianSCBF(posterior, simultaneous=0.9)
        row = SafetyFilter.for_problem(problem, condition).constraints[0]
        parts = [
            np.broadcast_to(e, x.shape)
            for e in compile_function(
                problem.plant.states, [*row.coefficient, row.offset], "arrays"
            )(x)
        ]
        q0, q1, q2 = compile_function(problem.plant.states, row.uncertainty, "arrays")(x)
        robust = parts[0] * u + parts[1] - np.sqrt(q0 + 2 * q1 * u + q2 * u**2)
        found = posterior_guarantee(problem, [condition])
        covered += bool((robust <= truth).all())
        allowed += bool((robust - found.bias <= truth).all())
        assert "steps of 0.05 s in the data may shift the rate of h" in found.remark
    assert covered == 0
    assert allowed == identifications
    # dt/2 times h' L F + 1/2 h'' 2 J S, with F = 3 x + u, J = 3, L F = 3 F and h = 1 - x^2: largest
    # at x = 1 and u = 10.
    expected = 0.025 * (2 * 3 * 13 + 2 * 3 * 0.05**2)
    assert found.bias == pytest.approx(expected, rel=0.2)
    assert found.at(np.array([[0.1]]), 0.2)[0] < 0.9 * (1 - 0.1**2 - found.bias * 0.2) + 1e-9


def test_steps_of_the_plants_own_method_have_no_bias(posterior, found):
    assert posterior.record.settings["substeps"] == 1
    assert found.bias == 0.0
