"""Which bounds apply, which fail and why, and the estimated one."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.problem.problem import Barrier
from safe_envs.proofs.guarantees import HOLDING
from tests.conftest import problem_of
from tests.proofs.verified import (
    CUBIC_DISK,
    DUBINS,
    STOCHASTIC,
    estimated,
    findings,
    made,
    made_bound,
    problem_with,
    starts_of,
    system_in_a_box,
    x,
    y,
)

pytestmark = pytest.mark.slow


def test_scbf_fails_near_the_centre_of_the_cubic_disk():
    found = findings(CUBIC_DISK)
    (barrier,) = found.barriers
    assert barrier.deepest_shortfall == pytest.approx(0.08, abs=1e-9)
    np.testing.assert_allclose(found.safe_set.worst, 0.0, atol=1e-4)
    assert found.invariant_set is not None
    # C is one with the intersection: the worst of both is the same.
    assert (found.safe_set.shortfall, found.safe_set.infeasible) == (
        found.invariant_set.shortfall,
        found.invariant_set.infeasible,
    )
    assert found.invariant_set.share == 1.0
    assert found.safe_set.share == pytest.approx(math.pi / 16, abs=0.01)
    assert found.safe_set.shortfall == pytest.approx(0.08)
    (repaired,) = found.guarantee.applicable_bounds(np.array([[-0.1, 0.7]]), 1.0)
    assert ("repaired" in repaired.name, repaired.status) == (True, "proved")
    # The judge proves numbers that are larger than those found by 1e-3 of them at most.
    assert 0.419 < repaired.value <= 0.42


def endless(env_id):
    """A registered problem whose workspace has no end."""
    problem = problem_of(env_id)
    return replace(
        problem, states=tuple(replace(s, low=-math.inf, high=math.inf) for s in problem.states)
    )


@pytest.mark.parametrize("name", ["CubicSDE", "Scalar"])
def test_unbounded_barriers_have_no_bound_where_no_workspace_ends_them(name):
    problem = endless(f"safe_envs/{name}-v0")
    found = made(problem, samples=512)
    assert math.isinf(found.barriers[0].supremum)
    (bound,) = found.guarantee.applicable_bounds(starts_of(problem, 8), 1.0)
    assert (bound.status, bound.value, bound.reason) == ("no bound", None, "sup h is infinite")
    assert made_bound(problem).note == "sup h is infinite"


@pytest.mark.parametrize(
    ("name", "deepest"),
    [
        ("Scalar", {"x": "low"}),
        ("ACC", {"x_1": "low", "x_3": "high"}),
    ],
)
def test_a_supremum_is_that_of_the_workspace(name, deepest):
    # To leave the workspace ends an episode: what h would be beyond does not matter.
    found = findings(f"safe_envs/{name}-v0")
    problem = found.problem
    ranges = {s.symbol: s for s in problem.states}
    state = {s: deepest.get(s.name, 0.0) for s in ranges}
    h = problem.plant.numeric(problem.barriers[0].expression)
    highest = h.subs(
        {s: getattr(ranges[s], end) if isinstance(end, str) else end for s, end in state.items()}
    )
    assert found.beyond
    assert found.analysis.suprema[0] == pytest.approx(float(highest), rel=1e-9)
    assert found.barriers[0].supremum == pytest.approx(float(highest), rel=1e-9)


def test_leaving_the_workspace_counts_as_it_is_evaluated():
    """Brownian motion in [0, 2] with h = x: the bound x/2 is attained, for h is a martingale that
    ends at one of the two edges."""
    problem = problem_with(
        [0 * x], [x], noise=(1.0,), ranges=((-1.0, 2.0),), input_bounds=(-1e-9, 1e-9), start=0.5
    )
    bound = made_bound(replace(problem, horizon=20.0))
    assert bound.at(np.array([[0.5]]), 20.0)[0] == pytest.approx(0.25, abs=1e-6)


@pytest.mark.parametrize(
    ("barriers", "ends", "highest", "growth"),
    [
        # Along x the first grows without end, and the second ends it.
        ([x, 4 - x], (-math.inf, math.inf), 4.0, ""),
        ([x, 4 - x], (0.0, math.inf), 4.0, ""),
        # It ends beyond all that is searched.
        ([x, 10**9 - x], (0.0, math.inf), math.inf, "seems infinite"),
        ([x], (-math.inf, math.inf), math.inf, "is infinite"),
        # A range counts on its endless side only.
        ([x], (-math.inf, 2.0), 2.0, ""),
    ],
)
@pytest.mark.usefixtures("whole_search")
def test_a_supremum_is_infinite_only_where_nothing_ends_it(barriers, ends, highest, growth):
    problem = problem_with([0 * x], barriers, ranges=(ends,), noise=(0.1,))
    found = made(problem, samples=256).barriers[0]
    assert found.supremum == pytest.approx(highest, rel=1e-9)
    assert found.growth.startswith(growth)
    assert bool(found.growth) == bool(growth)


def test_the_attained_bound_is_proved():
    problem = system_in_a_box()
    starts = np.array([[0.0], [0.5], [-0.9]])
    attained = 1 - starts[:, 0] ** 2
    bound = made_bound(problem)
    assert bound.shortfall.found == 0.0
    np.testing.assert_allclose(bound.at(starts, 7.0), attained, rtol=2e-3)
    assert (bound.at(starts, 7.0) <= attained).all()
    assert bound.word == "proved"
    forever, repaired = bound.applicable_bounds(starts, 7.0)
    # The condition is met with nothing to spare at x = 0, where no evaluation tells 0 from less.
    assert (forever.status, forever.forever) == ("estimated", True)
    assert "undecided" in forever.reason
    assert repaired.status == "proved"
    assert forever.value >= repaired.value > 0.998 * attained.mean()


def test_bounds_of_several_barriers_are_put_together_by_the_union():
    problem = system_in_a_box(count=2)
    starts = np.array([[0.1, 0.2], [0.7, 0.8], [0.1, 1.1]])
    expected = np.maximum(0.0, (1 - starts**2).sum(axis=1) - 1) * (abs(starts) < 1).all(axis=1)
    bound = made_bound(problem)
    at_starts = bound.at(starts, 3.0)
    np.testing.assert_allclose(at_starts, expected, atol=4e-3)
    assert (at_starts <= expected).all()
    forever, repaired = bound.applicable_bounds(starts, 3.0)
    assert (forever.status, repaired.status) == ("estimated", "proved")
    assert repaired.value == pytest.approx(expected.mean(), abs=4e-3)
    assert all("33.3 % of the starts" in bound.reason for bound in (forever, repaired))


@pytest.mark.parametrize(
    ("env_id", "text", "options", "note"),
    [
        (STOCHASTIC, "hocbf", {}, "ignores the noise"),
        (CUBIC_DISK, "scbf", {"model": {"sigma_1": 0.0}}, "differs from the plant in sigma_1"),
    ],
)
def test_what_has_no_bound_says_why(env_id, text, options, note):
    bound = estimated(env_id, text, **options)
    assert note in bound.note
    starts = starts_of(problem_of(env_id), 4)
    np.testing.assert_array_equal(bound.at(starts, 1.0), np.zeros(4))
    statuses = {b.status for b in bound.applicable_bounds(starts, 1.0)}
    assert statuses <= {"hypothesis fails", "no bound"}


def test_a_start_outside_is_said_to_be():
    found = findings(DUBINS, "hocbf", "plant", samples=512, start="thesis")
    (bound,) = found.guarantee.applicable_bounds(starts_of(found.problem, 1), 1.0)
    assert bound.status == "hypothesis fails"
    assert bound.reason == "the start is outside C_1: b_1 = -1.26"


def test_conditions_without_noise_keep_every_path_if_they_can_be_met():
    found = findings("safe_envs/Scalar-v0", "cbf", noise=0)
    (bound,) = found.guarantee.applicable_bounds(np.array([[0.0], [0.5]]), 1.0)
    assert (bound.status, bound.value) == ("proved", 1.0)
    weak = findings("safe_envs/Scalar-v0", "cbf:alpha=0.5", noise=0, input_bounds=[-0.8, 0.8])
    ((near,), (far,)) = (
        weak.guarantee.applicable_bounds(np.array([[start]]), 1.0) for start in (0.99, 0.0)
    )
    # Missed by .2 at the edge at most: h >= h_0 e^(-t/2) - .4 (1 - e^(-t/2)) is positive up to 1 s
    # from the middle only.
    assert weak.safe_set.shortfall == pytest.approx(0.2)
    assert ("in spite" in near.name, near.value, far.value) == (True, 0.0, 1.0)


def test_a_zeroing_condition_has_a_bound_up_to_a_time():
    for alpha in (0.5, 2.0):
        guarantee = findings(CUBIC_DISK, f"szcbf:alpha={alpha:g}").guarantee
        (bound,) = guarantee.applicable_bounds(np.array([[0.5, 0.0]]), 1.0)
        assert (bound.status, bound.forever) == ("proved", False)
        assert bound.value == pytest.approx(0.75 * math.exp(-alpha))


def test_suprema_of_the_stochastic_dubins():
    found = findings(STOCHASTIC)
    (barrier,) = found.barriers
    r, v, sigma = 3.0, 2.0, 0.2
    # On b_1 >= 0 the centre is just out of reach: -2 v rho cos - 2 sigma^2 >= 0 keeps rho above
    # sigma^2/v.
    np.testing.assert_allclose(
        barrier.suprema, [r**2 - (sigma**2 / v) ** 2, 2 * v * r - 2 * sigma**2], rtol=1e-6
    )
    assert barrier.supremum == pytest.approx(r**2)
    assert found.invariant_set is not None
    assert found.invariant_set.shortfall == pytest.approx(2 * v**2, rel=1e-4)
    # Radially inwards at the distance sqrt(3): m is so large that nothing is left of the union.
    start = np.array([[math.sqrt(3.0), 0.0, math.pi]])
    (repaired,) = found.guarantee.applicable_bounds(start, 5.0)
    assert ("repaired" in repaired.name, repaired.value) == (True, 0.0)


@pytest.mark.parametrize(("width", "scale"), [(50.0, 1.0), (1e12, 1e-6)])
def test_no_box_holds_an_srcbf_under_noise(width, scale):
    problem = problem_with([x], [scale * (1 - x)], noise=(0.2,), input_bounds=(-width, width))
    guarantee = made_bound(problem, "srcbf")
    (bound,) = guarantee.applicable_bounds(np.array([[0.5]]), 1.0)
    assert bound.status == "hypothesis fails"
    assert "unbounded control towards the edge" in bound.reason
    assert "unbounded control towards the edge" in guarantee.note


@pytest.mark.parametrize(
    ("noise", "kept"),
    [(1 - x**2, True), (sp.sqrt(1 - x**2), True), ((1 - x**2) ** sp.Rational(1, 4), False)],
)
def test_an_srcbf_is_kept_where_the_noise_fades_at_the_edge(noise, kept):
    # |sigma' grad h|^2/h is 4 x^2 sigma^2/h, which stays finite for a sigma^2 that falls at least
    # like h.
    problem = problem_with([0 * x], [1 - x**2], noise=(noise,), input_bounds=(-1e6, 1e6))
    assert ("unbounded control" in (made_bound(problem, "srcbf").note or "")) is not kept


def test_equal_formulas_are_the_same_model():
    one = sp.sin(x) ** 2 + sp.cos(x) ** 2
    problem = problem_with([x], [1 - x**2], noise=(0.3,))
    same, other = (
        replace(problem, model=replace(problem.model, drift=[f], diffusion=[s]))
        for f, s in ((x * one, -0.3), (x * one + 1e-9, 0.4))
    )
    assert made_bound(same, "szcbf").note is None
    assert made_bound(other, "szcbf").note == "the model differs from the plant in drift, diffusion"


def test_a_kink_has_no_bound_under_noise():
    barrier = sp.Piecewise((1 - x**2, x > 0), (1 - 2 * x**2, True))
    bound = made_bound(problem_with([0 * x], [barrier], noise=(1.0,)))
    assert bound.note == "h_1 is not twice differentiable, which Ito's formula asks for"
    assert made_bound(problem_with([0 * x], [barrier]), "cbf").note is None


def test_a_range_that_was_chosen_establishes_nothing():
    problem = problem_with(
        [-((y / 15) ** 9), sp.Integer(2)],
        [1 - x**2],
        noise=(0.1, 0.0),
        states=(x, y),
        inputs=((1.0,), (0.0,)),
        ranges=((-2.0, 2.0), (-math.inf, math.inf)),
        start=0.0,
    )
    reason = "looked at only for y in [-10, 10]: the workspace is unbounded"
    guarantee = made_bound(problem, "szcbf:alpha=.1")
    bounds = guarantee.applicable_bounds(np.array([[0.0, 0.0]]), 1.0)
    assert {(b.status, b.reason) for b in bounds} == {("not established", reason)}
    assert guarantee.note == reason


def test_conditions_that_share_several_inputs_have_no_bound():
    problem = system_in_a_box(count=2)
    x_1, x_2 = problem.plant.states
    coupled = replace(
        problem,
        barriers=(Barrier(1 - x_1**2 - x_2**2 / 2, "h_1"), Barrier(1 - x_2**2 - x_1**2 / 2, "h_2")),
    )
    reason = "the shortfall of several conditions together is not established"
    guarantee = made_bound(coupled, seconds=1.0)
    assert guarantee.note == reason
    bounds = guarantee.applicable_bounds(np.array([[0.1, 0.1]]), 1.0)
    assert all(reason in b.reason and b.status not in HOLDING for b in bounds)


@pytest.mark.parametrize(
    ("env_id", "text"), [(CUBIC_DISK, "szcbf:alpha=2"), (STOCHASTIC, "szcbf:alpha=.1,.1")]
)
def test_the_bound_is_the_best_of_those_that_hold(env_id, text):
    guarantee = findings(env_id, text).guarantee
    starts = starts_of(problem_of(env_id), 64)
    for horizon in (0.1, 1.0):
        bounds = guarantee.applicable_bounds(starts, horizon)
        best = max((b.value for b in bounds if b.status in HOLDING), default=0.0)
        assert guarantee.at(starts, horizon).mean() == pytest.approx(best, rel=1e-12)


def test_what_only_seems_infinite_is_said_to():
    problem = problem_with([0 * x], [x / (x + 50)], noise=(0.1,), ranges=((0.0, math.inf),))
    assert (
        made_bound(problem).note
        == "sup h_1 seems infinite: it grows with the ranges that are searched"
    )


def test_starts_that_are_inside_of_one_set_each_are_said_to_be():
    found = findings(STOCHASTIC)
    # Outwards near the middle, and inwards beyond the disk.
    (bound,) = found.guarantee.applicable_bounds(
        np.array([[2.0, 0.0, 0.0], [3.5, 0.0, math.pi]]), 5.0
    )
    assert (bound.status, bound.reason) == ("hypothesis fails", "no start lies in all C_j at once")


def test_the_error_of_a_mean_is_known():
    found = findings(CUBIC_DISK)
    starts = starts_of(found.problem, 256)
    (bound,) = found.guarantee.applicable_bounds(starts, 1.0)
    values = (1.0 - (starts**2).sum(axis=1) - 0.08).clip(0.0)
    assert bound.error == pytest.approx(values.std(ddof=1) / 16, rel=1e-3)
    (one,) = found.guarantee.applicable_bounds(starts[:1], 1.0)
    assert one.error == 0.0


def crowd(noise):
    """Return four robots in the plane on a circle, with a barrier for each pair."""
    x, u = sp.symbols("x:8", real=True), sp.symbols("u:8", real=True)
    system = ControlAffineSDE.from_rate(x, u, u, diffusion=noise * sp.eye(8))
    barriers = [
        (x[2 * i] - x[2 * j]) ** 2 + (x[2 * i + 1] - x[2 * j + 1]) ** 2 - 0.09
        for i, j in itertools.combinations(range(4), 2)
    ]
    angles = 2.0 * np.pi * np.arange(4) / 4
    start = 2.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1).ravel()
    return define_problem(
        system,
        barriers,
        input_bounds=(-1.0, 1.0),
        start=start.tolist(),
        dt=0.05,
        horizon=5.0,
        workspace=dict.fromkeys(x, (-4, 4)),
    )


def test_a_bound_of_0_at_the_starts_is_said_at_once():
    assert made_bound(crowd(0.05), seconds=6.0).note == "it is 0 at these starts up to this horizon"


def test_search_and_judge_end_with_their_time():
    begun = time.process_time()
    found = made_bound(crowd(0.0), "cbf:alpha=2", seconds=0.2)
    assert found.note == "the shortfall of several conditions together is not established"
    verdict = found.proof.feasible
    assert (verdict.word, "boxes are left after" in verdict.reason) == ("undecided", True)
    assert time.process_time() - begun < 10.0


def test_what_is_decided_in_time_is_the_same():
    problem, starts = problem_of(CUBIC_DISK), np.array([[-0.1, 0.7]])
    values = [made_bound(problem, seconds=each).at(starts, 1.0) for each in (None, 60.0)]
    assert values[0] == values[1] > 0.0
