"""Constraints of learned models: exact ones make the filter of the known system, margins cover what
errors can do, and identified systems are held against their posterior and draws from it."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy as sp
from scipy import stats

from safe_envs import Barrier, ConfigurationError, NumericalError
from safe_envs.errors import RelativeDegreeError
from safe_envs.filters.learning.models.distributions import Gaussian
from safe_envs.wrappers import (
    DDSCBF,
    HOCBF,
    SCBF,
    SRCBF,
    BayesianSCBF,
    LearnedHOCBF,
    SafetyFilter,
    parse_conditions,
)
from tests.conftest import problem_of
from tests.wrappers.learned import (
    Undefined,
    assert_floats_are_arrays,
    assert_same_decisions,
    generator_of,
    residual_of,
    situations,
    values,
    worst_row,
)

pytestmark = pytest.mark.slow


def smaller(problem):
    """With a barrier that nothing was learned for."""
    barrier = problem.barriers[0]
    return replace(problem, barriers=(Barrier(barrier.expression - 0.1, "smaller"),))


EARLY, RATES = {"sampling_margin": "first-order"}, {"alpha": (1.0, 2.0)}
LEVELS = ("confidence", "simultaneous")
RESIDUAL, NETWORK = ("disk", "residual", LearnedHOCBF), ("top", "network", DDSCBF)
CUBIC, GAP = ("cubic", "posterior", BayesianSCBF), ("gap", "gap_posterior", BayesianSCBF)
UNFIT = [
    (RESIDUAL, {**RATES, **EARLY}, "first order"),
    (NETWORK, EARLY, "first order"),
    *[(RESIDUAL, {"alpha": p}, f"{len(p)} given") for p in ((1.0,), (1.0, 2.0, 3.0))],
    *[(RESIDUAL, {**RATES, "eps": e}, "eps") for e in (-0.1, math.nan, math.inf, True)],
    *[(RESIDUAL, {**RATES, "level": level}, "level") for level in (0.0, 1.0)],
    (RESIDUAL, {"alpha": (1.0, -2.0)}, "alpha"),
    *[(NETWORK, {"margin": s}, "margin = ") for s in (-1.0, math.nan, True)],
    *[(GAP, {name: 0.9}, "confidence") for name in LEVELS],
    *[(CUBIC, {name: 0.9, **EARLY}, "first order") for name in LEVELS],
    (CUBIC, {"confidence": 0.9, "simultaneous": 0.9}, "both"),
    *[
        (CUBIC, {name: value}, f"{name} = ")
        for value in (0.0, 1.0, -0.1, math.nan, True, "much")
        for name in LEVELS
    ],
]


@pytest.mark.parametrize(("where", "arguments", "fragment"), UNFIT)
def test_what_does_not_suit_a_learned_model_is_refused(where, arguments, fragment, request):
    problem, learned = (request.getfixturevalue(name) for name in where[:2])
    of_degree = "given" in fragment or where is GAP
    with pytest.raises(RelativeDegreeError if of_degree else ConfigurationError, match=fragment):
        SafetyFilter.for_problem(problem, where[2](learned, **arguments))


def test_barriers_that_nothing_was_learned_for_are_refused(disk, residual, top, network):
    for problem, condition in (
        (disk, LearnedHOCBF(residual, alpha=(1.0, 2.0))),
        (top, DDSCBF(network)),
    ):
        with pytest.raises(ConfigurationError, match="smaller"):
            SafetyFilter.for_problem(smaller(problem), condition)


# Residuals


@pytest.mark.parametrize(
    "name",
    [
        "DubinsDisk",
        "QuadrotorAltitude",
        pytest.param("DubinsObstacle", marks=pytest.mark.oracle),
        pytest.param("Quadrotor", marks=pytest.mark.oracle),
    ],
)
def test_exact_residuals_make_the_filter_of_the_plant(name):
    problem = problem_of(f"safe_envs/{name}-v0")
    rates = problem.gains_of(0)
    ours = SafetyFilter.for_problem(
        problem, LearnedHOCBF(residual_of(problem), alpha=rates, eps=0.0)
    )
    assert_same_decisions(problem, ours, SafetyFilter.for_problem(problem, HOCBF(rates), "plant"))
    if name != "DubinsObstacle":
        other = SafetyFilter.for_problem(problem, HOCBF(rates))
        x, u = situations(problem, 300)
        assert (
            abs(ours.filter(x, u).action - other.filter(x, u).action)
            > 1e-3 * np.ptp(problem.input_bounds, axis=1)
        ).any()


def test_the_margin_is_what_the_errors_can_do_to_one_input(disk):
    x, u = situations(disk, 2000)
    for errors, eps in (([0.1, 0.3, 0.5], None), ([0.2, 0.2, 0.2], 0.2)):
        condition = LearnedHOCBF(residual_of(disk, errors), alpha=disk.gains_of(0), eps=eps)
        found = SafetyFilter.for_problem(disk, condition).filter(x, u)
        assert found.feasible.mean() > 0.1
        # For one input nothing is given away.
        np.testing.assert_allclose(
            found.margin[:, 0], worst_row(disk, x, found.action, errors), atol=1e-10
        )
        assert found.margin[found.feasible].min() >= -1e-10
        assert (found.active[:, 0] & found.feasible).any()


def test_the_margin_covers_what_the_errors_can_do_to_several_inputs(rotors):
    x, u = situations(rotors, 1000)
    errors = [0.05, 0.2, 1e-6, 2e-6, 3e-6, 1e-6]
    condition = LearnedHOCBF(residual_of(rotors, errors), alpha=rotors.gains_of(0))
    found = SafetyFilter.for_problem(rotors, condition).filter(x, u)
    worst = worst_row(rotors, x, found.action, errors)
    size = abs(worst).max()
    assert found.feasible.mean() > 0.1
    assert (found.active[:, 0] & found.feasible).any()
    assert worst[found.feasible].min() >= -1e-12 * size
    # sqrt(m) |(e_j u_j)| is at most sqrt(m) times, and the plane above it at the far corner no more
    # than, sum e_j |u_j|.
    reach = np.array(errors[2:]) @ np.array(rotors.input_bounds)[:, 1]
    assert (found.margin[:, 0] <= worst + 1e-12 * size).all()
    assert (found.margin[:, 0] >= worst - 2.0 * reach - 1e-12 * size).all()
    plain = SafetyFilter.for_problem(
        rotors, LearnedHOCBF(residual_of(rotors, errors), alpha=rotors.gains_of(0), eps=0.0)
    ).filter(x, u)
    assert worst_row(rotors, x, plain.action, errors)[plain.feasible].min() < -1e-3


def test_the_level_chooses_the_quantile_of_the_held_out_errors(disk, residual):
    rows = []
    for level in (0.05, 0.95):
        condition = LearnedHOCBF(residual, alpha=disk.gains_of(0), level=level)
        rows.append(condition.constraint(disk.model, disk.barriers[0]))
        q: Any = rows[-1].uncertainty
        assert [float(e) for e in q] == pytest.approx(
            [0.0, 0.0, residual.parts[0].eps(level)[2] ** 2]
        )
    p_1, p_2 = disk.gains_of(0)
    low, high = (residual.parts[0].eps(level) for level in (0.05, 0.95))
    assert float(rows[0].offset - rows[1].offset) == pytest.approx(
        (p_1 + p_2) * (high - low)[0] + (high - low)[1]
    )
    exact = LearnedHOCBF(residual, alpha=disk.gains_of(0), eps=0.0).constraint(
        disk.model, disk.barriers[0]
    )
    assert exact.uncertainty is None


# Generators


@pytest.mark.parametrize(("name", "degree"), [("top", 1), ("gap", 2)])
def test_exact_generators_make_the_filter_of_the_known_noise(request, name, degree):
    problem = request.getfixturevalue(name)
    ours, known = DDSCBF(generator_of(problem, degree)), SCBF()
    assert_same_decisions(
        problem,
        SafetyFilter.for_problem(problem, ours),
        SafetyFilter.for_problem(problem, known, "plant"),
    )
    size = abs(
        values(problem.plant, [problem.barriers[0].expression], situations(problem, 300)[0])
    ).max()
    for more in (
        {"margin": 0.01 * size},
        {"sampling_margin": 0.01 * size},
        {"margin": 0.004 * size, "sampling_margin": 0.006 * size},
    ):
        stricter = SafetyFilter.for_problem(problem, replace(ours, **more))
        known = SafetyFilter.for_problem(problem, SCBF(sampling_margin=0.01 * size), "plant")
        assert_same_decisions(problem, stricter, known)


@pytest.mark.parametrize("given", [{}, {"margin": 0.5}, {"sampling_margin": "first-order"}])
def test_the_direct_way_is_the_learned_noise(gap, diffusion, given):
    margin = given.get("margin", given.get("sampling_margin", 0.0))
    rows = [(gap.barriers[0], SCBF(sampling_margin=margin))]
    known = SafetyFilter(
        diffusion.diffusion.system(gap.model), rows, input_bounds=gap.input_bounds, dt=gap.dt
    )
    ours = SafetyFilter.for_problem(gap, DDSCBF(diffusion, **given))
    assert_same_decisions(gap, ours, known, tolerance=1e-12)


@pytest.mark.parametrize(
    ("name", "way", "change"),
    [("top", "network", {"sigma": 0.0}), ("gap", "diffusion", {"sigma_1": 0.0, "sigma_2": 3.0})],
)
def test_what_the_model_says_of_the_noise_does_not_matter(request, tmp_path, name, way, change):
    problem, learned = request.getfixturevalue(name), request.getfixturevalue(way)
    other = problem.configured(model=change)
    learned.save(tmp_path / "file")
    (read,) = parse_conditions(f"ddscbf:file={tmp_path / 'file'}", other)
    expected = SafetyFilter.for_problem(problem, DDSCBF(learned))
    # Arrays and floats add in another order.
    assert_same_decisions(problem, SafetyFilter.for_problem(other, read), expected, tolerance=1e-14)


# Rows with terms


def with_two_barriers(disk):
    """And another disk beside it."""
    x, y, _ = disk.plant.states
    barriers = (disk.barriers[0], Barrier(4 - (x - 1) ** 2 - y**2, "other"))
    return replace(disk, barriers=barriers, gains=((1.0, 2.0), (3.0, 1.0)))


@pytest.mark.parametrize("errors", [[0.0] * 3, [0.05, 0.1, 0.2]])
def test_a_learned_row_stands_beside_a_plain_one(disk, errors):
    both = with_two_barriers(disk)
    learned, plain = (
        LearnedHOCBF(residual_of(both, errors), alpha=both.gains_of(0)),
        HOCBF(both.gains_of(1)),
    )
    x, u = situations(both, 40)
    for conditions in (
        (learned, plain),
        (learned, replace(plain, sampling_margin="first-order")),
        (learned, replace(learned, alpha=(3.0, 1.0))),
    ):
        found = assert_floats_are_arrays(SafetyFilter.for_problem(both, conditions), x, u)
        assert found.active.any(axis=0).all()
        one = replace(both, barriers=both.barriers[:1], gains=both.gains_of(0))
        np.testing.assert_allclose(
            found.margin[:, 0], worst_row(one, x, found.action, errors), atol=1e-10
        )
        if conditions[1] is plain:
            row = plain.constraint(both.model, both.barriers[1])
            a, b = values(both.model, [*row.coefficient, row.offset], x).T
            np.testing.assert_allclose(found.margin[:, 1], a * found.action[:, 0] + b, atol=1e-10)
        if conditions[1].name == "learned-hocbf":
            two = replace(both, barriers=both.barriers[1:], gains=both.gains_of(1))
            np.testing.assert_allclose(
                found.margin[:, 1], worst_row(two, x, found.action, errors), atol=1e-10
            )
    if not any(errors):
        known = SafetyFilter.for_problem(both, [HOCBF(both.gains_of(i)) for i in (0, 1)], "plant")
        ours = [replace(learned, alpha=both.gains_of(i)) for i in (0, 1)]
        assert_same_decisions(both, SafetyFilter.for_problem(both, ours), known)


@pytest.mark.parametrize("name", ["network", "posterior"])
def test_learned_rows_stand_beside_reciprocal_ones(request, top, cubic, name):
    model = request.getfixturevalue(name)
    problem, learned = (
        (top, DDSCBF(model)) if name == "network" else (cubic, BayesianSCBF(model, confidence=0.9))
    )
    first = problem.barriers[0]
    second = Barrier(1.2 * first.expression - 0.1, "second")
    both, turned = (replace(problem, barriers=pair) for pair in ((first, second), (second, first)))
    rng = np.random.default_rng(0)
    x, u = (
        rng.uniform(*np.array(problem.sampling_domain.region).T, (25, 2)),
        rng.uniform(-9, 9, (25, 1)),
    )  # on both sides of the edge
    alone = SafetyFilter.for_problem(problem, learned).filter(x, u)
    for other in (SRCBF(), SRCBF(sampling_margin="first-order")):
        found = assert_floats_are_arrays(
            SafetyFilter.for_problem(both, (learned, other)), x, u, 1e-8
        )
        free = ~found.active[:, 1]
        assert 0 < np.count_nonzero(free) < 25
        np.testing.assert_allclose(found.action[free], alone.action[free], atol=1e-9)
        swapped = SafetyFilter.for_problem(turned, (other, learned)).filter(x, u)
        np.testing.assert_allclose(swapped.action, found.action, atol=1e-9)


def test_a_goal_stands_beside_a_learned_row():
    problem = problem_of("safe_envs/ACCGap-v0")
    ours = SafetyFilter.for_problem(problem, DDSCBF(generator_of(problem, 2)), objective="clf")
    assert_same_decisions(
        problem, ours, SafetyFilter.for_problem(problem, SCBF(), objective="clf"), tolerance=1e-6
    )


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("eps", [0.0, 0.1])
def test_a_network_without_a_value_is_told_with_the_state(disk, which, eps):
    exact = residual_of(disk)
    undefined = replace(exact, parts=(Undefined(exact.parts[0], which, 0.4),))
    safety_filter = SafetyFilter.for_problem(
        disk, LearnedHOCBF(undefined, alpha=(1.0, 2.0), eps=eps)
    )
    x, u = np.array([[0.3, 0.1, 0.2], [0.41, 0.1, 0.2], [0.2, 0.1, 0.2]]), np.zeros((3, 1))
    for state in (x[0], x[2]):
        assert np.isfinite(safety_filter.filter(state, u[0]).action).all()
    for states, inputs in ((x, u), (x[1], u[1])):
        with pytest.raises(
            NumericalError, match=r"h has no finite value at x = 0\.41, y = 0\.1, theta = 0\.2"
        ):
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


# Identified systems


@pytest.mark.parametrize(
    ("name", "learned", "margin"),
    [
        ("gap", "gap_posterior", "none"),
        *[("cubic", "posterior", m) for m in ("none", 0.02, "first-order")],
    ],
)
def test_the_most_probable_system_is_filtered_as_if_it_were_known(request, name, learned, margin):
    problem, learned = request.getfixturevalue(name), request.getfixturevalue(learned)
    ours = SafetyFilter.for_problem(problem, BayesianSCBF(learned, sampling_margin=margin))
    rows = [(problem.barriers[0], SCBF(sampling_margin=margin))]
    known = SafetyFilter(learned.system, rows, input_bounds=problem.input_bounds, dt=problem.dt)
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
        for tried in np.linspace(*problem.input_bounds[0], 21):
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
