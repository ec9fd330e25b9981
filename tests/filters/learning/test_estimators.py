"""Estimates of the noise's part of a rate against their sampling laws, and the checks of a drift.

Tolerances are five standard deviations of the statistic that is compared.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import gradient
from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning.collection import collect
from safe_envs.filters.learning.drift_checks import (
    drift_score,
    drift_warnings,
    ito_part,
    mean_rates,
    rates,
    region_warnings,
)
from tests.conftest import problem_of

K = 200
P = np.array([[np.sqrt(3), 1.0], [1.0, np.sqrt(3)]])


@pytest.fixture(scope="module")
def pendulum():
    return problem_of("safe_envs/Pendulum-v0")


@pytest.fixture(scope="module")
def data(pendulum):
    return collect(pendulum, 400, K, inputs=[(-3.0,), (0.0,)], seed=3)


def estimated(problem, data, estimator):
    h = problem.barriers[0].expression
    value, slopes = (
        compile_function(problem.model.states, e, "arrays")
        for e in ([h], list(gradient(problem.model, h)))
    )
    return ito_part(
        data, rates(problem.model, data), lambda x: value(*x)[0], lambda x: slopes(*x), estimator
    )


def warned(model, data):
    rate = rates(model, data)
    return drift_warnings(data, rate, mean_rates(model, data, rate), [s.name for s in model.states])


def truth(data):
    return -np.sqrt(3) * 0.01 * data.x[:, 0] ** 2


def near_one(squares):
    return abs(squares.mean() - 1) < 5 * np.sqrt(2 / len(squares))


def test_rates_are_those_of_the_model_under_the_input(pendulum, data):
    expected = np.column_stack(
        (data.x[:, 1], 10 / 0.7 * np.sin(data.x[:, 0]) + data.u[:, 0] / 0.49)
    )
    np.testing.assert_allclose(rates(pendulum.model, data), expected, rtol=1e-13)


def test_martingale_has_a_relative_deviation_of_sqrt_two_over_n(pendulum, data):
    found = estimated(pendulum, data, "martingale")
    relative = found.values / truth(data) - 1
    # Rounding of h, about 1e-17, over dt shows only where the signal is as good as 0.
    seen = np.abs(truth(data)) > 1e-9
    assert seen.mean() > 0.9
    relative = relative[seen] / np.sqrt(2 / K)
    assert abs(relative.mean()) < 5 / np.sqrt(len(relative))
    # The fourth moment of a mean of K squares of normals exceeds that of a normal by 12/K of its
    # own.
    assert near_one(relative**2)


def test_centred_has_no_bias_but_the_whole_martingale(pendulum, data):
    found = estimated(pendulum, data, "centred")
    moved = data.x + rates(pendulum.model, data) * data.dt[:, None]
    law = 0.1 * np.abs(data.x[:, 0]) * np.abs(2 * moved @ P)[:, 0] / np.sqrt(K * data.dt)
    scores = (found.values - truth(data)) / law
    typical = law > 1e-3
    assert abs(scores[typical].mean()) < 5 / np.sqrt(typical.sum())
    assert near_one(scores[typical] ** 2)


@pytest.mark.parametrize("estimator", ["centred", "martingale"])
def test_standard_errors_are_those_of_the_sample(pendulum, data, estimator):
    found = estimated(pendulum, data, estimator)
    seen = np.abs(truth(data)) > 1e-5
    scores = (found.values - truth(data))[seen] / found.deviations[seen]
    # A mean of K squares of normals is skewed, and its deviation estimated from itself: up to 20/K
    # more than of a t-score.
    assert abs((scores**2).mean() - 1) < 5 * np.sqrt(2 / seen.sum()) + 20 / K


def test_printed_is_biased_by_half_the_curvature_along_the_step(pendulum):
    data = collect(pendulum, 8, 100_000, inputs=[(0.0,)], seed=1)
    found = estimated(pendulum, data, "printed")
    f = rates(pendulum.model, data)
    bias = -data.dt * np.einsum("pi,ij,pj->p", f, P, f)
    assert (np.abs(found.values - truth(data) - bias) < 5 * found.deviations).all()
    assert np.median(np.abs(bias) / found.deviations) > 20


def test_printed_averages_the_successors_alone(pendulum, data):
    few = collect(pendulum, 20, 4, inputs=[(0.0,)], seed=2)
    f = rates(pendulum.model, few)
    still = replace(few, successors=np.repeat((few.x + f * few.dt[:, None])[:, None], 4, axis=1))
    bias = -few.dt * np.einsum("pi,ij,pj->p", f, P, f)
    # One term h(x) more, as printed, would add h/(4 dt), some 5 per s.
    np.testing.assert_allclose(estimated(pendulum, still, "printed").values, bias, atol=1e-12)


def test_what_there_is_no_estimate_of(pendulum, data):
    found = estimated(pendulum, collect(pendulum, 50, seed=0), "martingale")
    assert found.deviations is None
    assert found.values.shape == (100,)
    constant = ito_part(data, np.zeros_like(data.x), lambda x: 2.0, lambda x: (0.0, 0.0))
    assert (constant.values == 0).all()
    with pytest.raises(ConfigurationError, match="printed, centred, martingale"):
        estimated(pendulum, data, "median")


def test_a_wrong_drift_is_told(pendulum, data):
    right, wrong = pendulum.model, pendulum.model.with_parameters(l=0.5)
    assert abs(drift_score(data, rates(right, data)) - 1) < 0.1
    assert not warned(right, data)
    (warning,) = warned(wrong, data)
    assert "standard errors away" in warning


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_mean_rates_follow_the_integrator(noise):
    problem = problem_of("safe_envs/Pendulum-v0").configured(noise=noise)
    data = collect(problem, 200, K, seed=5)
    rate = rates(problem.model, data)
    mean = mean_rates(problem.model, data, rate)
    moved = (data.successors.mean(axis=1) - data.x) / data.dt[:, None]
    if noise:
        # An Euler step is told from the noise by far less than what the curvature of the path
        # makes.
        assert np.abs(mean - rate).max() < 0.02 * np.abs(rate).max() * data.dt[0]
    else:
        np.testing.assert_allclose(mean, moved, atol=1e-11)
        assert np.abs(mean - rate).max() > 0.1 * np.abs(rate).max() * data.dt[0]


@pytest.mark.parametrize("substeps", [1, 4])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_no_way_of_integrating_is_taken_for_a_wrong_model(noise, substeps):
    problem = problem_of("safe_envs/Pendulum-v0").configured(noise=noise, substeps=substeps)
    for data in (collect(problem, 200, 500, seed=2), collect(problem, 200, 1, seed=2, steps=10)):
        assert not warned(problem.model, data)


def test_a_log_that_does_not_fit_is_told(pendulum):
    log = collect(pendulum, 200, 1, seed=1, steps=10)
    (slow,) = warned(pendulum.model, replace(log, dt=10 * log.dt))
    assert "times: theta 0.097, thetadot 0.1. A wrong dt" in slow
    swapped = replace(log, x=log.x[:, ::-1], successors=log.successors[:, :, ::-1])
    assert "columns in another order" in warned(pendulum.model, swapped)[0]
    for seed in range(10):
        assert not warned(pendulum.model, collect(pendulum, 30, 1, seed=seed))


def test_states_outside_the_explored_region_are_told(pendulum):
    log = collect(pendulum, 100, 1)
    assert region_warnings(pendulum, log) == ()
    x = log.x + 3.0 * (np.arange(len(log.x)) < 20)[:, None] * [1.0, 0.0]
    (warning,) = region_warnings(pendulum, replace(log, x=x))
    assert warning.startswith("10% of the data have theta outside the explored region, [-")
    assert f"to {x[:, 0].max():g}" in warning
    dubins = problem_of("safe_envs/StochasticDubins-v0")
    data = collect(dubins, 20, 1)
    assert region_warnings(dubins, replace(data, x=data.x + np.array([0.0, 0.0, 20.0]))) == ()
