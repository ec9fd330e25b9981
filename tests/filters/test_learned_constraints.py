"""Rows with learned generators, and learned rows beside others: against exact stand-ins."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from safe_envs import Barrier, ConfigurationError, NumericalError
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


@pytest.mark.parametrize("margin", [0.0, 0.5])
def test_the_direct_way_is_the_learned_noise(gap, diffusion, margin):
    found = diffusion.diffusion.system(gap.model)
    for sampled in (margin, "first-order") if margin == 0.0 else (margin,):
        ours = (
            DDSCBF(diffusion, sampling_margin=sampled)
            if sampled == "first-order"
            else DDSCBF(diffusion, margin=margin)
        )
        known = SafetyFilter(
            found, [(gap.barriers[0], SCBF(sampling_margin=sampled))], bounds=gap.box, dt=gap.dt
        )
        assert_same_decisions(gap, SafetyFilter.for_problem(gap, ours), known, tolerance=1e-12)


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


@pytest.mark.parametrize("errors", [[0.0] * 3, [0.05, 0.1, 0.2]])
def test_a_learned_row_stands_beside_a_plain_one(disk, errors):
    both = with_two_barriers(disk)
    learned, plain = (
        LearnedHOCBF(residual_of(both, errors), p=both.gains_of(0)),
        HOCBF(both.gains_of(1)),
    )
    x, u = situations(both, 40)
    for conditions in (
        (learned, plain),
        (learned, replace(plain, sampling_margin="first-order")),
        (learned, replace(learned, p=(3.0, 1.0))),
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
        ours = [replace(learned, p=both.gains_of(i)) for i in (0, 1)]
        assert_same_decisions(both, SafetyFilter.for_problem(both, ours), known)


@pytest.mark.slow
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
    safety_filter = SafetyFilter.for_problem(disk, LearnedHOCBF(undefined, p=(1.0, 2.0), eps=eps))
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
