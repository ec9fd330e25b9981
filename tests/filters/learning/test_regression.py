"""The posterior of weights against other ways to it, and that of a noise level."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.stats import kstest

from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning.bayesian import posterior
from safe_envs.filters.learning.models.distributions import (
    Gaussian,
    sigma_map,
    sigma_quantile,
    sigma_samples,
)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def brute_force(design, y, variance, prior):
    """Thesis Eq. (6.7) output by output, with any diagonal noise."""
    eye = np.eye(design.shape[1])
    covariances = [
        np.linalg.inv(design.T @ (design / v[:, None]) + eye / prior) for v in variance.T
    ]
    return [
        c @ design.T @ (y[:, i] / variance[:, i]) for i, c in enumerate(covariances)
    ], covariances


@pytest.mark.parametrize("rows", [3, 40])
@pytest.mark.parametrize("shape", ["one for each output", "one for each row", "proportional"])
def test_the_posterior_is_that_of_the_formula(rng, rows, shape):
    design, y = rng.normal(size=(rows, 5)), rng.normal(size=(rows, 3))
    variance = {
        "one for each output": rng.uniform(0.1, 2.0, 3),
        "one for each row": rng.uniform(0.1, 2.0, (rows, 3)),
        "proportional": rng.uniform(0.1, 2.0, (rows, 1)) * rng.uniform(0.1, 2.0, 3),
    }[shape]
    found = posterior(design, y, variance, prior=7.0)
    mean, covariance = brute_force(design, y, np.broadcast_to(variance, y.shape), 7.0)
    assert found.mean == pytest.approx(np.array(mean), rel=1e-9, abs=1e-12)
    assert found.covariance == pytest.approx(np.array(covariance), rel=1e-9, abs=1e-12)


def test_what_is_not_seen_keeps_the_prior_even_without_noise(rng):
    design = rng.normal(size=(50, 4))
    design[:, 3] = design[:, 2]
    found = posterior(design, design[:, :1], np.array([1e-18]), prior=9.0)
    unseen = np.array([0.0, 0.0, 1.0, -1.0]) / np.sqrt(2.0)
    assert unseen @ found.covariance[0] @ unseen == pytest.approx(9.0, rel=1e-6)
    assert found.mean[0] == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-7)


def test_draws_of_the_weights_have_their_covariance(rng):
    root = rng.normal(size=(2, 3, 3))
    gaussian = Gaussian(rng.normal(size=(2, 3)), root @ root.transpose(0, 2, 1))
    draws = np.array([gaussian.sample(rng) for _ in range(20_000)])
    assert draws.mean(axis=0) == pytest.approx(gaussian.mean, abs=0.1)
    for i in range(2):
        assert np.cov(draws[:, i].T) == pytest.approx(gaussian.covariance[i], abs=0.25)


def log_density(sigma, squares, count, alpha, beta):
    return -(count + alpha + 1) * np.log(sigma) - squares / (2 * sigma**2) - beta / sigma


@pytest.mark.parametrize("count", [1, 1_000, 10**7])
@pytest.mark.parametrize("level", [1e-3, 30.0])
@pytest.mark.parametrize(("alpha", "beta"), [(1.0, 1.0), (3.0, 0.1), (0.5, 20.0)])
def test_the_most_probable_sigma_maximises_its_density(count, level, alpha, beta):
    squares = count * level**2
    found = float(sigma_map(np.array(squares), np.array(count), alpha, beta))
    best = minimize_scalar(
        lambda d: -log_density(found * np.exp(d), squares, count, alpha, beta),
        bounds=(-3.0, 3.0),
        method="bounded",
        options={"xatol": 1e-10},
    )
    # How exactly a maximum can be found that is as flat as the rounding of its height.
    assert abs(float(best.x)) < 1e-5


@pytest.mark.parametrize(
    ("squares", "count", "alpha", "beta"),
    [(0.4, 10, 1.0, 1.0), (40.0, 1000, 1.0, 1.0), (0.0, 10, 1.0, 1.0), (0.3, 1, 1.0, 0.0)],
)
def test_quantiles_of_sigma_are_those_of_its_density(squares, count, alpha, beta):
    mode = float(sigma_map(np.array(squares), np.array(count), alpha, beta))
    top = log_density(mode, squares, count, alpha, beta)

    def mass(low, high):
        # Over log sigma.
        def height(t):
            return np.exp(log_density(np.exp(t), squares, count, alpha, beta) - top + t)

        return quad(
            height,
            np.log(low),
            np.log(high),
            limit=500,
            points=[np.log(mode)] if low < mode < high else None,
        )[0]

    whole = mass(mode * 1e-2, mode * 1e5)
    for level in (0.01, 0.3, 0.5, 0.9, 0.999):
        quantile = float(sigma_quantile(np.array(level), squares, count, alpha, beta))
        assert mass(mode * 1e-2, quantile) / whole == pytest.approx(level, abs=2e-5)


@pytest.mark.parametrize("count", [10, 10**4, 10**7])
def test_draws_of_sigma_spread_as_the_data_allow(rng, count):
    draws = sigma_samples(0.04 * count, count, 1.0, 1.0, 4000, rng)
    assert np.median(draws) == pytest.approx(
        float(sigma_quantile(np.array(0.5), 0.04 * count, count)), rel=0.1
    )
    if count > 10:
        assert draws.std() == pytest.approx(0.2 / np.sqrt(2 * count), rel=0.05)
        assert kstest(draws, "norm", args=(0.2, 0.2 / np.sqrt(2 * count))).statistic < 0.05


@pytest.mark.parametrize(
    ("variance", "prior"), [(0.0, 1.0), (-1.0, 1.0), (np.nan, 1.0), (1.0, 0.0), (1.0, np.inf)]
)
def test_a_variance_that_is_none_is_refused(rng, variance, prior):
    with pytest.raises(ConfigurationError, match="positive and finite"):
        posterior(rng.normal(size=(5, 2)), rng.normal(size=(5, 1)), np.array([variance]), prior)


@pytest.mark.parametrize(
    "arguments",
    [(1.0, 10, -1.0, 1.0), (1.0, 10, 1.0, np.nan), (0.0, 10, 1.0, 0.0), (-1.0, 10, 1.0, 1.0)],
)
def test_no_distribution_of_sigma(arguments):
    with pytest.raises(ConfigurationError, match="sigma"):
        sigma_quantile(np.array(0.5), *arguments)
