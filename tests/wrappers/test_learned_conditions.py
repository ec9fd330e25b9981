"""Conditions that rest on something learned: their rows against brute force, with exact stand-ins, and as text."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from scipy import stats

from safe_envs import Barrier, ConfigurationError, NumericalError
from safe_envs.calculus import derivatives, drift_derivative, generator, input_derivative
from safe_envs.codegen import compile_function, filled, stacked
from safe_envs.errors import RelativeDegreeError
from tests.conftest import problem_of
from wrappers import (
    DDSCBF,
    HOCBF,
    SCBF,
    SRCBF,
    BayesianSCBF,
    LearnedHOCBF,
    SafetyFilter,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    parse_condition,
    parse_conditions,
)
from wrappers.formulas import Formulas
from wrappers.learning.base import Record
from wrappers.learning.bayesian import identify
from wrappers.learning.collect import draw_states
from wrappers.learning.files import LearnedFileError, Signature
from wrappers.learning.generator import GeneratorModel, LearnedGenerator, learn_generator
from wrappers.learning.network import Network
from wrappers.learning.regression import Gaussian
from wrappers.learning.residual import LearnedResidual, ResidualModel
from wrappers.proved import proved_bound
from wrappers.verify import verify

NO_RECORD = Record(0, 0.0, 0.0)


@pytest.fixture(scope="module")
def disk():
    return problem_of("safe_envs/DubinsDisk-v0")


@pytest.fixture(scope="module")
def top():
    return problem_of("safe_envs/Pendulum-v0")


@pytest.fixture(scope="module")
def gap():
    return problem_of("safe_envs/ACCGap-v0")


@pytest.fixture(scope="module")
def cubic():
    return problem_of("safe_envs/CubicSDEDisk-v0")


@pytest.fixture(scope="module")
def rotors():
    return problem_of("safe_envs/Quadrotor-v0")


def some_network(rng, inputs, outputs, activation):
    """As training might have left it; none of these tests asks what it is good for."""
    weights, biases = (rng.normal(size=(12, inputs)), rng.normal(size=(outputs, 12)) / 12), (rng.normal(size=12), rng.normal(size=outputs))
    return Network(weights, biases, activation, np.zeros(inputs), np.ones(inputs), np.zeros(outputs), np.full(outputs, 0.3))


@pytest.fixture(scope="module")
def residual(disk):
    rng, coordinates = np.random.default_rng(0), disk.exploration.coordinates
    network, heldout = some_network(rng, len(coordinates), 3, "relu"), abs(rng.normal(size=(40, 3))) * 0.05
    return ResidualModel(Signature.of(disk), NO_RECORD, (LearnedResidual(disk.plant.states, coordinates, 2, network, heldout),))


@pytest.fixture(scope="module")
def network(top):
    coordinates = top.exploration.coordinates
    network = some_network(np.random.default_rng(1), len(coordinates), 1, "tanh")
    return GeneratorModel(Signature.of(top), NO_RECORD, (LearnedGenerator(top.plant.states, coordinates, (network,)),))


@pytest.fixture(scope="module")
def diffusion(gap):
    return learn_generator(gap, points=100, repetitions=100)


@pytest.fixture(scope="module")
def posterior(cubic):
    return identify(cubic, starts=300, repetitions=20)


@pytest.fixture(scope="module")
def gap_posterior(gap):
    return identify(gap, starts=300, repetitions=20)


class Terms:
    """Given functions in the place of a network."""

    def __init__(self, system, degree, expressions, errors=()):
        numbers = [system.numeric(e) for e in expressions]
        self.symbols = tuple(sp.Dummy(f"term_{i}", real=True) for i in range(len(numbers)))
        self.degree, self.errors = degree, np.array(errors)
        self._floats = compile_function(system.states, numbers, "floats")
        self._arrays = compile_function(system.states, numbers, "arrays")

    def floats(self, x):
        return self._floats(*x)

    def arrays(self, x):
        return tuple(filled(c, x[0].shape) for c in self._arrays(*x))

    def eps(self, _):
        return self.errors


class Undefined(Terms):
    """Has no value of one of its terms where the first state is above a limit."""

    def __init__(self, of, which, limit):
        vars(self).update(vars(of))
        self._which, self._limit = which, limit

    def floats(self, x):
        return [math.nan if i == self._which and x[0] > self._limit else v for i, v in enumerate(super().floats(x))]

    def arrays(self, x):
        return tuple(np.where((i == self._which) & (x[0] > self._limit), np.nan, v) for i, v in enumerate(super().arrays(x)))


def lie(system, barrier, degree):
    """L_f h, ..., L_f^r h and the entries of L_g L_f^(r-1) h, with the numbers of the system."""
    along = derivatives(system, barrier.expression, degree, drift_derivative)
    return [system.numeric(e) for e in (*along[1:], *input_derivative(system, along[degree - 1]))]


def residual_of(problem, errors=()) -> Any:
    """The exact residuals."""
    parts = []
    for i, barrier in enumerate(problem.barriers):
        r = len(problem.gains_of(i))
        truth, believed = (lie(system, barrier, r) for system in (problem.plant, problem.model))
        parts.append(Terms(problem.plant, r, [p - m for p, m in zip(truth, believed, strict=True)], errors))
    return ResidualModel(Signature.of(problem), NO_RECORD, tuple(parts))


def generator_of(problem, degree) -> Any:
    """The exact part of the noise, and of the order below its slopes."""
    plant, h = problem.plant, problem.barriers[0].expression
    noisy, plain = (derivatives(plant, h, degree, d) for d in (generator, drift_derivative))
    parts = [a - b for a, b in zip(noisy, plain, strict=True)]
    slopes = [sp.diff(parts[-2], s) for s in plant.states] if degree > 1 else []
    return GeneratorModel(Signature.of(problem), NO_RECORD, (Terms(plant, degree, [parts[-1], *slopes]),))  # pyright: ignore[reportArgumentType]


def values(system, expressions, x):
    compiled = compile_function(system.states, [system.numeric(e) for e in expressions], "arrays")
    return stacked(compiled(*np.ascontiguousarray(x.T)), len(x))


def situations(problem, count, seed=0):
    """States where the problem is explored, and inputs from a box twice as wide as its own."""
    rng = np.random.default_rng(seed)
    low, high = np.array(problem.box).T
    return draw_states(problem, count, rng), rng.uniform(1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low, (count, len(low)))


def assert_same_decisions(problem, one, other, count=200, tolerance=1e-9):
    """In both flavours; relative to the box, and to what the margins reach."""
    x, u = situations(problem, count)
    width = np.ptp(problem.box, axis=1)
    mine, theirs = one.filter(x, u), other.filter(x, u)
    assert (mine.action != u).any()
    assert (abs(mine.action - theirs.action) <= tolerance * width).all()
    assert (abs(mine.margin - theirs.margin) <= tolerance * (1.0 + abs(theirs.margin).max())).all()
    assert (mine.feasible == theirs.feasible).all()
    for i in range(20):
        single = one.filter(x[i], u[i])
        assert (abs(single.action - theirs.action[i]) <= tolerance * width).all()
        assert single.feasible == theirs.feasible[i]


# Bayesian


@pytest.mark.parametrize("name", ["cubic", "gap"])
def test_the_most_probable_system_is_filtered_as_if_it_were_known(request, name):
    problem = request.getfixturevalue(name)
    learned = request.getfixturevalue("posterior" if name == "cubic" else "gap_posterior")
    for margin in ("none", 0.02) if name == "cubic" else ("none",):
        ours = SafetyFilter.for_problem(problem, BayesianSCBF(learned, sampling_margin=margin))
        known = SafetyFilter(learned.system, [(problem.barriers[0], SCBF(sampling_margin=margin))], problem.box)
        assert_same_decisions(problem, ours, known, tolerance=1e-12)
    if name == "cubic":
        ours = SafetyFilter.for_problem(problem, BayesianSCBF(learned, sampling_margin="first-order"))
        known = SafetyFilter(learned.system, [(problem.barriers[0], SCBF(sampling_margin="first-order"))], problem.box, dt=problem.dt)
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
    return values(learned.system, [sp.diff(barrier.expression, s) for s in learned.system.states], x)


def curvatures_of(learned, barrier, x):
    return values(learned.system, [sp.diff(barrier.expression, s, 2) for s in learned.system.states], x)


def robust_row(learned, law, barrier, x, u, z):
    """mean - deviation of L_f h + L_g h u, that of each state times z, for weights of a Gaussian law."""
    design, slopes = linear_form(learned, x, u), slopes_of(learned, barrier, x)
    mean = (slopes * (design @ law.mean.T)).sum(axis=1)
    spread = np.stack([((design @ c) * design).sum(axis=1) for c in law.covariance], axis=1)
    return mean - np.sqrt((slopes**2 * spread * np.square(z)).sum(axis=1))


def least_ito(learned, barrier, x, intervals):
    """The least of 1/2 sum_i sigma_i^2 d^2 h/dx_i^2 over the corners of the intervals."""
    curvatures = curvatures_of(learned, barrier, x)
    return np.min([0.5 * curvatures @ np.square(corner) for corner in itertools.product(*intervals)], axis=0)


@pytest.mark.parametrize("which", ["disk", "curved"])
def test_the_robust_row_is_mean_less_deviations(cubic, posterior, which):
    problem = cubic if which == "disk" else replace(cubic, barriers=(curved_barrier(cubic),))
    barrier, (x, u) = problem.barriers[0], situations(problem, 700)
    law, noise = Gaussian(posterior.mean, posterior.covariance), posterior.diffusion
    all_sure = math.sqrt(stats.chi2.ppf(0.95, 2 * posterior.mean.shape[1]))
    intervals, fixed = posterior.diffusion.sigma_intervals(0.05), np.column_stack([posterior.diffusion.sigma] * 2)
    assert (intervals[:, 0] < fixed[:, 0]).all()
    assert (intervals[:, 1] > fixed[:, 1]).all()
    # The weights are as unsure as the noise is large, which may be as large as its interval allows.
    widest = intervals[:, 1] / np.sqrt(noise.squares / noise.count)
    cases = [
        (BayesianSCBF(posterior, confidence=0.97), stats.t.ppf(0.97, noise.count), fixed),
        (BayesianSCBF(posterior, simultaneous=0.9, sampling_margin=0.1), all_sure * widest, intervals),
        (BayesianSCBF(posterior, simultaneous=0.9), all_sure * widest, intervals),
        (BayesianSCBF(posterior, confidence=0.3), 0.0, fixed),
    ]
    for condition, z, levels in cases if which == "disk" else cases[:2]:
        found = SafetyFilter.for_problem(problem, condition).filter(x, u)
        rest = least_ito(posterior, barrier, x, levels) - (0.1 if condition.sampling_margin == 0.1 else 0.0)
        expected = robust_row(posterior, law, barrier, x, found.action, z) + rest
        # The variance is a polynomial whose coefficients cancel by some digits, and its root is known to half of the rest.
        np.testing.assert_allclose(found.margin[:, 0], expected, atol=1e-6)
        assert found.feasible.any()
        assert found.active.any()
        for tried in np.linspace(*problem.box[0], 21):
            row = robust_row(posterior, law, barrier, x, np.full_like(u, tried), z) + rest
            # Nothing in the box meets or misses it by less where it cannot be met, or is met and nearer where it can.
            assert (row <= found.margin[:, 0] + 1e-6)[~found.feasible].all()
            nearer = abs(tried - u[:, 0]) < abs(found.action - u)[:, 0] - 1e-6
            assert (row <= 1e-6)[nearer & found.feasible].all()


def test_mean_and_deviation_are_those_of_draws_of_the_weights(cubic, posterior):
    rng, (x, u) = np.random.default_rng(4), situations(cubic, 1000, seed=8)
    barrier, draws = curved_barrier(cubic), 2000
    design, slopes, v = linear_form(posterior, x, u), slopes_of(posterior, barrier, x), u[:, 0]
    weights = np.stack([rng.multivariate_normal(m, c, draws) for m, c in zip(posterior.mean, posterior.covariance, strict=True)])
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
    np.testing.assert_allclose(np.sqrt(q_0 + 2 * q_1 * v + q_2 * v * v), expected, rtol=0.02 + 5 / math.sqrt(2 * draws))


def test_the_simultaneous_form_holds_for_its_share_of_the_weights(cubic, posterior):
    """At all states and inputs at once: so for draws of the weights and levels, at those where the row is met."""
    rng, (x, u) = np.random.default_rng(5), situations(cubic, 400, seed=9)
    barrier = cubic.barriers[0]
    condition = BayesianSCBF(posterior, simultaneous=0.5)
    found = SafetyFilter.for_problem(cubic, condition).filter(x, u)
    design = linear_form(posterior, x, found.action)
    slopes, curvatures = slopes_of(posterior, barrier, x), curvatures_of(posterior, barrier, x)
    below, times = 0, 100
    for _ in range(times):
        weights = np.array([rng.multivariate_normal(m, c) for m, c in zip(posterior.mean, posterior.covariance, strict=True)])
        levels = posterior.diffusion._levels(rng)
        truth = (slopes * (design @ weights.T)).sum(axis=1) + 0.5 * curvatures @ levels**2
        below += bool((truth < found.margin[:, 0]).any())
    assert below <= 0.5 * times
    both, one = np.array([True, True]), np.array([True, False])
    assert (condition.variance_factors(both) < BayesianSCBF(posterior, simultaneous=0.99).variance_factors(both)).all()
    assert (condition.variance_factors(one) < condition.variance_factors(both)).all()
    assert (condition.delta_theta, condition.delta_sigma) == (0.25, 0.25)


def test_the_robust_form_is_for_relative_degree_one(cubic, gap, posterior, gap_posterior):
    for how in ({"confidence": 0.9}, {"simultaneous": 0.9}):
        with pytest.raises(RelativeDegreeError, match=r"relative degree 2.*Leave out confidence"):
            SafetyFilter.for_problem(gap, BayesianSCBF(gap_posterior, **how))
        with pytest.raises(ConfigurationError, match="first order"):
            SafetyFilter.for_problem(cubic, BayesianSCBF(posterior, sampling_margin="first-order", **how))
    with pytest.raises(ConfigurationError, match="not both"):
        BayesianSCBF(posterior, confidence=0.9, simultaneous=0.9)
    for value in (0.0, 1.0, -0.1, math.nan, True, "much"):
        for name in ("confidence", "simultaneous"):
            with pytest.raises(ConfigurationError, match=f"{name} = "):
                BayesianSCBF(posterior, **{name: value})


# Residuals


@pytest.mark.parametrize("name", ["DubinsDisk", "DubinsObstacle", "QuadrotorAltitude", "Quadrotor"])
def test_exact_residuals_make_the_filter_of_the_plant(name):
    problem = problem_of(f"safe_envs/{name}-v0")
    rates = problem.gains_of(0)
    ours = SafetyFilter.for_problem(problem, LearnedHOCBF(residual_of(problem), p=rates, eps=0.0))
    assert_same_decisions(problem, ours, SafetyFilter.for_problem(problem, HOCBF(rates), "plant"))
    if name != "DubinsObstacle":
        other = SafetyFilter.for_problem(problem, HOCBF(rates))
        x, u = situations(problem, 300)
        assert (abs(ours.filter(x, u).action - other.filter(x, u).action) > 1e-3 * np.ptp(problem.box, axis=1)).any()


def worst_row(problem, x, u, errors):
    """The least of h^(r) + ... + k_0 h under an input over the corners of the errors of exact residuals."""
    r, (p_1, p_2) = 2, problem.gains_of(0)
    h = values(problem.plant, [problem.barriers[0].expression], x)[:, 0]
    first, second, *gains = values(problem.plant, lie(problem.plant, problem.barriers[0], r), x).T
    rows = []
    for e_1, e_2, *e_u in itertools.product(*[(-e, e) for e in errors]):
        highest = second + e_2 + sum((g + e) * u[:, j] for j, (g, e) in enumerate(zip(gains, e_u, strict=True)))
        rows.append(highest + (p_1 + p_2) * (first + e_1) + p_1 * p_2 * h)
    return np.min(rows, axis=0)


def test_the_margin_is_what_the_errors_can_do_to_one_input(disk):
    x, u = situations(disk, 2000)
    for errors, eps in (([0.1, 0.3, 0.5], None), ([0.2, 0.2, 0.2], 0.2)):
        condition = LearnedHOCBF(residual_of(disk, errors), p=disk.gains_of(0), eps=eps)
        found = SafetyFilter.for_problem(disk, condition).filter(x, u)
        assert found.feasible.mean() > 0.1
        # For one input nothing is given away.
        np.testing.assert_allclose(found.margin[:, 0], worst_row(disk, x, found.action, errors), atol=1e-10)
        assert found.margin[found.feasible].min() >= -1e-10
        assert (found.active[:, 0] & found.feasible).any()


def test_the_margin_covers_what_the_errors_can_do_to_several_inputs(rotors):
    x, u = situations(rotors, 1000)
    errors = [0.05, 0.2, 1e-6, 2e-6, 3e-6, 1e-6]
    condition = LearnedHOCBF(residual_of(rotors, errors), p=rotors.gains_of(0))
    found = SafetyFilter.for_problem(rotors, condition).filter(x, u)
    worst = worst_row(rotors, x, found.action, errors)
    size = abs(worst).max()
    assert found.feasible.mean() > 0.1
    assert (found.active[:, 0] & found.feasible).any()
    assert worst[found.feasible].min() >= -1e-12 * size
    # sqrt(m) |(e_j u_j)| is at most sqrt(m) times, and the plane above it at the far corner no more than, sum e_j |u_j|.
    reach = np.array(errors[2:]) @ np.array(rotors.box)[:, 1]
    assert (found.margin[:, 0] <= worst + 1e-12 * size).all()
    assert (found.margin[:, 0] >= worst - 2.0 * reach - 1e-12 * size).all()
    plain = SafetyFilter.for_problem(rotors, LearnedHOCBF(residual_of(rotors, errors), p=rotors.gains_of(0), eps=0.0)).filter(x, u)
    assert worst_row(rotors, x, plain.action, errors)[plain.feasible].min() < -1e-3


def test_the_level_chooses_the_quantile_of_the_held_out_errors(disk, residual):
    rows = []
    for level in (0.05, 0.95):
        condition = LearnedHOCBF(residual, p=disk.gains_of(0), level=level)
        rows.append(condition.constraint(disk.model, disk.barriers[0]))
        q: Any = rows[-1].uncertainty
        assert [float(e) for e in q] == pytest.approx([0.0, 0.0, residual.parts[0].eps(level)[2] ** 2])
    p_1, p_2 = disk.gains_of(0)
    low, high = (residual.parts[0].eps(level) for level in (0.05, 0.95))
    assert float(rows[0].offset - rows[1].offset) == pytest.approx((p_1 + p_2) * (high - low)[0] + (high - low)[1])
    exact = LearnedHOCBF(residual, p=disk.gains_of(0), eps=0.0).constraint(disk.model, disk.barriers[0])
    assert exact.uncertainty is None


def test_what_does_not_suit_the_residuals_is_refused(disk, residual):
    with pytest.raises(ConfigurationError, match="first order"):
        SafetyFilter.for_problem(disk, LearnedHOCBF(residual, p=(1.0, 2.0), sampling_margin="first-order"))
    for rates in ((1.0,), (1.0, 2.0, 3.0)):
        with pytest.raises(RelativeDegreeError, match=f"relative degree 2.*{len(rates)} given"):
            SafetyFilter.for_problem(disk, LearnedHOCBF(residual, p=rates))
    other = replace(disk, barriers=(Barrier(disk.barriers[0].expression - 1, "smaller"),))
    with pytest.raises(ConfigurationError, match=r"learned for the barriers.*smaller"):
        SafetyFilter.for_problem(other, LearnedHOCBF(residual, p=(1.0, 2.0)))
    for settings in (
        {"eps": -0.1},
        {"eps": math.nan},
        {"eps": math.inf},
        {"eps": True},
        {"level": 0.0},
        {"level": 1.0},
        {"p": (1.0, -2.0)},
    ):
        with pytest.raises(ConfigurationError, match=next(iter(settings))):
            LearnedHOCBF(residual, **{"p": (1.0, 2.0), **settings})


# Generators


@pytest.mark.parametrize(("name", "degree"), [("top", 1), ("gap", 2)])
def test_exact_generators_make_the_filter_of_the_known_noise(request, name, degree):
    problem = request.getfixturevalue(name)
    ours, known = DDSCBF(generator_of(problem, degree)), SCBF()
    assert_same_decisions(problem, SafetyFilter.for_problem(problem, ours), SafetyFilter.for_problem(problem, known, "plant"))
    size = abs(values(problem.plant, [problem.barriers[0].expression], situations(problem, 300)[0])).max()
    for more in ({"margin": 0.01 * size}, {"sampling_margin": 0.01 * size}, {"margin": 0.004 * size, "sampling_margin": 0.006 * size}):
        stricter = SafetyFilter.for_problem(problem, replace(ours, **more))
        known = SafetyFilter.for_problem(problem, SCBF(sampling_margin=0.01 * size), "plant")
        assert_same_decisions(problem, stricter, known)


@pytest.mark.parametrize("margin", [0.0, 0.5])
def test_the_direct_way_is_the_learned_noise(gap, diffusion, margin):
    found = diffusion.diffusion.system(gap.model)
    for sampled in (margin, "first-order") if margin == 0.0 else (margin,):
        ours = DDSCBF(diffusion, sampling_margin=sampled) if sampled == "first-order" else DDSCBF(diffusion, margin=margin)
        known = SafetyFilter(found, [(gap.barriers[0], SCBF(sampling_margin=sampled))], gap.box, dt=gap.dt)
        assert_same_decisions(gap, SafetyFilter.for_problem(gap, ours), known, tolerance=1e-12)


@pytest.mark.parametrize(
    ("name", "way", "change"), [("top", "network", {"sigma": 0.0}), ("gap", "diffusion", {"sigma_1": 0.0, "sigma_2": 3.0})]
)
def test_what_the_model_says_of_the_noise_does_not_matter(request, tmp_path, name, way, change):
    problem, learned = request.getfixturevalue(name), request.getfixturevalue(way)
    other = problem.configured(model=change)
    learned.save(tmp_path / "file")
    (read,) = parse_conditions(f"ddscbf:file={tmp_path / 'file'}", other)
    expected = SafetyFilter.for_problem(problem, DDSCBF(learned))
    # Arrays and floats add in another order.
    assert_same_decisions(problem, SafetyFilter.for_problem(other, read), expected, tolerance=1e-14)


def test_what_does_not_suit_the_generators_is_refused(top, network):
    with pytest.raises(ConfigurationError, match="first order"):
        SafetyFilter.for_problem(top, DDSCBF(network, sampling_margin="first-order"))
    other = replace(top, barriers=(Barrier(top.barriers[0].expression - 0.1, "smaller"),))
    with pytest.raises(ConfigurationError, match=r"learned for the barriers.*smaller"):
        SafetyFilter.for_problem(other, DDSCBF(network))
    for margin in (-1.0, math.nan, True):
        with pytest.raises(ConfigurationError, match="margin = "):
            DDSCBF(network, margin=margin)


# Rows with terms


def with_two_barriers(disk):
    """And another disk beside it."""
    x, y, _ = disk.plant.states
    barriers = (disk.barriers[0], Barrier(4 - (x - 1) ** 2 - y**2, "other"))
    return replace(disk, barriers=barriers, gains=((1.0, 2.0), (3.0, 1.0)))


def assert_floats_are_arrays(safety_filter, x, u, tolerance=1e-9):
    batch = safety_filter.filter(x, u)
    for i in range(len(x)):
        single = safety_filter.filter(x[i], u[i])
        for ours, theirs in zip(single, batch, strict=True):
            np.testing.assert_allclose(ours, theirs[i], rtol=tolerance, atol=tolerance)
    return batch


@pytest.mark.parametrize("errors", [[0.0] * 3, [0.05, 0.1, 0.2]])
def test_a_learned_row_stands_beside_a_plain_one(disk, errors):
    both = with_two_barriers(disk)
    learned, plain = LearnedHOCBF(residual_of(both, errors), p=both.gains_of(0)), HOCBF(both.gains_of(1))
    x, u = situations(both, 40)
    for conditions in (
        (learned, plain),
        (learned, replace(plain, sampling_margin="first-order")),
        (learned, replace(learned, p=(3.0, 1.0))),
    ):
        found = assert_floats_are_arrays(SafetyFilter.for_problem(both, conditions), x, u)
        assert found.active.any(axis=0).all()
        one = replace(both, barriers=both.barriers[:1], gains=both.gains_of(0))
        np.testing.assert_allclose(found.margin[:, 0], worst_row(one, x, found.action, errors), atol=1e-10)
        if conditions[1] is plain:
            row = plain.constraint(both.model, both.barriers[1])
            a, b = values(both.model, [*row.coefficient, row.offset], x).T
            np.testing.assert_allclose(found.margin[:, 1], a * found.action[:, 0] + b, atol=1e-10)
        if conditions[1].name == "learned-hocbf":
            two = replace(both, barriers=both.barriers[1:], gains=both.gains_of(1))
            np.testing.assert_allclose(found.margin[:, 1], worst_row(two, x, found.action, errors), atol=1e-10)
    if not any(errors):
        known = SafetyFilter.for_problem(both, [HOCBF(both.gains_of(i)) for i in (0, 1)], "plant")
        ours = [replace(learned, p=both.gains_of(i)) for i in (0, 1)]
        assert_same_decisions(both, SafetyFilter.for_problem(both, ours), known)


@pytest.mark.parametrize("name", ["network", "posterior"])
def test_learned_rows_stand_beside_reciprocal_ones(request, top, cubic, name):
    model = request.getfixturevalue(name)
    problem, learned = (top, DDSCBF(model)) if name == "network" else (cubic, BayesianSCBF(model, confidence=0.9))
    first = problem.barriers[0]
    second = Barrier(1.2 * first.expression - 0.1, "second")
    both, turned = (replace(problem, barriers=pair) for pair in ((first, second), (second, first)))
    rng = np.random.default_rng(0)
    x, u = rng.uniform(*np.array(problem.exploration.region).T, (25, 2)), rng.uniform(-9, 9, (25, 1))  # on both sides of the edge
    alone = SafetyFilter.for_problem(problem, learned).filter(x, u)
    for other in (SRCBF(), SRCBF(sampling_margin="first-order")):
        found = assert_floats_are_arrays(SafetyFilter.for_problem(both, (learned, other)), x, u, 1e-8)
        free = ~found.active[:, 1]
        assert 0 < np.count_nonzero(free) < 25
        np.testing.assert_allclose(found.action[free], alone.action[free], atol=1e-9)
        swapped = SafetyFilter.for_problem(turned, (other, learned)).filter(x, u)
        np.testing.assert_allclose(swapped.action, found.action, atol=1e-9)


def test_a_goal_stands_beside_a_learned_row():
    problem = problem_of("safe_envs/ACCGap-v0")
    ours = SafetyFilter.for_problem(problem, DDSCBF(generator_of(problem, 2)), objective="clf")
    assert_same_decisions(problem, ours, SafetyFilter.for_problem(problem, SCBF(), objective="clf"), tolerance=1e-6)


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("eps", [0.0, 0.1])
def test_a_network_without_a_value_is_told_with_the_state(disk, which, eps):
    exact = residual_of(disk)
    undefined = replace(exact, parts=(Undefined(exact.parts[0], which, 0.4),))
    safety_filter = SafetyFilter.for_problem(disk, LearnedHOCBF(undefined, p=(1.0, 2.0), eps=eps))
    x, u = np.array([[0.3, 0.1, 0.2], [0.41, 0.1, 0.2], [0.2, 0.1, 0.2]]), np.zeros((3, 1))
    for state in (x[0], x[2]):
        assert np.isfinite(safety_filter.filter(state, u[0]).action).all()
    for states, inputs in ((x, u), (x[1], u[1])):
        with pytest.raises(NumericalError, match=r"h has no finite value at x = 0\.41, y = 0\.1, theta = 0\.2"):
            safety_filter.filter(states, inputs)


def test_a_generator_without_a_value_is_told_with_the_state(gap):
    exact = generator_of(gap, 2)
    for which in range(3):
        undefined = replace(exact, generators=(Undefined(exact.generators[0], which, 20.0),))
        safety_filter = SafetyFilter.for_problem(gap, DDSCBF(undefined))
        x, u = np.array([[19.0, 20.0], [21.0, 22.0]]), np.zeros((2, 1))
        for states, inputs in ((x, u), (x[1], u[1])):
            # What is multiplied by 0 does not go in.
            if which < 2:
                with pytest.raises(NumericalError, match=r"v = 21, z = 22"):
                    safety_filter.filter(states, inputs)
            else:
                assert np.isfinite(safety_filter.filter(states, inputs).action).all()


# Text


@pytest.fixture(params=["residual", "network", "diffusion", "most probable", "confident", "simultaneous"])
def kept(request, tmp_path):
    """A problem, a condition, and the text of the same condition with a file."""
    path = tmp_path / "learned model.npz"

    def of(name):
        return request.getfixturevalue(name)

    problem, learned, make, text = {
        "residual": lambda: (
            of("disk"),
            of("residual"),
            lambda m: LearnedHOCBF(m, p=(1.0, 2.0), eps=0.0),
            "learned-hocbf:file={}:p=1,2:eps=0",
        ),
        "network": lambda: (of("top"), of("network"), lambda m: DDSCBF(m, margin=0.02), "ddscbf:margin=0.02:file={}"),
        "diffusion": lambda: (of("gap"), of("diffusion"), DDSCBF, "ddscbf:file={}"),
        "most probable": lambda: (of("gap"), of("gap_posterior"), BayesianSCBF, "bayesian-scbf:file={}"),
        "confident": lambda: (
            of("cubic"),
            of("posterior"),
            lambda m: BayesianSCBF(m, confidence=0.8),
            "bayesian-scbf:confidence=0.8:file={}",
        ),
        "simultaneous": lambda: (
            *(of("cubic"), of("posterior")),
            *(lambda m: BayesianSCBF(m, simultaneous=0.9), "bayesian-scbf:file={}:simultaneous=0.9"),
        ),
    }[request.param]()
    learned.save(path)
    return problem, make(learned), text.format(path)


def test_a_condition_from_a_file_is_the_one_from_memory_to_the_last_bit(kept):
    problem, condition, text = kept
    (read,) = parse_conditions(text, problem)
    assert type(read) is type(condition)
    assert read.learned.sha256 == condition.learned.sha256
    x, u = situations(problem, 100)
    one, other = (SafetyFilter.for_problem(problem, c) for c in (condition, read))
    for states, inputs in ((x, u), (x[0], u[0]), (x[1], u[1])):
        for mine, theirs in zip(one.filter(states, inputs), other.filter(states, inputs), strict=True):
            assert np.array_equal(mine, theirs)
    (again,) = parse_conditions(read.spec, problem)
    assert again.spec == read.spec
    assert again.parameters == read.parameters
    assert "file=" in read.spec


def test_a_condition_from_memory_is_named_by_its_checksum_which_cannot_be_read(kept):
    problem, condition, _ = kept
    assert f"sha256={condition.learned.sha256[:12]}" in condition.spec
    with pytest.raises(ConfigurationError, match=r"sha256.*file"):
        parse_conditions(condition.spec, problem)
    with pytest.raises(ConfigurationError, match=f"{condition.name}.*learned.*identify.*file=FILE"):
        parse_conditions(condition.name, problem)
    with pytest.raises(ConfigurationError, match="file=FILE"):
        parse_condition(condition.name, (1.0, 2.0))
    (given,) = parse_conditions(condition.name, problem, {condition.method: condition.learned})
    assert given.learned is condition.learned


def test_the_rates_of_a_problem_are_taken_where_none_are_given(disk, residual):
    (condition,) = parse_conditions("learned-hocbf:eps=0.1:level=0.5", disk, {"learned-hocbf": residual})
    assert (condition.p, condition.eps, condition.level) == (disk.gains_of(0), 0.1, 0.5)


def test_what_a_learned_condition_cannot_take_is_refused(disk, residual):
    learned = {"learned-hocbf": residual}
    for text, why in (
        ("learned-hocbf:eps=1,2", "one value"),
        ("learned-hocbf:rate=1", "no parameter 'rate'"),
        ("learned-hocbf:learned=1", "no parameter 'learned'"),
        ("learned-hocbf:eps=1:eps=2", "twice"),
        ("learned-hocbf:eps=big", "eps = 'big'"),
        ("hocbf:file=here", "no parameter 'file'"),
        ("learned-hocb", "did you mean 'learned-hocbf'"),
    ):
        with pytest.raises(ConfigurationError, match=why):
            parse_conditions(text, disk, learned)
    with pytest.raises(LearnedFileError, match="does not exist"):
        parse_conditions("learned-hocbf:file=/nowhere", disk)


def test_what_was_learned_of_another_system_is_refused(disk, top, gap, cubic, residual, network, posterior):
    believed = problem_of("safe_envs/DubinsDisk-v0", model={"v": 0.4})
    moved = replace(disk, barriers=(Barrier(disk.barriers[0].expression - 1, "smaller"),))
    for problem, condition, message in (
        (believed, LearnedHOCBF(residual, p=(1.0, 2.0)), "model"),
        (moved, LearnedHOCBF(residual, p=(1.0, 2.0)), "learned for the barriers"),
        (gap, DDSCBF(network), "Pendulum"),
        (top, BayesianSCBF(posterior), "CubicSDEDisk"),
        (cubic, DDSCBF(posterior), "ddscbf learns; given is bayesian"),
        (cubic, BayesianSCBF("posterior.npz"), "bayesian learns; given is 'posterior.npz'"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            SafetyFilter.for_problem(problem, condition)


def test_what_corrects_the_model_starts_from_it_whatever_is_known(disk, residual, cubic, posterior):
    condition = LearnedHOCBF(residual, p=(1.0, 2.0))
    known = [SafetyFilter.for_problem(disk, condition, knowledge) for knowledge in ("model", "plant")]
    assert_same_decisions(disk, *known, tolerance=1e-12)
    both = replace(disk, barriers=disk.barriers * 2)
    with pytest.raises(ConfigurationError, match=r"learned-hocbf corrects the model.*knowledge='model'"):
        SafetyFilter.for_problem(both, (condition, HOCBF((1.0, 2.0))), "plant")


def test_files_of_something_else_are_refused(tmp_path, disk, top, gap, cubic, residual, network, diffusion, posterior):
    for name, learned in (("residual", residual), ("network", network), ("diffusion", diffusion), ("posterior", posterior)):
        learned.save(tmp_path / name)
    wider = problem_of("safe_envs/CubicSDEDisk-v0", barrier={"radius": 1.1})
    plain = problem_of("safe_envs/ACCGap-v0", barrier={"power": 1})
    obstacle = problem_of("safe_envs/DubinsObstacle-v0")
    for text, problem, why in (
        ("ddscbf:file={}/posterior", cubic, "holds bayesian; ddscbf is needed"),
        ("bayesian-scbf:file={}/residual", disk, "holds learned-hocbf; bayesian is needed"),
        ("learned-hocbf:file={}/network", top, "holds ddscbf; learned-hocbf is needed"),
        ("learned-hocbf:file={}/residual", obstacle, "another problem: its system"),
        ("ddscbf:file={}/network", gap, "another problem: its system"),
        ("bayesian-scbf:file={}/posterior", gap, "another problem: its system"),
        ("learned-hocbf:file={}/residual", problem_of("safe_envs/DubinsDisk-v0", barrier={"radius": 2.0}), "its barriers"),
        ("ddscbf:file={}/network", problem_of("safe_envs/Pendulum-v0", barrier={"level": 0.1}), "its barriers"),
        ("learned-hocbf:file={}/residual", disk.configured(model={"v": 1.7}), "its model"),
        ("ddscbf:file={}/network", top.configured(model={"l": 0.6}), "its model"),
        ("ddscbf:file={}/diffusion", gap.configured(model={"M": 1500.0}), "its model"),
    ):
        with pytest.raises(LearnedFileError, match=why):
            parse_conditions(text.format(tmp_path), problem)
    # What was learned of the whole system, or of its noise, is of use for any barrier.
    for text, problem in (("bayesian-scbf:file={}/posterior", wider), ("ddscbf:file={}/diffusion", plain)):
        (condition,) = parse_conditions(text.format(tmp_path), problem)
        x, u = situations(problem, 50)
        assert np.isfinite(SafetyFilter.for_problem(problem, condition).filter(x, u).action).all()


def test_the_wrappers_take_text_and_conditions(kept):
    problem, condition, text = kept
    env_id = f"safe_envs/{problem.name}-v0"
    env, again = (SafetyFilterWrapper(gym.make(env_id), given) for given in (text, condition))
    remade = gym.make(env.spec)
    vector, other = (SafetyFilterVectorWrapper(gym.make_vec(env_id, num_envs=2), given) for given in (text, condition))
    for wrapped in (env, again, remade):
        wrapped.reset(seed=3)
    for wrapped in (vector, other):
        wrapped.reset(seed=[3, 4])
    for _ in range(5):
        results = [wrapped.step(np.ones(env.action_space.shape, dtype=np.float32)) for wrapped in (env, again, remade)]
        batches = [wrapped.step(np.ones(vector.action_space.shape, dtype=np.float32)) for wrapped in (vector, other)]
        for result in results:
            assert np.array_equal(result[4]["safe_action"], results[0][4]["safe_action"])
            assert np.array_equal(result[0], results[0][0])
        assert np.array_equal(batches[0][4]["safe_action"], batches[1][4]["safe_action"])
        np.testing.assert_allclose(batches[0][4]["safe_action"][0], results[0][4]["safe_action"], rtol=1e-9)
    with pytest.raises(ConfigurationError, match="sha256"):
        gym.make(again.spec)


def test_no_promise_is_looked_for(kept):
    problem, condition, _ = kept
    for look in (
        lambda: Formulas(problem, [condition], "model"),
        lambda: verify(problem, [condition]),
        lambda: proved_bound(problem, [condition]),
    ):
        with pytest.raises(ConfigurationError, match="rests on something learned"):
            look()
