"""What `verify` finds by itself, against what is known of the systems."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import Barrier
from safe_envs.problem.starts import Start
from safe_envs.wrappers import SafetyFilter, parse_conditions
from tests.conftest import problem_of
from tests.proofs.verified import (
    CUBIC_DISK,
    DUBINS,
    STOCHASTIC,
    findings,
    hurry,
    made,
    made_bound,
    problem_with,
    starts_of,
    system_in_a_box,
    x,
    y,
)

pytestmark = pytest.mark.slow

STATUSES = {"proved", "estimated", "withheld", "hypothesis fails", "no bound", "not established"}


def test_every_env_is_verified_and_has_a_bound_or_a_note(env_id, monkeypatch):
    hurry(monkeypatch)
    problem = problem_of(env_id, **({"num_obstacles": 2} if "DubinsObstacles" in env_id else {}))
    found = made(problem, problem.filter, samples=128)
    assert len(found.barriers) == len(problem.barriers)
    for barrier in found.barriers:
        assert 0.0 <= barrier.control_authority <= barrier.typical < math.inf
        assert 0.0 <= barrier.small <= 1.0
        assert math.isfinite(barrier.deepest_h)
        assert barrier.deepest_shortfall >= 0.0
        assert barrier.suprema.shape == (barrier.degree,)
        assert barrier.deepest.shape == barrier.control_authority_at.shape == (problem.plant.n,)
    for part in (found.safe_set, found.invariant_set):
        assert 0.0 < part.share <= 1.0
        assert 0.0 <= part.infeasible <= 1.0
        assert 0.0 <= part.shortfall < math.inf
    starts = starts_of(problem, 16)
    for bound in found.guarantee.applicable_bounds(starts, problem.horizon):
        assert bound.status in STATUSES
        assert bound.value is None or 0.0 <= bound.value <= 1.0
        assert bound.reason or bound.status == "proved"
    values = found.guarantee.at(starts, problem.horizon)
    assert values.shape == (16,)
    assert ((values >= 0.0) & (values <= 1.0)).all()
    assert found.guarantee.note is None or not values.any()


@pytest.mark.usefixtures("whole_search")
def test_radial_headings_leave_the_dubins_disk_without_control():
    (barrier,) = (found := made(problem_of(DUBINS), "hocbf")).barriers
    x_1, x_2, theta = barrier.control_authority_at
    assert barrier.degree == 2
    # The search follows the ridge of radial headings to where the authority is 0.
    assert barrier.vanishes
    assert abs(x_1 * math.sin(theta) - x_2 * math.cos(theta)) < 1e-6
    assert 0.0 < barrier.small < 0.02
    assert barrier.small_infeasible > 0.1
    # Outward and radial on b_1 = 0 it is missed most: rho solves 1 - rho^2 = 2 v rho, and the row
    # is -2 v (v + rho).
    v = 0.5
    rho = -v + math.sqrt(v * v + 1)
    assert found.invariant_set.shortfall == pytest.approx(2 * v * (v + rho), rel=1e-6)
    assert 0.01 < found.invariant_set.infeasible < 0.1


@pytest.mark.parametrize(("rates", "missed"), [("1,1", 2 * 0.8**2 - 1), ("1,2", 0.0)])
def test_the_centre_of_the_dubins_disk_needs_large_rates(rates, missed):
    (barrier,) = findings(DUBINS, f"hocbf:alpha={rates}", "plant", samples=1024).barriers
    np.testing.assert_allclose(barrier.deepest[:2], 0.0, atol=1e-4)
    assert barrier.deepest_shortfall == pytest.approx(missed, abs=1e-5)


@pytest.mark.parametrize(
    "exponent", [2, 12, *(pytest.param(e, marks=pytest.mark.oracle) for e in (4, 8))]
)
def test_a_wide_box_hides_no_state_without_control(exponent):
    # As above, with p_1 = p_2 = .5; at the centre b_2 is p_1 p_2 - 2 v^2, whatever the input is.
    v, p = 0.5, 0.5
    problem = problem_of(DUBINS, plant={"v": v}, input_bounds=[-(10.0**exponent), 10.0**exponent])
    found = made(problem, "hocbf:alpha=.5,.5", samples=1024, seed=exponent)
    rho = (-2 * v + math.sqrt(4 * v * v + 4 * p * p)) / (2 * p)
    assert found.invariant_set.shortfall == pytest.approx(2 * v * (v + p * rho), rel=1e-6)
    assert found.barriers[0].vanishes
    assert found.barriers[0].deepest_shortfall == pytest.approx(2 * v**2 - p**2, abs=1e-6)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.oracle)])
def test_moderately_wide_boxes_do_not_depend_on_the_seed(seed):
    problem = problem_of(STOCHASTIC, input_bounds=[-1e4, 1e4])
    found = made(problem, "szcbf:alpha=5,5", samples=2048, seed=seed)
    assert found.invariant_set.shortfall == pytest.approx(60.878095, rel=1e-6)


def test_a_narrow_box_leaves_a_shortfall():
    # Largest at x = 1: A h = -2 x u - s^2 x^2, with |u| <= .1 and s = .6.
    found = made(system_in_a_box(high=0.1), samples=2048)
    assert found.safe_set.shortfall == pytest.approx(0.6**2 - 0.2, abs=1e-6)
    assert found.safe_set.infeasible == pytest.approx(1 - 0.2 / 0.36, abs=0.01)


def test_conflicting_barriers_are_found_to_be_infeasible_together():
    problem = system_in_a_box()
    (z,) = problem.plant.states
    barriers = (Barrier(1 - z, "right"), Barrier(1 + z, "left"))
    apart = replace(problem, barriers=barriers, gains=(0.1,))
    # -u + .1 (1 - x) >= m and u + .1 (1 + x) >= m add up to .2 >= 2 m: for m = .5 each can be met,
    # but not both.
    found = made(apart, "cbf:alpha=0.1:sampling_margin=0.5", samples=500)
    assert found.safe_set.infeasible == 1.0
    assert found.safe_set.shortfall >= 0.4 - 1e-6
    assert made(apart, "cbf:alpha=0.1", samples=500).safe_set.infeasible == 0.0


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


@pytest.mark.parametrize("width", [0.05, pytest.param(0.01, marks=pytest.mark.oracle)])
def test_a_pocket_of_conflict_is_found(width):
    # At the edge of both the best common margin is the mean of the two offsets, less the depth.
    found = made(pockets(width, 5.0, (0.2, 0.2)), "szcbf:alpha=.1").invariant_set
    assert found.shortfall == pytest.approx(4.8, rel=1e-3)
    np.testing.assert_allclose(found.worst, [0.0, 0.0, 0.3, -0.2], atol=1e-3)


@pytest.mark.parametrize(
    ("problem", "text"),
    [
        (problem_of(STOCHASTIC), "scbf"),
        (system_in_a_box(high=0.1), "scbf"),
        (pockets(0.5, 5.0, (-1.0, 1.2)), "szcbf:alpha=.1"),
    ],
    ids=["degree two", "one input", "two barriers on one input"],
)
def test_infeasibility_and_shortfall_are_those_of_the_filter(problem, text):
    found = made(problem, text, samples=1024)
    safety_filter = SafetyFilter.for_problem(problem, parse_conditions(text, problem))
    nominal = np.zeros(problem.plant.m)
    at_worst = safety_filter.filter(found.safe_set.worst, nominal)
    assert not at_worst.feasible
    assert found.safe_set.shortfall == pytest.approx(at_worst.slack.max(), rel=1e-6)
    low, high = np.array(problem.sampling_domain.region).T
    states = np.random.default_rng(3).uniform(low, high, (8000, problem.plant.n))
    numeric = [problem.plant.numeric(b.expression) for b in problem.barriers]
    h = sp.lambdify([problem.plant.states], numeric, "numpy")(states.T)
    inside = states[(np.array(h) > 0.0).all(axis=0)]
    unmet = ~safety_filter.filter(inside, np.zeros((len(inside), problem.plant.m))).feasible
    assert 0.0 < unmet.mean() < 1.0
    assert found.safe_set.infeasible == pytest.approx(unmet.mean(), abs=0.06)


def test_a_condition_that_is_just_met_is_met():
    # Where x < 0 the row of h = 1 - x^2 without noise is 0 u + 0 >= 0.
    problem = problem_with([0 * x], [1 - x**2], inputs=((sp.Max(x, 0),),))
    found = made(problem, samples=512)
    assert found.safe_set.infeasible == found.safe_set.shortfall == 0.0


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
def test_the_invariant_set_is_a_part_of_the_safe_set(slowest, rates, share):
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
    found = made(problem, f"hocbf:alpha={rates}", samples=4096)
    assert found.invariant_set.share == pytest.approx(share, abs=0.005)
    assert found.safe_set.share == pytest.approx(0.5, abs=0.005)


def test_a_tiny_safe_set_is_found_as_a_whole():
    # A h_i >= 0 cannot be met for 2 |u| < s^2 |x_i|, which is the outer half of each state's range.
    problem = system_in_a_box(count=2, half_width=0.004, high=0.5 * 0.6**2 * 0.002)
    problem = replace(problem, starts={"middle": Start.at((0.0, 0.0))})
    found = made(problem, samples=256).safe_set
    assert found.points >= 256
    assert found.infeasible == pytest.approx(1 - 0.5**2, abs=0.03)


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.oracle) for s in (1, 2))])
def test_a_narrow_peak_is_in_the_supremum(seed):
    z = sp.Symbol("z", real=True)
    peak = 5 * sp.exp(-((x - 0.3) ** 2 + (y - 0.4) ** 2 + (z + 0.3) ** 2) / 0.05**2)
    problem = problem_with(
        [0 * x, 0 * x, 0 * x],
        [1 - x**2 + peak],
        noise=(0.1, 0.3, 0.3),
        states=(x, y, z),
        inputs=((1.0,), (0.0,), (0.0,)),
        ranges=((-2.0, 2.0),) * 3,
        input_bounds=(-1000.0, 1000.0),
    )
    (barrier,) = made(problem, "szcbf", seed=seed).barriers
    assert barrier.supremum == pytest.approx(5.91, abs=0.01)


def test_the_search_follows_a_ridge_to_a_corner():
    ridge = x - 100 * sp.sqrt((y - sp.Rational(1, 4)) ** 2 + 1e-16)
    problem = problem_with(
        [0 * x, 0 * y],
        [2 + ridge, 1 - x - y],
        noise=(0.0, 0.0),
        states=(x, y),
        inputs=((1.0,), (0.0,)),
        ranges=((-2.0, 2.0),) * 2,
        start=0.1,
    )
    found = made(problem, "cbf", samples=512).barriers[0]
    assert found.supremum == pytest.approx(2.75, abs=1e-5)
    np.testing.assert_allclose(found.deepest, [0.75, 0.25], atol=1e-5)


@pytest.mark.parametrize(
    ("expression", "periodic"),
    [
        (sp.sin(y) + sp.cos(3 * y + x) * x, True),
        (sp.tan(2.0 * y) ** 2, True),
        (sp.sin(y / 2), False),
        (sp.Max(y - 15, 0), False),
        (sp.sin(x * y), False),
        (sp.sin(y**2), False),
    ],
)
def test_only_waves_are_searched_over_one_turn(expression, periodic):
    problem = problem_with(
        [0 * x, 1 + 0 * y],
        [3 - x**2 - expression / 10],
        noise=(0.0, 0.0),
        states=(x, y),
        inputs=((1.0,), (0.0,)),
        ranges=((-2.0, 2.0), (-math.inf, math.inf)),
        start=0.1,
    )
    region = made(problem, "cbf", samples=64).region
    assert region.periodic.tolist() == [False, periodic]
    width = region.high[1] - region.low[1]
    assert width == pytest.approx(2 * math.pi) if periodic else width >= 20.0


KINK, POLE = "twice differentiable", "a pole"


@pytest.mark.parametrize(
    ("barrier", "rough"),
    [
        (1 - sp.sqrt(2 - 2 * sp.cos(x)), KINK),
        (3 + sp.acos(x / 2), KINK),
        (3 + sp.asin(x / 2), KINK),
        (3 + sp.acosh(x + 1), KINK),
        (1 + x ** sp.Float(1.5), KINK),
        (1 / x - 0.6, POLE),
        (1 - sp.log(1 + x), POLE),
        (5 + sp.atanh(x), POLE),
        (5 + sp.tan(x), POLE),
        (5 + sp.cot(x), POLE),
        (5 + sp.sec(x), POLE),
        (5 + sp.csc(x), POLE),
        (5 + sp.atan2(x - 1, -2), POLE),
        (1 - x**2 - sp.Abs(x) ** 3 + sp.tanh(x) * 2**x / 100, ""),
        # Beyond the edge of C, and beyond the workspace, nothing matters.
        (sp.sqrt((x + 1) ** 2 + 1e-9) - 0.5 - (x - 2) ** 2 / 4, ""),
        (1 - x**2 + sp.log(x + 4), ""),
    ],
)
def test_a_kink_or_pole_in_the_safe_set_leaves_no_bound_under_noise(barrier, rough):
    bound = made_bound(problem_with([0 * x], [barrier], noise=(0.3,)), "szcbf:alpha=0.1")
    told = (bound.note or "") + (bound.remark if not rough else "")
    assert (rough in told) if rough else not (KINK in told or POLE in told)
    assert not rough or bound.at(np.array([[0.5]]), 0.1)[0] == 0.0


@pytest.mark.parametrize(
    "near",
    [
        1 / sp.sqrt(x**2 + 1e-6),
        sp.sqrt(sp.cosh(2 * x) - sp.Float("0.99999999")),
        1 / (sp.Float("1.0000001") - sp.sin(x)),
    ],
)
def test_what_comes_near_a_kink_or_pole_only_is_left_to_the_judge(near):
    problem = problem_with([0 * x], [1 - x**2 + near / 1000], noise=(0.3,))
    bound = made_bound(problem, "szcbf")
    assert (bound.note, bound.proof.regular) == (None, True)


def test_without_noise_a_kink_is_no_matter_and_a_pole_is():
    root = (x**2 + 1e-4) ** sp.Rational(1, 4) * (1 - x) ** sp.Rational(3, 2)
    for drift, barrier, pole in (
        (root, 1 - x**2, None),
        (0 * x, 1 / x - 0.6, "h_1 has a pole near x = "),
        (1 / (x - 0.3), 1 - x**2, "the condition on h_1 has a pole near x = 0.3"),
    ):
        guarantee = made(problem_with([drift], [barrier]), "cbf", samples=512).guarantee
        (bound, *_) = guarantee.applicable_bounds(np.array([[0.5]]), 1.0)
        assert bound.status == ("hypothesis fails" if pole else "estimated")
        assert (guarantee.note or "").startswith(pole or "")
        assert bool(guarantee.note) == bool(pole)


def test_results_depend_on_the_seed_alone():
    problem = problem_of(CUBIC_DISK)
    first, again, other = (made(problem, samples=256, seed=seed).safe_set for seed in (1, 1, 2))
    assert (first.infeasible, first.points) == (again.infeasible, again.points)
    np.testing.assert_array_equal(first.worst, again.worst)
    assert first.points != other.points or not np.array_equal(first.worst, other.worst)


@pytest.mark.parametrize(
    ("changes", "arguments", "told"),
    [
        ({}, {"samples": 0}, "samples"),
        ({}, {"samples": 1.5}, "samples"),
        ({}, {"seed": -1}, "seed"),
        ({}, {"knowledge": "guess"}, "guess"),
        ({"barriers": (Barrier(-1 - x**2),)}, {}, "no point of C"),
    ],
)
def test_what_cannot_be_verified_is_refused(changes, arguments, told):
    problem = replace(problem_with([0 * x], [1 - x**2]), **changes)
    with pytest.raises(ConfigurationError, match=told):
        made(problem, **arguments)
