"""How often the robust rows are below the truth, over repeated identifications of systems that are
known here."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import generator
from safe_envs.filters.learning.bayesian import identify
from safe_envs.filters.learning.models.distributions import Diffusion
from safe_envs.proofs.posterior import posterior_guarantee
from safe_envs.wrappers import BayesianSCBF
from tests.conftest import problem_of

pytestmark = pytest.mark.slow

TIMES = 40
# The share of so many that are right with the probability .95 is within three standard deviations
# of it.
LEAST = 0.95 - 3 * math.sqrt(0.05 * 0.95 / TIMES)
DISK = problem_of("safe_envs/CubicSDEDisk-v0")
BARRIER = DISK.barriers[0]


def changed(**parts):
    """The disk with other parts of its system, in truth and belief."""
    system = replace(DISK.plant, **parts)
    return replace(DISK, plant=system, model=system)


def true_row(system, x, u):
    """A h under an input."""
    closed = replace(system, drift=system.drift + system.input_matrix * u)
    return compile_function(
        system.states, [system.numeric(generator(closed, BARRIER.expression))], "floats"
    )(*x)[0]


def robust_row(posterior, condition, x, u):
    """The row of a condition under an input, from the numbers of the posterior; the symbolic one
    takes far longer to derive."""
    phi, slopes = posterior.features.matrix(np.array([x])), -2.0 * np.array(x)
    mean = slopes @ (posterior.mean @ np.hstack((phi, posterior.input_scale * u * phi)).ravel())
    (v,) = posterior.drift_variance(np.array([x]))
    variance = (condition.variance_factors(slopes != 0) * slopes**2) @ (v @ [1.0, u] @ [1.0, u])
    return (
        mean
        - float((posterior.diffusion.matrix() * posterior.diffusion.matrix().T).trace())
        - math.sqrt(variance)
    )


def share_below(problem, x, u, **design):
    truth, below = true_row(problem.plant, x, u), 0
    for seed in range(TIMES):
        posterior = identify(problem, seed=seed, degree=3, **design)
        below += robust_row(posterior, BayesianSCBF(posterior, confidence=0.95), x, u) <= truth
    return below / TIMES


def test_the_numbers_are_those_of_the_symbols():
    posterior = identify(DISK, starts=100, repetitions=30, degree=3)
    for condition in (
        BayesianSCBF(posterior, confidence=0.95),
        BayesianSCBF(posterior, confidence=0.3),
    ):
        found = condition.constraint(DISK.model, BARRIER)
        row = compile_function(
            DISK.plant.states, [*found.coefficient, found.offset, *found.uncertainty], "floats"
        )
        for x, u in (((0.8, 0.2), 10.0), ((-0.1, 0.7), -3.0)):
            a, b, q0, q1, q2 = row(*x)
            assert a * u + b - math.sqrt(q0 + 2 * q1 * u + q2 * u * u) == pytest.approx(
                robust_row(posterior, condition, x, u), abs=1e-7
            )


@pytest.mark.parametrize("gain", [0.0, pytest.param(0.04, marks=pytest.mark.oracle)])
def test_an_effect_that_the_data_do_not_show_is_kept_in_mind(gain):
    # The most probable system takes it for 0, which a large input makes much of.
    problem = changed(input_matrix=sp.Matrix([gain, 1]))
    assert share_below(problem, (0.8, 0.2), 10.0, starts=100, repetitions=30) >= LEAST


def test_correlated_noise_makes_the_row_less_sure():
    root = np.linalg.cholesky(0.04 * np.array([[1.0, 0.95], [0.95, 1.0]]))
    problem = changed(diffusion=sp.Matrix(root))
    assert share_below(problem, (0.6, 0.6), 0.0, starts=100, repetitions=30) >= LEAST


def test_what_the_features_miss_is_no_noise_and_has_no_bound():
    x_1 = DISK.plant.states[0]
    problem = changed(drift=DISK.plant.drift + sp.Matrix([sp.sin(4 * x_1), 0]))
    with pytest.warns(UserWarning, match="miss"):
        posterior = identify(problem, degree=2)
    sure, plain = (BayesianSCBF(posterior, confidence=c) for c in (0.95, 0.5))
    states = np.random.default_rng(0).uniform(-0.7, 0.7, (60, 2)).tolist()
    above = {
        c: np.mean(
            [robust_row(posterior, c, x, 0.0) > true_row(problem.plant, x, 0.0) for x in states]
        )
        for c in (sure, plain)
    }
    assert above[sure] <= 0.1 < above[plain]
    with pytest.raises(ConfigurationError, match=r"miss .* % of the rate of x_1"):
        posterior_guarantee(problem, [BayesianSCBF(posterior, simultaneous=0.9)])


def test_noise_that_is_taken_for_constant_and_is_not_has_no_bound():
    pendulum = problem_of("safe_envs/Pendulum-v0")
    with pytest.warns(UserWarning, match="diffusion degree"):
        posterior = identify(pendulum)
    with pytest.raises(ConfigurationError, match="noise of theta varies"):
        posterior_guarantee(pendulum, [BayesianSCBF(posterior, simultaneous=0.9)])


@pytest.mark.parametrize(("sigma", "count"), [(1e-3, 40), (0.01, 200), (0.2, 50), (30.0, 1000)])
def test_intervals_of_sigma_hold_it_whatever_its_unit(sigma, count):
    rng, times = np.random.default_rng(0), 2000
    hits = 0
    for squares in sigma**2 * rng.chisquare(count, (times, 2)):
        low, high = Diffusion(squares, count, np.eye(2)).sigma_intervals(0.1).T
        hits += bool(((low <= sigma) & (sigma <= high)).all())
    assert hits / times == pytest.approx(0.9, abs=4 * math.sqrt(0.09 / times))


@pytest.mark.filterwarnings("ignore::safe_envs.filters.learning.bayesian.IdentifiabilityWarning")
def test_few_data_make_both_regions_wider():
    sizes = {}
    for repetitions in (4, 50):
        posterior = identify(DISK, starts=30, repetitions=repetitions, degree=1, prior=100.0)
        noise, outputs = posterior.diffusion, np.array([True, True])
        sizes[repetitions] = [
            BayesianSCBF(posterior, **{kind: 0.9}).variance_factors(outputs)[0]
            for kind in ("confidence", "simultaneous")
        ]
        assert noise.count == len(DISK.sampling_domain.inputs) * 30 * (repetitions - 1)
    assert (np.array(sizes[4]) > np.array(sizes[50])).all()
