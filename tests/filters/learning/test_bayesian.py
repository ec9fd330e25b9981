"""Bayesian identification: its laws, its coverage, and the system that comes of it."""

from __future__ import annotations

import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.stats import kstest, norm

from safe_envs.dynamics.codegen import compile_function, stacked
from safe_envs.dynamics.lie import generator, relative_degree
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning.bayesian import (
    IdentifiabilityWarning,
    Prior,
    Rows,
    fit,
    identify,
    posterior,
)
from safe_envs.filters.learning.collection import collect, draw_states, plant_step
from safe_envs.filters.learning.data import LearnedFileError, Signature, Transitions, load
from safe_envs.filters.learning.models.distributions import (
    Gaussian,
    sigma_map,
    sigma_quantile,
    sigma_samples,
)
from safe_envs.filters.learning.models.features import Features
from safe_envs.filters.learning.models.posterior import Posterior
from safe_envs.problem.problem import SafetyProblem
from safe_envs.systems.acc_gap import acc_gap
from safe_envs.systems.cubic import cubic_sde, cubic_sde_disk
from safe_envs.systems.dubins import dubins_disk

pytestmark = pytest.mark.slow

CUBIC = cubic_sde_disk()
PLACES = np.array([[0.0, 0.0], [0.5, -0.3], [-0.6, 0.6]])
FLAT = Prior(1e4, 1.0, 1.0)


@pytest.fixture(scope="module")
def cubic() -> Posterior:
    return identify(CUBIC)


@pytest.fixture(scope="module")
def gap() -> Posterior:
    return identify(acc_gap())


def values(expressions, states, x) -> np.ndarray:
    return stacked(compile_function(states, list(expressions), "arrays")(*x.T), len(x))


def repeated_fits(times: int, points: int, repetitions: int):
    """Posteriors of f and g of the cubic system in features of degree 3, from independent data."""
    features = Features.of(CUBIC, 3)
    for seed in range(times):
        rows = Rows.of(collect(CUBIC, points, repetitions, seed=seed))
        design = rows.design(features, np.ones(1))
        yield rows, design, features, fit(rows, design, None, FLAT)


def test_the_paired_form_of_the_thesis_is_the_same_posterior():
    size, repetitions, dt = 2.0, 8, CUBIC.dt
    found = identify(
        CUBIC, degree=3, data=collect(CUBIC, 100, repetitions, inputs=[[-size], [size]])
    )
    data = collect(CUBIC, 100, repetitions, inputs=[[-size], [size]])
    rate = (data.successors.mean(axis=1) - data.x) / dt
    first, second, phi = rate[::2], rate[1::2], found.features.matrix(data.x[::2])
    u_1, u_2 = -size, size
    # Thesis Eq. (6.5), and the variances that belong to it.
    y_f, y_g = (first * u_2 - second * u_1) / (u_2 - u_1), (first - second) / (u_1 - u_2)
    noise = found.diffusion.squares / found.diffusion.count
    spread_f = noise * (u_1**2 + u_2**2) / (repetitions * dt * (u_1 - u_2) ** 2)
    spread_g = 2 * noise / (repetitions * dt * (u_1 - u_2) ** 2)
    # The weights of g are for the input in units of `size`, and so is their prior.
    f, g = posterior(phi, y_f, spread_f, 10.0), posterior(phi, y_g * size, spread_g * size**2, 10.0)
    assert found.mean == pytest.approx(np.hstack((f.mean, g.mean)), rel=1e-8, abs=1e-10)
    count = found.features.count
    assert found.covariance[:, :count, :count] == pytest.approx(f.covariance, rel=1e-8)
    assert found.covariance[:, count:, count:] == pytest.approx(g.covariance, rel=1e-8)
    assert abs(found.covariance[:, :count, count:]).max() < 1e-10


def test_credible_intervals_cover_and_those_of_the_print_do_not():
    covered, printed, level = [], [], norm.ppf(0.95)
    phi = np.hstack((Features.of(CUBIC, 3).matrix(PLACES), np.zeros((3, 10))))
    truth = PLACES[:, 0] ** 3
    for rows, design, _, found in repeated_fits(200, 40, 5):
        error = abs(phi @ found.learned.mean[1] - truth)
        covered.append(
            error <= level * np.sqrt(((phi @ found.learned.covariance[1]) * phi).sum(axis=1))
        )
        without_dt = posterior(
            design, rows.rate, found.diffusion.squares / found.diffusion.count / 5, 1e4
        )
        error = abs(phi @ without_dt.mean[1] - truth)
        printed.append(
            error <= level * np.sqrt(((phi @ without_dt.covariance[1]) * phi).sum(axis=1))
        )
    # 3 standard deviations of a share of 200.
    assert np.mean(covered, axis=0) == pytest.approx([0.9] * 3, abs=0.065)
    assert np.mean(printed) < 0.25


def test_errors_follow_the_time_that_was_observed():
    x, square, levels = draw_states(CUBIC, 400, np.random.default_rng(0)), [], []
    points, repetitions = 300, 4
    for _, _, features, found in repeated_fits(40, points, repetitions):
        estimate = features.matrix(x) @ found.learned.mean[1, : features.count]
        square.append(np.mean((estimate - x[:, 0] ** 3) ** 2))
        levels.append(found.diffusion.sigma)
    transitions = 2 * points * repetitions
    assert np.mean(square) == pytest.approx(10 * 0.04 / (transitions * CUBIC.dt), rel=0.25)
    # Of the K repetitions, one is spent on the mean.
    expected = np.sqrt(1 / (2 * transitions * (repetitions - 1) / repetitions))
    assert np.std(np.array(levels) / 0.2) == pytest.approx(expected, rel=0.25)
    assert np.mean(levels) == pytest.approx(0.2, rel=0.01)


def test_a_log_with_repetitions_is_what_a_collector_gives():
    data = collect(CUBIC, 50, 6)
    flat = Transitions.from_log(
        CUBIC,
        data.x.repeat(6, axis=0),
        data.u.repeat(6, axis=0),
        data.successors.reshape(-1, 2),
        CUBIC.dt,
    )
    mine, logged = identify(CUBIC, data=data), identify(CUBIC, data=flat)
    for name, array in mine.arrays().items():
        assert np.array_equal(array, logged.arrays()[name]), name


def test_a_log_without_repetitions():
    rng = np.random.default_rng(0)
    x = draw_states(CUBIC, 4000, rng)
    u = rng.uniform(-5.0, 5.0, (4000, 1))
    dt = rng.uniform(0.005, 0.02, 4000)
    drift = np.column_stack((-0.6 * x[:, 0] - x[:, 1], x[:, 0] ** 3 + x[:, 1] * u[:, 0]))
    after = x + drift * dt[:, None] + 0.2 * np.sqrt(dt)[:, None] * rng.standard_normal((4000, 2))
    found = identify(CUBIC, data=Transitions.from_log(CUBIC, x, u, after, dt))
    assert found.diffusion.count == 4000 - 20
    assert found.diffusion.sigma == pytest.approx([0.2, 0.2], rel=0.04)
    for name in ("x_1 standardised", "x_2 standardised"):
        assert found.record.errors[name] == pytest.approx(1.0, abs=0.1)
    assert found.record.seed is None
    doubt = np.sqrt(found.drift_variance(PLACES)[:, 1, 0, 0])
    estimate = found.features.matrix(PLACES) @ found.mean[1, :10]
    assert (abs(estimate - PLACES[:, 0] ** 3) < 4 * doubt).all()


EIGHT = draw_states(CUBIC, 8, np.random.default_rng(0))
SHORT = Transitions.from_log(CUBIC, EIGHT, np.linspace(-1, 1, 8)[:, None], EIGHT + 0.01, 0.01)


@pytest.mark.parametrize(
    ("name", "problem", "degree", "pruned"),
    [("cubic", CUBIC, 1, [[1], [0]]), ("gap", acc_gap(), 2, [[0], [1]])],
)
def test_the_identified_system(request, name: str, problem: SafetyProblem, degree: int, pruned):
    found: Posterior = request.getfixturevalue(name)
    assert isinstance(found.system, ControlAffineSDE)
    assert found.pruned.tolist() == pruned
    for system in (found.system, found.sample(np.random.default_rng(0))):
        assert relative_degree(system, problem.barriers[0].expression, generator) == degree
        assert relative_degree(system, problem.barriers[0].expression) == degree
    assert np.diag(np.array(found.system.diffusion, dtype=float)) == pytest.approx(
        [problem.plant.parameters[s] for s in sigmas(problem)], rel=0.02
    )
    for state in problem.plant.states:
        assert found.record.errors[f"{state} standardised"] == pytest.approx(1.0, abs=0.15)
        assert found.record.errors[f"{state} error"] >= 0.9 * found.record.errors[f"{state} noise"]


def sigmas(problem: SafetyProblem) -> list[sp.Symbol]:
    return [p for p in problem.plant.parameters if p.name in problem.noise]


def test_the_truth_is_within_what_is_known(cubic: Posterior):
    x = draw_states(CUBIC, 300, np.random.default_rng(5))
    variance = cubic.drift_variance(x)
    pairs = cubic.compare(CUBIC, x)
    assert set(pairs) == {
        *("f[x_1]", "f[x_2]", "g[x_1, u]", "g[x_2, u]"),
        *("covariance[x_1, x_1]", "covariance[x_1, x_2]", "covariance[x_2, x_2]"),
    }
    for i, state in enumerate(("x_1", "x_2")):
        for p, name in enumerate((f"f[{state}]", f"g[{state}, u]")):
            truth, estimate = pairs[name]
            assert (abs(truth - estimate) < 5 * np.sqrt(variance[:, i, p, p])).all()
    assert (pairs["g[x_1, u]"][1] == 0).all()
    assert pairs["covariance[x_1, x_1]"][0] == pytest.approx(0.04)


def test_variances_of_the_drift_are_those_of_draws(gap: Posterior):
    x = draw_states(acc_gap(), 3, np.random.default_rng(0))
    variance = gap.drift_variance(x)
    expressions = gap.variance_expressions
    for i in range(2):
        symbolic = values(expressions[i], gap.features.states, x).reshape(3, 2, 2)
        assert symbolic == pytest.approx(variance[:, i], rel=1e-6)
    rng, phi = np.random.default_rng(1), gap.features.matrix(x)
    draws = np.array(
        [gap.weights.sample(rng)[1, : gap.features.count] @ phi.T for _ in range(2000)]
    )
    assert draws.var(axis=0) == pytest.approx(variance[:, 1, 0, 0], rel=0.15)


def test_what_is_pruned_is_left_out_of_the_rest():
    # Inputs of one sign: f and g are correlated, so that f changes once g is known to be 0.
    found = identify(CUBIC, data=collect(CUBIC, 300, 10, inputs=[[1.0], [2.0]]), degree=1)
    assert found.pruned[0, 0]
    rows = Rows.of(collect(CUBIC, 300, 10, inputs=[[1.0], [2.0]]))
    alone = posterior(
        rows.design(found.features, found.input_scale)[:, :3],
        rows.rate,
        found.diffusion.variances(rows.x) / 0.1,
        10.0,
    )
    assert found.weights.mean[0, :3] == pytest.approx(alone.mean[0], rel=1e-6)
    assert found.weights.covariance[0, :3, :3] == pytest.approx(alone.covariance[0], rel=1e-5)


@pytest.mark.parametrize("env_id", ["safe_envs/DubinsDisk-v0", "safe_envs/QuadrotorAltitude-v0"])
def test_an_input_that_reaches_a_position_within_a_step_is_pruned(env_id):
    problem = gym.make(env_id).unwrapped.problem  # pyright: ignore[reportAttributeAccessIssue]
    found = identify(problem, starts=100, steps=1, repetitions=2)
    assert not found.diffusion.sigma.any()
    assert found.system.diffusion.is_zero_matrix
    assert relative_degree(found.system, problem.model.numeric(problem.barriers[0].expression)) == 2


def test_noise_that_varies_with_the_state(tmp_path: Path):
    problem = cubic_sde()
    found = identify(problem, starts=300, steps=1, repetitions=30, diffusion_degree=2)
    x = draw_states(problem, 200, np.random.default_rng(0))
    truth, estimate = found.compare(problem, x)["covariance[x_2, x_2]"]
    assert estimate == pytest.approx(truth, abs=6e-4)
    assert (estimate > 0).all()
    assert estimate == pytest.approx(found.diffusion.variances(x)[:, 1])
    found.save(tmp_path / "file")
    again = Posterior.from_content(load(tmp_path / "file"), problem)
    assert again.system == found.system
    drawn = found.sample(np.random.default_rng(0))
    assert values([drawn.diffusion[1, 1] ** 2], drawn.states, x)[:, 0] == pytest.approx(
        truth, abs=1e-3
    )


def test_rounding_is_no_noise():
    # Of the two states x_2 has noise. But the mean of three equal numbers is rounded, and they
    # deviate from it.
    problem = cubic_sde()
    assert problem.plant.diffusion.row(0).is_zero_matrix
    rows = Rows.of(collect(problem, 200, 3))
    assert (rows.deviation[:, 0] != 0.0).any()
    found = fit(rows, rows.design(Features.of(problem, 1), np.ones(1)), None, FLAT).diffusion
    assert found.squares[0] == found.sigma[0] == 0.0 < found.sigma[1]


def test_noise_that_drives_two_states_together():
    rng, x = np.random.default_rng(0), draw_states(CUBIC, 2000, np.random.default_rng(1))
    u, w = rng.choice([-1.0, 1.0], (2000, 1)), rng.standard_normal(2000)
    after = x + 0.01 * u * x + 0.1 * np.column_stack((0.2 * w, -0.3 * w))
    found = identify(CUBIC, data=Transitions.from_log(CUBIC, x, u, after, 0.01), degree=1)
    covariance = found.system.diffusion * found.system.diffusion.T
    assert np.array(covariance, dtype=float) == pytest.approx(
        np.array([[0.04, -0.06], [-0.06, 0.09]]), rel=0.06
    )


@pytest.mark.parametrize(
    ("arguments", "error", "told"),
    [
        ({"data": collect(dubins_disk(), 5, 2)}, LearnedFileError, "another problem"),
        ({"data": SHORT, "degree": 2}, ConfigurationError, "nothing of the noise"),
    ],
)
def test_what_cannot_be_identified_is_refused(arguments, error, told):
    with pytest.raises(error, match=told):
        identify(CUBIC, **arguments)


def test_the_degree_fits_the_data(cubic: Posterior):
    assert cubic.record.settings["degree"] == 3
    assert identify(CUBIC, starts=15, steps=1, repetitions=20).record.settings["degree"] == 2
    obstacles = gym.make("safe_envs/DubinsObstacles-v0").unwrapped.problem  # pyright: ignore[reportAttributeAccessIssue]
    assert identify(obstacles, starts=100, steps=1, repetitions=2).record.settings["degree"] == 1


def test_the_same_seed_identifies_the_same():
    parts: list[float] = []
    settings = {"starts": 20, "steps": 2, "repetitions": 3, "seed": 4, "prior": 1e4}
    found = identify(CUBIC, **settings, progress=parts.append)
    assert parts == sorted(parts)
    assert parts[-1] == 1.0
    assert (found.record.transitions, found.record.seed) == (240, 4)
    assert found.record.observed == pytest.approx(2.4)
    assert found.signature == Signature.of(CUBIC)
    assert np.array_equal(found.mean, identify(CUBIC, **settings).mean)


# The posterior of weights against other ways to it, and that of a noise level.


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


# What data leave open is told, with the names of the terms and states.


PROBLEM = cubic_sde_disk()


def told(problem: SafetyProblem = PROBLEM, **arguments) -> tuple[Posterior, str]:
    with pytest.warns(IdentifiabilityWarning) as caught:
        found = identify(problem, **arguments)
    assert tuple(str(w.message) for w in caught) == found.record.warnings
    return found, "\n".join(found.record.warnings)


def data_at(x: np.ndarray, levels: tuple[float, ...], repetitions: int = 5) -> Transitions:
    """Transitions from given states (B, 2) under some inputs."""
    rows, u = np.repeat(x, len(levels), axis=0), np.tile(levels, len(x))[:, None]
    step, rng = plant_step(PROBLEM), np.random.default_rng(1)
    successors = np.stack([step(rows, u, rng) for _ in range(repetitions)], axis=1)
    return Transitions(Signature.of(PROBLEM), rows, u, successors, np.array(PROBLEM.dt))


def test_inputs_of_both_signs_are_enough():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert identify(PROBLEM, starts=200, steps=1, repetitions=10).record.warnings == ()


STILL = draw_states(PROBLEM, 60, np.random.default_rng(0)) * [0.0, 1.0] + [0.3, 0.0]
FEW = draw_states(PROBLEM, 8, np.random.default_rng(0))
LEFT_OPEN = {
    "one input": (
        lambda: {"data": collect(PROBLEM, 200, 10, inputs=[[0.1]])},
        ("input u stays within", "1 and u; x_1 and u x_1; x_2 and u x_2", "6 more"),
    ),
    "no input": (lambda: {"data": collect(PROBLEM, 200, 10, inputs=[[0.0]])}, ("never excited",)),
    "a state that never varies": (
        lambda: {"data": data_at(STILL, (-1.0, 1.0))},
        ("the state x_1 is always 0.3", "x_2 and x_1 x_2 and x_1^2 x_2"),
    ),
    "few rows": (
        lambda: {"data": data_at(FEW, (-1.0, 1.0)), "degree": 3},
        ("16 different rows of data are too few for 20 weights",),
    ),
    "what the noise drowns": (
        lambda: {"starts": 50, "steps": 1, "repetitions": 2, "prior": 1e-3},
        ("the noise drowns", "x_1, x_2: "),
    ),
    "features that miss something": (
        lambda: {"starts": 400, "steps": 1, "repetitions": 400, "degree": 1},
        ("x_2: features of degree 1 miss",),
    ),
}


@pytest.mark.parametrize("name", LEFT_OPEN)
def test_what_the_data_leave_open_is_named(name):
    arguments, parts = LEFT_OPEN[name]
    found, text = told(**arguments())
    assert all(part in text for part in parts)
    assert "x_1: features" not in text
    assert name != "no input" or found.pruned.all()


def test_noise_that_varies_is_identified_where_the_data_show_it():
    problem = cubic_sde()
    _, text = told(problem, starts=200, steps=1, repetitions=20)
    assert "x_2: the variance of its noise varies by" in text
    assert "x_1" not in text
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        identify(problem, starts=200, steps=1, repetitions=20, diffusion_degree=2)
