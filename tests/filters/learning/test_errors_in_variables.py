"""Identification from states that were measured with noise."""

import warnings

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning.bayesian import identify, unbiased
from safe_envs.filters.learning.collection import collect
from safe_envs.problem.measurement import Channel, Measurement
from safe_envs.registry import make_problem

x, y, u, sigma = sp.symbols("x y u sigma", real=True)


@pytest.fixture(autouse=True)
def _quiet():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def gaussian_mean(expression, variances):
    """Return E p(x + v) exactly, by the moments of Gaussian numbers."""
    found = sp.expand(expression)
    for state, variance in zip((x, y), variances, strict=True):
        e = sp.Symbol("e", real=True)
        moved = sp.Poly(sp.expand(found.subs(state, state + e)), e)
        found = sp.expand(
            sum(
                c * (sp.factorial2(k - 1) * variance ** (k // 2) if k % 2 == 0 else 0)
                for (k,), c in moved.terms()
            )
        )
    return found


@pytest.mark.parametrize("p", [x, x**2, x**3 * y**2 - x + 1, (x + 2 * y) ** 4, sp.Integer(3)])
def test_unbiased_polynomials_have_the_mean_of_the_true_ones(p):
    variances = np.array([0.25, 0.5])
    exact = [sp.Rational(1, 4), sp.Rational(1, 2)]
    left = sp.expand(sp.nsimplify(gaussian_mean(unbiased(p, (x, y), variances), exact)) - p)
    assert left == 0


def line(noise: float, spread: float = 1.0):
    """Return dx = (-x + u) dt + .2 dW, with starts uniform in [-spread, spread]."""
    system = ControlAffineSDE.from_rate(
        (x,), (u,), [-x + u], diffusion=[sigma], parameters={sigma: 0.2}
    )
    problem = define_problem(
        system,
        spread**2 - x**2,
        input_bounds=(-2, 2),
        start=[(-0.5, 0.5)],
        dt=0.1,
        horizon=1.0,
        workspace={x: (-spread, spread)},
    )
    return problem.configured(measurement=Measurement((Channel("x", x, noise),)))


def slope(learned) -> float:
    """Return df/dx of a learned line."""
    return float(sp.diff(learned.system.drift[0], x))


@pytest.mark.parametrize("repetitions", [1, 20])
def test_the_bias_of_a_line_has_its_closed_form_and_is_removed(repetitions):
    noise, problem = 0.3, line(0.3)
    naive, corrected, levels = [], [], []
    for seed in range(8):
        settings = {"starts": 2000, "repetitions": repetitions, "degree": 1, "seed": seed}
        naive.append(slope(identify(problem, errors_in_variables=False, **settings)))
        found = identify(problem, **settings)
        corrected.append(slope(found))
        levels.append(found.diffusion.sigma[0])
    # Uniform starts have the variance 1/3. What is seen of x has R more, and -v/dt in its rate.
    variance, r, dt = 1 / 3, noise**2, 0.1
    expected = (-variance - r / dt) / (variance + r)
    error = np.std(naive, ddof=1) / np.sqrt(8)
    assert abs(np.mean(naive) - expected) < 4 * error
    assert abs(np.mean(naive) + 1.0) > 20 * error
    assert abs(np.mean(corrected) + 1.0) < 4 * np.std(corrected, ddof=1) / np.sqrt(8)
    if repetitions > 1:
        assert np.mean(levels) == pytest.approx(0.2, abs=0.02)


def test_a_cubic_system_is_found_behind_its_sensor():
    problem = make_problem("CubicSDEDisk-v0", measurement="default", sensor_noise=0.5)
    truth = sp.lambdify(problem.plant.states, list(problem.plant.numeric(problem.plant.drift)))
    states = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    exact = np.array([np.broadcast_to(np.asarray(v, float), 200) for v in truth(*states.T)])

    def errors(**settings):
        found = []
        for seed in range(5):
            learned = identify(problem, starts=5000, repetitions=20, seed=seed, **settings)
            formula = sp.lambdify(problem.plant.states, list(learned.system.drift))
            values = [np.broadcast_to(np.asarray(v, float), 200) for v in formula(*states.T)]
            found.append(np.array(values) - exact)
        return np.sqrt((np.mean(found, axis=0) ** 2).mean()), learned

    biased, _ = errors(errors_in_variables=False)
    left, learned = errors()
    assert left < 0.6 * biased
    np.testing.assert_allclose(learned.diffusion.sigma, 0.2, atol=0.02)


def test_the_covariance_of_the_weights_is_honest():
    problem, found, deviations = line(0.2), [], []
    for seed in range(60):
        learned = identify(problem, starts=400, repetitions=5, degree=1, seed=seed)
        found.append(learned.mean[0])
        deviations.append(np.sqrt(np.diag(learned.covariance[0])))
    ratio = np.std(found, axis=0, ddof=1) / np.mean(deviations, axis=0)
    assert ((ratio > 0.7) & (ratio < 1.4)).all()


def test_logs_have_the_errors_of_the_sensor():
    problem = line(0.3)
    exact, seen = collect(problem.unmeasured, 5000, 2), collect(problem, 5000, 2)
    for name in ("x", "successors"):
        errors = getattr(seen, name) - getattr(exact, name)
        assert errors.std() == pytest.approx(0.3, rel=0.03)
        assert abs(errors.mean()) < 0.02
    np.testing.assert_array_equal(exact.u, seen.u)


@pytest.mark.parametrize(
    ("problem", "settings", "words"),
    [
        (line(5.0), {"starts": 300, "degree": 3, "repetitions": 2}, "hide what is to be learned"),
        (line(0.1), {"diffusion_degree": 1}, "diffusion_degree"),
        (make_problem("DubinsDisk-v0", measurement="default"), {}, "angles"),
        (make_problem("ACC-v0", measurement="default"), {}, "does not measure x_2"),
    ],
)
def test_what_cannot_be_is_refused(problem, settings, words):
    with pytest.raises(ConfigurationError, match=words):
        identify(problem, **{"starts": 200, "repetitions": 5, **settings})
