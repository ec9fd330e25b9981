"""The kernel of one constraint against the dispatcher, and compiled."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.engine.qp import one_constraint, rounding
from safe_envs.engine.qp.kernels import one_constraint as kernel
from tests.oracles.kernel_problems import KINDS, differences, random_problems, reference, solve


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("m", [1, 2, 3, 5])
def test_says_what_the_dispatcher_does(m, kind):
    problems = random_problems(np.random.default_rng([m, KINDS.index(kind)]), 150, 1, m, kind)
    found = solve(kernel.project_one_constraint, kernel.work_of_one_constraint(1, m), problems)
    expected = reference(problems)
    assert 5 < expected.active.sum() < 145
    if m == 1:
        for part, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(part, other)
        return
    inputs, margins, flags = differences(found, expected, problems)
    assert not flags.any()
    # A proposal 1e8 boxes away has its own rounding.
    assert max(inputs, margins) < (1e-7 if kind == "far" else 1e-11)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("m", [2, 3])
def test_is_the_plain_function_to_the_last_bits(m, kind):
    problems = random_problems(np.random.default_rng(m), 60, 1, m, kind)
    found = solve(kernel.project_one_constraint, kernel.work_of_one_constraint(1, m), problems)
    for i, (a, b, *ends) in enumerate(zip(*problems[:6], strict=True)):
        u, margin, active, feasible = one_constraint.project_floats(
            a[0].tolist(), b.item(), *[end.tolist() for end in ends]
        )
        # From three terms on, Python 3.12 adds floats more exactly than one after the other.
        np.testing.assert_allclose(found.u[i], u, rtol=1e-13, atol=0.0 if m == 2 else 1e-13)
        np.testing.assert_allclose(found.margin[i], margin, atol=1e-13 * abs(b.item()))
        assert (found.active[i], found.feasible[i]) == (active, feasible)


@pytest.mark.parametrize("m", [2, 3])
def test_a_long_way_inside_the_box_ends_on_the_row(m):
    problems = random_problems(np.random.default_rng(m), 100, 1, m, "plain")
    wide = np.full((100, m), 1e9)
    problems = problems._replace(v=1e6 * problems.v, low=-wide, high=wide)
    found = solve(kernel.project_one_constraint, kernel.work_of_one_constraint(1, m), problems)
    acts = found.active[:, 0] == 1.0
    assert 20 < acts.sum() < 80
    assert found.feasible.all()
    terms = (np.abs(problems.a[:, 0]) * np.abs(found.u)).sum(axis=1) + np.abs(problems.b[:, 0])
    assert np.all(np.abs(found.margin[:, 0]) <= rounding.ROUNDING * terms, where=acts)


@np.errstate(all="ignore")
def test_data_that_are_not_finite_end_in_numbers_that_are_not():
    for bad in (np.nan, np.inf, -np.inf):
        for m in (1, 2, 3):
            for part in range(3):
                problems = random_problems(np.random.default_rng(0), 20, 1, m, "unmet")
                problems[part][:] = bad
                found = solve(
                    kernel.project_one_constraint, kernel.work_of_one_constraint(1, m), problems
                )
                # A proposal is clipped first, so that it may be endless.
                ends = np.isfinite(found.u).all(axis=1) & np.isfinite(found.margin[:, 0])
                assert not ends.any() or (part == 2 and not np.isnan(bad))


def test_tolerance_is_that_of_all_solvers():
    assert kernel.ROUNDING == rounding.ROUNDING
