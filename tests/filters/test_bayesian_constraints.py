"""Rows of identified systems against the numbers of the posterior, and against draws from it."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy as sp
from scipy import stats

from safe_envs import Barrier, ConfigurationError
from safe_envs.errors import RelativeDegreeError
from safe_envs.filters.learning.models.distributions import Gaussian
from safe_envs.wrappers import SCBF, BayesianSCBF, SafetyFilter
from tests.wrappers.learned import assert_same_decisions, situations, values

pytestmark = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cubic", "gap"])
def test_the_most_probable_system_is_filtered_as_if_it_were_known(request, name):
    problem = request.getfixturevalue(name)
    learned = request.getfixturevalue("posterior" if name == "cubic" else "gap_posterior")
    for margin in ("none", 0.02) if name == "cubic" else ("none",):
        ours = SafetyFilter.for_problem(problem, BayesianSCBF(learned, sampling_margin=margin))
        known = SafetyFilter(
            learned.system,
            [(problem.barriers[0], SCBF(sampling_margin=margin))],
            bounds=problem.box,
        )
        assert_same_decisions(problem, ours, known, tolerance=1e-12)
    if name == "cubic":
        ours = SafetyFilter.for_problem(
            problem, BayesianSCBF(learned, sampling_margin="first-order")
        )
        known = SafetyFilter(
            learned.system,
            [(problem.barriers[0], SCBF(sampling_margin="first-order"))],
            bounds=problem.box,
            dt=problem.dt,
        )
        assert_same_decisions(problem, ours, known, tolerance=1e-12)


def curved_barrier(cubic):
    """A barrier whose second derivatives have both signs."""
    x_1, x_2 = cubic.plant.states
    return Barrier(1 + 0.5 * x_1**3 - x_1**2 / 4 - x_2**2 + x_2**4 / 2, "curved")


def linear_form(learned, x, u):
    """What the weights of each f_i + g_i u are multiplied by, (B, D)."""
    phi = learned.features.matrix(x)
    return np.hstack([phi, *(learned.input_scale[j] * u[:, [j]] * phi for j in range(u.shape[1]))])


def slopes_of(learned, barrier, x):
    return values(
        learned.system, [sp.diff(barrier.expression, s) for s in learned.system.states], x
    )


def curvatures_of(learned, barrier, x):
    return values(
        learned.system, [sp.diff(barrier.expression, s, 2) for s in learned.system.states], x
    )


def robust_row(learned, law, barrier, x, u, z):
    """mean - deviation of L_f h + L_g h u, that of each state times z, for weights of a Gaussian
    law."""
    design, slopes = linear_form(learned, x, u), slopes_of(learned, barrier, x)
    mean = (slopes * (design @ law.mean.T)).sum(axis=1)
    spread = np.stack([((design @ c) * design).sum(axis=1) for c in law.covariance], axis=1)
    return mean - np.sqrt((slopes**2 * spread * np.square(z)).sum(axis=1))


def least_ito(learned, barrier, x, intervals):
    """The least of 1/2 sum_i sigma_i^2 d^2 h/dx_i^2 over the corners of the intervals."""
    curvatures = curvatures_of(learned, barrier, x)
    return np.min(
        [0.5 * curvatures @ np.square(corner) for corner in itertools.product(*intervals)], axis=0
    )


@pytest.mark.slow
@pytest.mark.parametrize("which", ["disk", "curved"])
def test_the_robust_row_is_mean_less_deviations(cubic, posterior, which):
    problem = cubic if which == "disk" else replace(cubic, barriers=(curved_barrier(cubic),))
    barrier, (x, u) = problem.barriers[0], situations(problem, 700)
    law, noise = Gaussian(posterior.mean, posterior.covariance), posterior.diffusion
    all_sure = math.sqrt(stats.chi2.ppf(0.95, 2 * posterior.mean.shape[1]))
    intervals, fixed = (
        posterior.diffusion.sigma_intervals(0.05),
        np.column_stack([posterior.diffusion.sigma] * 2),
    )
    assert (intervals[:, 0] < fixed[:, 0]).all()
    assert (intervals[:, 1] > fixed[:, 1]).all()
    # The weights are as unsure as the noise is large, which may be as large as its interval allows.
    widest = intervals[:, 1] / np.sqrt(noise.squares / noise.count)
    cases = [
        (BayesianSCBF(posterior, confidence=0.97), stats.t.ppf(0.97, noise.count), fixed),
        (
            BayesianSCBF(posterior, simultaneous=0.9, sampling_margin=0.1),
            all_sure * widest,
            intervals,
        ),
        (BayesianSCBF(posterior, simultaneous=0.9), all_sure * widest, intervals),
        (BayesianSCBF(posterior, confidence=0.3), 0.0, fixed),
    ]
    for condition, z, levels in cases if which == "disk" else cases[:2]:
        found = SafetyFilter.for_problem(problem, condition).filter(x, u)
        rest = least_ito(posterior, barrier, x, levels) - (
            0.1 if condition.sampling_margin == 0.1 else 0.0
        )
        expected = robust_row(posterior, law, barrier, x, found.action, z) + rest
        # The variance is a polynomial whose coefficients cancel by some digits, and its root is
        # known to half of the rest.
        np.testing.assert_allclose(found.margin[:, 0], expected, atol=1e-6)
        assert found.feasible.any()
        assert found.active.any()
        for tried in np.linspace(*problem.box[0], 21):
            row = robust_row(posterior, law, barrier, x, np.full_like(u, tried), z) + rest
            # Nothing in the box meets or misses it by less where it cannot be met, or is met and
            # nearer where it can.
            assert (row <= found.margin[:, 0] + 1e-6)[~found.feasible].all()
            nearer = abs(tried - u[:, 0]) < abs(found.action - u)[:, 0] - 1e-6
            assert (row <= 1e-6)[nearer & found.feasible].all()


def test_mean_and_deviation_are_those_of_draws_of_the_weights(cubic, posterior):
    rng, (x, u) = np.random.default_rng(4), situations(cubic, 1000, seed=8)
    barrier, draws = curved_barrier(cubic), 2000
    design, slopes, v = linear_form(posterior, x, u), slopes_of(posterior, barrier, x), u[:, 0]
    weights = np.stack(
        [
            rng.multivariate_normal(m, c, draws)
            for m, c in zip(posterior.mean, posterior.covariance, strict=True)
        ]
    )
    drawn = sum(slopes[:, [i]] * (design @ weights[i].T) for i in range(2))
    condition = BayesianSCBF(posterior, simultaneous=0.9)
    row = condition.constraint(cubic.model, barrier)
    q: Any = row.uncertainty
    a, b, q_0, q_1, q_2 = values(posterior.system, [*row.coefficient, row.offset, *q], x).T
    ito = least_ito(posterior, barrier, x, posterior.diffusion.sigma_intervals(0.05))
    mean, deviation = np.mean(drawn, axis=1), np.std(drawn, axis=1)
    # Five standard errors, of a mean and of a deviation.
    assert (abs(a * v + b - ito - mean) < 5 * deviation / math.sqrt(draws) + 1e-9).all()
    # The noise of both states is as large, and with it the factor of both.
    factor = condition.variance_factors(np.array([True, True]))
    assert factor[0] == pytest.approx(factor[1], rel=0.02)
    expected = np.sqrt(factor.mean()) * deviation
    np.testing.assert_allclose(
        np.sqrt(q_0 + 2 * q_1 * v + q_2 * v * v), expected, rtol=0.02 + 5 / math.sqrt(2 * draws)
    )


def test_the_simultaneous_form_holds_for_its_share_of_the_weights(cubic, posterior):
    """At all states and inputs at once: so for draws of the weights and levels, at those where the
    row is met."""
    rng, (x, u) = np.random.default_rng(5), situations(cubic, 400, seed=9)
    barrier = cubic.barriers[0]
    condition = BayesianSCBF(posterior, simultaneous=0.5)
    found = SafetyFilter.for_problem(cubic, condition).filter(x, u)
    design = linear_form(posterior, x, found.action)
    slopes, curvatures = slopes_of(posterior, barrier, x), curvatures_of(posterior, barrier, x)
    below, times = 0, 100
    for _ in range(times):
        weights = np.array(
            [
                rng.multivariate_normal(m, c)
                for m, c in zip(posterior.mean, posterior.covariance, strict=True)
            ]
        )
        levels = posterior.diffusion._levels(rng)
        truth = (slopes * (design @ weights.T)).sum(axis=1) + 0.5 * curvatures @ levels**2
        below += bool((truth < found.margin[:, 0]).any())
    assert below <= 0.5 * times
    both, one = np.array([True, True]), np.array([True, False])
    assert (
        condition.variance_factors(both)
        < BayesianSCBF(posterior, simultaneous=0.99).variance_factors(both)
    ).all()
    assert (condition.variance_factors(one) < condition.variance_factors(both)).all()
    assert (condition.delta_theta, condition.delta_sigma) == (0.25, 0.25)


def test_the_robust_form_is_for_relative_degree_one(cubic, gap, posterior, gap_posterior):
    for how in ({"confidence": 0.9}, {"simultaneous": 0.9}):
        with pytest.raises(RelativeDegreeError, match=r"relative degree 2.*Leave out confidence"):
            SafetyFilter.for_problem(gap, BayesianSCBF(gap_posterior, **how))
        with pytest.raises(ConfigurationError, match="first order"):
            SafetyFilter.for_problem(
                cubic, BayesianSCBF(posterior, sampling_margin="first-order", **how)
            )
    with pytest.raises(ConfigurationError, match="not both"):
        BayesianSCBF(posterior, confidence=0.9, simultaneous=0.9)
    for value in (0.0, 1.0, -0.1, math.nan, True, "much"):
        for name in ("confidence", "simultaneous"):
            with pytest.raises(ConfigurationError, match=f"{name} = "):
                BayesianSCBF(posterior, **{name: value})
