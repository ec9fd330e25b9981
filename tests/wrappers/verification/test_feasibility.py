"""What `verify` finds by itself, against what is known of the systems."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import Barrier
from safe_envs.proofs.analysis import SafeSetAnalysis, infeasible_part
from safe_envs.proofs.feasibility import verify
from safe_envs.proofs.safe_set import Formulas, draw_starts
from safe_envs.wrappers import parse_conditions
from tests.conftest import problem_of
from tests.wrappers.verification.verified import (
    CUBIC_DISK,
    DUBINS,
    STOCHASTIC,
    findings,
    hurried,
    hurry,
    made,
    made_bound,
    problem_with,
    system_in_a_box,
    x,
)

pytestmark = pytest.mark.slow

STATUSES = {"proved", "estimated", "withheld", "hypothesis fails", "no bound", "not established"}


def test_radial_headings_leave_the_dubins_disk_without_control():
    (barrier,) = (found := findings(DUBINS)).barriers
    x, y, theta = barrier.control_authority_at
    assert barrier.degree == 2
    assert barrier.vanishes
    assert abs(x * math.sin(theta) - y * math.cos(theta)) < 1e-6
    assert 0.0 < barrier.small < 0.02
    assert barrier.small_infeasible > 0.1
    # Outward and radial on b_1 = 0 it is missed most: rho solves 1 - rho^2 = 2 v rho, and the row
    # is -2 v (v + rho).
    v = 0.5
    rho = -v + math.sqrt(v * v + 1)
    assert found.invariant_set is not None
    assert found.invariant_set.shortfall == pytest.approx(2 * v * (v + rho), rel=1e-6)
    assert 0.01 < found.invariant_set.infeasible < 0.1


@pytest.mark.parametrize(("rates", "missed"), [("1,1", 2 * 0.8**2 - 1), ("1,2", 0.0)])
def test_the_centre_of_the_dubins_disk_needs_large_rates(rates, missed):
    (barrier,) = findings(DUBINS, f"hocbf:p={rates}", "plant", samples=1024).barriers
    np.testing.assert_allclose(barrier.deepest[:2], 0.0, atol=1e-4)
    assert barrier.deepest_shortfall == pytest.approx(missed, abs=1e-5)


def test_a_narrow_box_leaves_a_shortfall():
    # Largest at x = 1: A h = -2 x u - s^2 x^2, with |u| <= .1 and s = .6.
    problem = system_in_a_box(high=0.1)
    found = verify(problem, parse_conditions("scbf", problem))
    assert found.safe_set.shortfall == pytest.approx(0.6**2 - 0.2, abs=1e-6)
    assert found.safe_set.infeasible == pytest.approx(1 - 0.2 / 0.36, abs=0.01)


def test_conflicting_barriers_are_found_to_be_infeasible_together():
    problem = system_in_a_box()
    (x,) = problem.plant.states
    apart = replace(
        problem, barriers=(Barrier(1 - x, "right"), Barrier(1 + x, "left")), gains=(0.1,)
    )
    # -u + .1 (1 - x) >= m and u + .1 (1 + x) >= m add up to .2 >= 2 m: for m = .5 each can be met,
    # but not both.
    margin = parse_conditions("cbf:alpha=0.1:sampling_margin=0.5", apart)
    found = verify(apart, margin, samples=500)
    assert found.safe_set.infeasible == 1.0
    assert found.safe_set.shortfall >= 0.4 - 1e-6
    assert (
        verify(apart, parse_conditions("cbf:alpha=0.1", apart), samples=500).safe_set.infeasible
        == 0.0
    )


def test_every_id_is_verified_and_has_a_bound_or_a_note(env_id, monkeypatch):
    hurry(monkeypatch)
    found = hurried(env_id)
    problem = found.formulas.problem
    assert len(found.barriers) == len(problem.barriers)
    for barrier in found.barriers:
        assert 0.0 <= barrier.control_authority <= barrier.typical < math.inf
        assert 0.0 <= barrier.small <= 1.0
        assert math.isfinite(barrier.deepest_h)
        assert barrier.deepest_shortfall >= 0.0
        assert barrier.suprema.shape == (barrier.degree,)
        assert barrier.deepest.shape == barrier.control_authority_at.shape == (problem.plant.n,)
    for part in (found.safe_set, found.invariant_set):
        assert part is not None
        assert 0.0 < part.share <= 1.0
        assert 0.0 <= part.infeasible <= 1.0
        assert 0.0 <= part.shortfall < math.inf
        assert found.formulas.barrier_level(part.worst[None])[0] >= 0.0
    starts = draw_starts(problem, 16)
    bounds = found.guarantee.applicable_bounds(starts, problem.horizon)
    assert bounds
    for bound in bounds:
        assert bound.status in STATUSES
        assert bound.value is None or 0.0 <= bound.value <= 1.0
        assert bound.reason or bound.status == "proved"
    # The same look at the system gives the estimated bound, or a note on why there is none.
    estimated = found.guarantee
    values = estimated.at(starts, problem.horizon)
    assert values.shape == (16,)
    assert ((values >= 0.0) & (values <= 1.0)).all()
    assert estimated.note is None or not values.any()


def test_infeasibility_and_shortfall_are_those_of_the_filter():
    problem = problem_of(STOCHASTIC)
    formulas = Formulas(problem, parse_conditions("scbf", problem), "model")
    rng = np.random.default_rng(3)
    x = rng.uniform(-2.0, 2.0, (500, 3))
    result = formulas.safety_filter.filter(x, rng.uniform(-10.0, 10.0, (500, 1)))
    missed = formulas.shortfall(x)
    np.testing.assert_array_equal(missed > 0.0, ~result.feasible)
    np.testing.assert_allclose(np.maximum(missed, 0.0), result.slack[:, 0])
    assert 0 < (missed > 0.0).sum() < 500


def test_results_depend_on_the_seed_alone():
    problem = problem_of(CUBIC_DISK)
    conditions = parse_conditions("scbf", problem)
    first, again, other = (
        verify(problem, conditions, samples=256, seed=seed) for seed in (1, 1, 2)
    )
    assert first.safe_set.infeasible == again.safe_set.infeasible
    np.testing.assert_array_equal(first.safe_set.worst, again.safe_set.worst)
    assert first.safe_set.points != other.safe_set.points or not np.array_equal(
        first.safe_set.worst, other.safe_set.worst
    )


@pytest.mark.parametrize(
    "arguments", [{"samples": 0}, {"samples": 1.5}, {"seed": -1}, {"knowledge": "guess"}]
)
def test_arguments_out_of_range_are_refused(arguments):
    problem = problem_of(CUBIC_DISK)
    with pytest.raises(ConfigurationError):
        verify(problem, parse_conditions("scbf", problem), **arguments)


@pytest.mark.parametrize(("exponent", "seed"), [(2, 0), (4, 1), (8, 2), (12, 3)])
def test_a_wide_box_hides_no_state_without_control(exponent, seed):
    # Outward and radial on b_1 = 0, as above, with p_1 = p_2 = .5; at the centre b_2 is p_1 p_2 - 2
    # v^2.
    v, p = 0.5, 0.5
    problem = problem_of(DUBINS, plant={"v": v}, box=[-(10.0**exponent), 10.0**exponent])
    found = SafeSetAnalysis(
        Formulas(problem, parse_conditions("hocbf:p=.5,.5", problem), "model"), 2048, seed
    )
    rho = (-2 * v + math.sqrt(4 * v * v + 4 * p * p)) / (2 * p)
    assert found.max_shortfall[0] == pytest.approx(2 * v * (v + p * rho), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("exponent", [12])
def test_a_wide_box_does_not_help_at_the_centre(exponent):
    (barrier,) = findings(
        DUBINS,
        "hocbf:p=.5,.5",
        samples=1024,
        plant={"v": 0.5},
        box=[-(10.0**exponent), 10.0**exponent],
    ).barriers
    assert barrier.vanishes
    assert barrier.deepest_shortfall == pytest.approx(2 * 0.5**2 - 0.5**2, abs=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_moderately_wide_boxes_do_not_depend_on_the_seed(seed):
    problem = problem_of(STOCHASTIC, box=[-1e4, 1e4])
    found = SafeSetAnalysis(
        Formulas(problem, parse_conditions("szcbf:alphas=5,5", problem), "model"), 2048, seed
    )
    assert found.max_shortfall[0] == pytest.approx(60.878095, rel=1e-6)


def pockets(width, depth, offset):
    """Two states that one input drives apart, and a pocket of two others where both fall."""
    a, b, c, d = sp.symbols("a b c d", real=True)
    bump = depth * sp.exp(-((c - 0.3) ** 2 + (d + 0.2) ** 2) / width**2)
    return problem_with(
        [offset[0] - bump, offset[1] - bump, 0 * c, 0 * d],
        [sp.tanh(a), sp.tanh(b)],
        noise=(0.02, 0.02, 0.0, 0.0),
        states=(a, b, c, d),
        inputs=((1.0,), (-1.0,), (0.0,), (0.0,)),
        ranges=((-1.0, 4.0), (-1.0, 4.0), (-1.0, 1.0), (-1.0, 1.0)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("width", [0.05, 0.01])
def test_a_pocket_of_conflict_is_found(width):
    # At the edge of both the best common margin is the mean of the two offsets, less the depth.
    problem = pockets(width, 5.0, (0.2, 0.2))
    found = SafeSetAnalysis(
        Formulas(problem, parse_conditions("szcbf:alphas=.1", problem), "model")
    )
    missed, state = found.max_shortfall
    assert missed == pytest.approx(4.8, rel=1e-3)
    np.testing.assert_allclose(state, [0.0, 0.0, 0.3, -0.2], atol=1e-3)


def test_what_is_missed_together_is_the_filters_slack():
    problem = pockets(0.5, 5.0, (-1.0, 1.2))
    formulas = Formulas(problem, parse_conditions("szcbf:alphas=.1", problem), "model")
    states = formulas.region.draw(9, np.random.default_rng(0))
    result = formulas.safety_filter.filter(states, np.zeros((len(states), 1)))
    missed = formulas.shortfall(states)
    np.testing.assert_array_equal(missed > 0.0, ~result.feasible)
    np.testing.assert_allclose(np.maximum(missed, 0.0), result.slack.max(axis=1), atol=1e-9)
    assert 0 < result.feasible.sum() < len(states)
    # The common margin of a wider box is no smaller.
    assert (formulas.shortfall(states, 0.1) >= formulas.shortfall(states, 0.5) - 1e-12).all()


def test_states_where_a_condition_is_undefined_are_reported():
    problem = problem_with([-sp.sqrt(x)], [1 - x**2], noise=(0.05,))
    found = made(problem, samples=1024)
    assert found.undefined == pytest.approx(0.5, abs=0.01)
    bound, *_ = found.guarantee.applicable_bounds(np.array([[0.5]]), 1.0)
    assert bound.status == "hypothesis fails"
    assert "no finite value at x = -" in bound.reason
    assert "no finite value at x = -" in (made_bound(problem).note or "")


def test_a_tiny_unit_of_a_barrier_is_no_matter():
    problem = problem_with([0 * x], [1e-10 * (1 - x**2)], noise=(0.1,))
    # At the middle A h = -s^2 in these units.
    assert made(problem, samples=1024).safe_set.shortfall == pytest.approx(1e-12, rel=1e-6)
    assert made(problem, "srcbf", samples=1024).safe_set.points > 1000


@pytest.mark.parametrize(
    ("slowest", "rates", "share"),
    [
        (0.0, "1,1", 1.0),
        # Of [0, 1] x [-1, 1] the part above v = -x is (1 + 1/2)/2, and that above v = -2 x is (1 +
        # 3/4)/2.
        (-1.0, "1,1", 3 / 4),
        (-1.0, "2,1", 7 / 8),
    ],
)
def test_the_intersection_is_a_part_of_c(slowest, rates, share):
    v = sp.Symbol("v", real=True)
    problem = problem_with(
        [v, 0 * v],
        [x],
        noise=(0.0, 0.0),
        states=(x, v),
        inputs=((0.0,), (1.0,)),
        ranges=((-1.0, 1.0), (slowest, 1.0)),
        start=0.5,
    )
    found = made(problem, f"hocbf:p={rates}", samples=4096)
    assert found.invariant_set is not None
    assert found.invariant_set.share == pytest.approx(share, abs=0.005)
    assert found.safe_set.share == pytest.approx(0.5, abs=0.005)


def test_a_condition_that_is_just_met_is_met():
    # At x = 0 the row of h = 1 - x^2 without noise is 0 u + 0 >= 0.
    problem = problem_with([0 * x], [1 - x**2])
    formulas = Formulas(problem, parse_conditions("scbf", problem), "model")
    states = np.zeros((4, 1))
    assert formulas.safety_filter.filter(states, np.zeros((4, 1))).feasible.all()
    np.testing.assert_array_equal(formulas.shortfall(states), 0.0)
    assert infeasible_part(formulas, states) == 0.0
