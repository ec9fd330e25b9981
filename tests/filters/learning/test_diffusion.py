"""The covariance of the noise, and what a system makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import ito_correction
from safe_envs.filters.learning.collection import collect
from safe_envs.filters.learning.drift_checks import drift_warnings, mean_rates, rates, slack
from safe_envs.filters.learning.generator import covariances, learn_diffusion
from safe_envs.filters.learning.models.generator import LearnedDiffusion
from safe_envs.systems.cubic import x_1, x_2
from tests.conftest import problem_of

CORRELATED = [[0.3, 0.0], [0.2, 0.15]]
VARYING = [[0.3 + 0.1 * x_1, 0], [0.2, 0.1 * x_2]]


def made_up(diffusion):
    """The disk with another plant: its model still believes the noise of the thesis."""
    problem = problem_of("safe_envs/CubicSDEDisk-v0")
    return replace(problem, plant=replace(problem.plant, diffusion=diffusion))


def learned(problem, points=300, repetitions=1000, inputs=None, seed=0):
    data = collect(
        problem, points, repetitions, inputs or [tuple(np.zeros(len(problem.inputs)))], seed=seed
    )
    return learn_diffusion(problem, data, rates(problem.model, data))


def entry_at(problem, expression, x):
    return np.broadcast_to(
        compile_function(problem.plant.states, [expression], "arrays")(*x.T)[0], len(x)
    )


def largest_error(problem, diffusion):
    """Of each entry over the region, as part of the largest entry there."""
    x = np.random.default_rng(5).uniform(
        *np.array(problem.sampling_domain.region).T, (500, problem.plant.n)
    )
    truth = problem.plant.numeric(problem.plant.diffusion * problem.plant.diffusion.T)
    pairs = [
        (entry_at(problem, a, x), entry_at(problem, b, x))
        for a, b in zip(truth, diffusion.covariance, strict=True)
    ]
    return max(np.abs(a - b).max() for a, b in pairs) / max(np.abs(a).max() for a, _ in pairs)


@pytest.mark.parametrize(
    ("problem", "degrees"),
    [
        (problem_of("safe_envs/Pendulum-v0"), {(0, 0): 2}),
        (problem_of("safe_envs/CubicSDE-v0"), {(1, 1): 2}),
        (problem_of("safe_envs/ACCGap-v0"), {(0, 0): 0, (1, 1): 0}),
        (made_up(CORRELATED), {(0, 0): 0, (0, 1): 0, (1, 1): 0}),
        (made_up(VARYING), {(0, 0): 2, (0, 1): 1, (1, 1): 2}),
    ],
    ids=["pendulum", "cubic", "gap", "correlated", "varying"],
)
def test_the_covariance_is_recovered_with_its_degree(problem, degrees):
    diffusion, errors = learned(problem)
    assert {(e.row, e.column): e.features.degree for e in diffusion.entries} == degrees
    # An estimate has a relative deviation of sqrt(2/999) = 4.5 %; the corner of a quadratic in 300
    # points a few tenths of it.
    assert largest_error(problem, diffusion) < 0.03
    assert len(errors) == len(degrees)
    assert all(0 < error < 0.1 for error in errors.values())


def test_covariances_have_their_law():
    problem = made_up(CORRELATED)
    data = collect(problem, 400, 100, [(-1.0,)], seed=4)
    found, truth = (
        covariances(data, rates(problem.model, data)),
        np.array(CORRELATED) @ np.array(CORRELATED).T,
    )
    law = np.sqrt((truth**2 + np.outer(truth.diagonal(), truth.diagonal())) / 100)
    scores = (found - truth) / law
    assert (np.abs(scores.mean(axis=0)) < 5 / 20).all()
    assert (np.abs((scores**2).mean(axis=0) - 1) < 5 * np.sqrt(2 / 400) + 12 / 100).all()


def test_covariances_of_repeated_steps_are_those_of_the_sample():
    data = collect(made_up(CORRELATED), 20, 3, [(-1.0,)])
    expected = [
        np.cov(successors.T, ddof=1) / dt
        for successors, dt in zip(data.successors, data.dt, strict=True)
    ]
    # What is subtracted is about a hundred times as large as what is left.
    np.testing.assert_allclose(
        covariances(data, np.zeros_like(data.x)), expected, rtol=1e-11, atol=1e-13
    )


@pytest.mark.parametrize(
    "diffusion", [CORRELATED, VARYING, [[0.3], [0.2]]], ids=["constant", "varying", "one channel"]
)
def test_the_factor_of_the_system_returns_the_covariance(diffusion):
    problem = made_up(diffusion)
    found, _ = learned(problem, 100, 100)
    system = found.system(problem.model)
    product = system.diffusion * system.diffusion.T
    difference = product - found.covariance
    assert not difference.free_symbols
    assert np.abs(np.array(difference, dtype=float)).max() < 1e-12
    assert system.drift == problem.model.drift
    h = problem.barriers[0].expression
    assert all(power.exp.is_Integer for power in ito_correction(system, h).atoms(sp.Pow))
    assert all(entry.is_real for entry in system.diffusion if entry.is_number)


def test_a_variance_that_comes_out_negative_cancels():
    problem = problem_of("safe_envs/Pendulum-v0")
    found, _ = learned(problem, 60, 20, seed=1)
    system = found.system(problem.model)
    assert system.diffusion * system.diffusion.T == found.covariance
    assert system.diffusion.cols == 1


def test_no_noise_gives_no_entries():
    problem = problem_of("safe_envs/ACC-v0").configured(noise=0.0)
    steps = collect(problem, 50, 1)
    rate = rates(problem.model, steps)
    exact = replace(steps, successors=(steps.x + rate * steps.dt[:, None])[:, None])
    found, errors = learn_diffusion(problem, exact, rate)
    assert (found.entries, errors) == ((), {})
    assert found.system(problem.model).diffusion == sp.zeros(3, 1)


def test_passive_logs_are_enough():
    problem = made_up(VARYING)
    data = collect(problem, 200, 1, steps=100, seed=2)
    found, _ = learn_diffusion(problem, data, rates(problem.model, data))
    # 40000 single squares, each with a relative deviation of sqrt(2): under 1 % for a constant,
    # some ten times that at the corner of a quadratic.
    assert largest_error(problem, found) < 0.1


def test_few_points_fit_a_constant_whose_error_is_not_known():
    problem = problem_of("safe_envs/ACCGap-v0")
    found, errors = learned(problem, 3, 100)
    assert {e.features.degree for e in found.entries} == {0}
    assert errors == {}
    # Errors are told at start states that are held out, of which several inputs make no more.
    assert learned(problem, 4, 20, [(float(u),) for u in range(5)])[1] == {}


def test_restored_is_the_same_and_what_was_damaged_is_refused():
    problem = made_up(VARYING)
    found, _ = learned(problem, 100, 100)
    again = LearnedDiffusion.restored(problem.plant.states, found.details(), found.to_arrays())
    assert again.covariance == found.covariance
    damaged = {name: weights[1:] for name, weights in found.to_arrays().items()}
    with pytest.raises(ValueError, match="shape"):
        LearnedDiffusion.restored(problem.plant.states, found.details(), damaged)


def test_a_step_without_noise_is_not_taken_for_noise():
    """Runge and Kutta's step, finer than that of the estimator here, is not Euler's: the difference
    is no covariance."""
    problem = problem_of("safe_envs/QuadrotorLimits-v0").configured(substeps=3)
    for data in (collect(problem, 30, 5), collect(problem, 30, 1)):
        rate = rates(problem.model, data)
        mean = mean_rates(problem.model, data, rate)
        assert learn_diffusion(problem, data, mean, slack(data, rate, mean))[0].entries == ()
        assert not drift_warnings(data, rate, mean, [str(s) for s in problem.plant.states])


def test_with_repetitions_a_wrong_drift_is_not_taken_for_noise():
    problem = made_up(CORRELATED)
    data = collect(problem, 20, 50, [(-1.0,)])
    np.testing.assert_array_equal(
        covariances(data, rates(problem.model, data)), covariances(data, np.full((20, 2), 10.0))
    )
