"""What `verify` finds by itself, against what is known of the systems."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs.barrier import Barrier
from safe_envs.errors import ConfigurationError
from safe_envs.problem import SafetyProblem, Start, Variable
from safe_envs.sde import ControlAffineSDE
from tests.conftest import problem_of
from wrappers import parse_conditions
from wrappers.formulas import Formulas
from wrappers.promise import best_start, promise
from wrappers.proved import proved_bound
from wrappers.safe_set import draw_starts, largest, region_of, sample
from wrappers.verify import verify

STATUSES = {"proved", "hypothesis fails", "no bound", "unproved"}
DUBINS = "safe_envs/DubinsDisk-v0"
STOCHASTIC = "safe_envs/StochasticDubins-v0"
CUBIC_DISK = "safe_envs/CubicSDEDisk-v0"


def findings(env_id, text=None, knowledge="model", **options):
    problem = problem_of(env_id, **options)
    return verify(problem, parse_conditions(text or problem.filter, problem), knowledge)


def proved(env_id, text=None, knowledge="model", **options):
    problem = problem_of(env_id, **options)
    return proved_bound(problem, parse_conditions(text or problem.filter, problem), knowledge)


def by_name(bounds, part):
    (found,) = [b for b in bounds if part in b.name]
    return found


def system_in_a_box(count=1, high=5.0, noise=0.6, half_width=1.0):
    """dx_i = u_i dt + s x_i dW_i with h_i = 1 - x_i^2: the bound h/c is attained."""
    x, u = sp.symbols(f"x_1:{count + 1}", real=True), sp.symbols(f"u_1:{count + 1}", real=True)
    s = sp.Symbol("s", real=True)
    system = ControlAffineSDE(x, u, [0] * count, sp.eye(count), sp.diag(*[s * xi for xi in x]), {s: noise})
    return SafetyProblem(
        name="box",
        plant=system,
        model=system,
        barriers=tuple(Barrier(half_width**2 - xi**2, f"h_{i}") for i, xi in enumerate(x, start=1)),
        states=tuple(Variable(xi, -2.0, 2.0) for xi in x),
        inputs=tuple(Variable(ui, -high, high) for ui in u),
        reward=sp.Integer(0),
        nominal=(sp.Integer(0),) * count,
        starts={"middle": Start.at((0.3,) * count)},
        dt=0.01,
        horizon=1.0,
        noise=("s",),
        filter="scbf",
    )


def test_radial_headings_leave_the_dubins_disk_without_control():
    (barrier,) = (found := findings(DUBINS)).barriers
    x, y, theta = barrier.leading_at
    assert barrier.degree == 2
    assert barrier.vanishes
    assert abs(x * math.sin(theta) - y * math.cos(theta)) < 1e-6
    assert 0.0 < barrier.small < 0.02
    assert barrier.small_infeasible > 0.1
    # Outward and radial on b_1 = 0 it is missed most: rho solves 1 - rho^2 = 2 v rho, and the row is -2 v (v + rho).
    v = 0.5
    rho = -v + math.sqrt(v * v + 1)
    assert found.kept is not None
    assert found.kept.shortfall == pytest.approx(2 * v * (v + rho), rel=1e-6)
    assert 0.01 < found.kept.infeasible < 0.1


@pytest.mark.parametrize(("rates", "missed"), [("1,1", 2 * 0.8**2 - 1), ("1,2", 0.0)])
def test_the_centre_of_the_dubins_disk_needs_large_rates(rates, missed):
    (barrier,) = findings(DUBINS, f"hocbf:p={rates}", "plant").barriers
    np.testing.assert_allclose(barrier.deepest[:2], 0.0, atol=1e-4)
    assert barrier.deepest_shortfall == pytest.approx(missed, abs=1e-5)


def test_scbf_fails_near_the_centre_of_the_cubic_disk():
    found = findings(CUBIC_DISK)
    (barrier,) = found.barriers
    assert barrier.deepest_shortfall == pytest.approx(0.08, abs=1e-9)
    np.testing.assert_allclose(found.safe.worst, 0.0, atol=1e-4)
    assert found.safe is found.kept
    assert found.safe.shortfall == pytest.approx(0.08)
    bounds = promise(found, np.array([[-0.1, 0.7]]), 1.0)
    assert by_name(bounds, "4.2.8").status == "hypothesis fails"
    assert by_name(bounds, "4.2.8").value == pytest.approx(0.5)
    assert by_name(bounds, "repaired").status == "proved"
    assert by_name(bounds, "repaired").value == pytest.approx(0.42)


@pytest.mark.parametrize("name", ["ACC", "CubicSDE", "ACCGap", "Scalar"])
def test_unbounded_barriers_have_no_bound(name):
    found = findings(f"safe_envs/{name}-v0")
    assert math.isinf(found.barriers[0].supremum)
    assert found.beyond
    (bound,) = promise(found, draw_starts(found.formulas.problem, 8), 1.0)
    assert (bound.status, bound.value, bound.reason) == ("no bound", None, "sup h is infinite")
    assert proved(f"safe_envs/{name}-v0").note == "sup h is infinite"


def test_suprema_and_the_product_bound_of_the_stochastic_dubins():
    found = findings(STOCHASTIC)
    (barrier,) = found.barriers
    r, v, sigma = 3.0, 2.0, 0.2
    # On b_1 >= 0 the centre is just out of reach: -2 v rho cos - 2 sigma^2 >= 0 keeps rho above sigma^2/v.
    np.testing.assert_allclose(barrier.suprema, [r**2 - (sigma**2 / v) ** 2, 2 * v * r - 2 * sigma**2], rtol=1e-6)
    assert barrier.supremum == pytest.approx(r**2)
    assert found.kept is not None
    assert found.kept.shortfall == pytest.approx(2 * v**2, rel=1e-4)
    start = best_start(found)
    assert start is not None
    assert math.hypot(*start[:2]) == pytest.approx(math.sqrt(3.0), abs=0.02)
    bounds = promise(found, start[None], 5.0)
    assert by_name(bounds, "product").value == pytest.approx(0.383, abs=1e-3)
    assert "conditions on the future" in by_name(bounds, "product").reason
    assert by_name(bounds, "union").value < by_name(bounds, "product").value
    assert by_name(bounds, "repaired").value == 0.0


def test_the_attained_bound_is_proved():
    problem = system_in_a_box()
    conditions = parse_conditions("scbf", problem)
    found = verify(problem, conditions)
    assert found.safe.shortfall == found.safe.infeasible == 0.0
    starts = np.array([[0.0], [0.5], [-0.9]])
    np.testing.assert_allclose(proved_bound(problem, conditions).at(starts, 7.0), 1 - starts[:, 0] ** 2, rtol=1e-9)
    (bound,) = promise(found, starts, 7.0)
    assert (bound.status, bound.forever) == ("proved", True)
    assert bound.value == pytest.approx((1 - starts**2).mean())


def test_a_narrow_box_leaves_a_shortfall():
    # Largest at x = 1: A h = -2 x u - s^2 x^2, with |u| <= .1 and s = .6.
    problem = system_in_a_box(high=0.1)
    found = verify(problem, parse_conditions("scbf", problem))
    assert found.safe.shortfall == pytest.approx(0.6**2 - 0.2, abs=1e-6)
    assert found.safe.infeasible == pytest.approx(1 - 0.2 / 0.36, abs=0.01)


def test_bounds_of_several_barriers_are_put_together_by_the_union():
    problem = system_in_a_box(count=2)
    conditions = parse_conditions("scbf", problem)
    starts = np.array([[0.1, 0.2], [0.7, 0.8], [0.1, 1.1]])
    expected = np.maximum(0.0, (1 - starts**2).sum(axis=1) - 1) * (abs(starts) < 1).all(axis=1)
    np.testing.assert_allclose(proved_bound(problem, conditions).at(starts, 3.0), expected, atol=1e-8)
    (bound,) = promise(verify(problem, conditions, samples=500), starts, 3.0)
    assert (bound.status, bound.value) == ("proved", pytest.approx(expected.mean(), abs=1e-8))
    assert "33.3 % of the starts" in bound.reason


def test_conflicting_barriers_are_found_to_be_infeasible_together():
    problem = system_in_a_box()
    (x,) = problem.plant.states
    apart = replace(problem, barriers=(Barrier(1 - x, "right"), Barrier(1 + x, "left")), gains=(0.1,))
    # -u + .1 (1 - x) >= m and u + .1 (1 + x) >= m add up to .2 >= 2 m: for m = .5 each can be met, but not both.
    margin = parse_conditions("cbf:alpha=0.1:sampling_margin=0.5", apart)
    found = verify(apart, margin, samples=500)
    assert found.safe.infeasible == 1.0
    assert found.safe.shortfall >= 0.4 - 1e-6
    assert verify(apart, parse_conditions("cbf:alpha=0.1", apart), samples=500).safe.infeasible == 0.0


@pytest.mark.parametrize(
    ("arguments", "note"),
    [
        ((STOCHASTIC, "hocbf"), "hocbf ignores the noise"),
        ((CUBIC_DISK, "cbf"), "cbf ignores the noise"),
        ((DUBINS, "hocbf"), "the model differs from the plant in v"),
        ((CUBIC_DISK, "srcbf"), "unbounded control towards the edge"),
    ],
)
def test_what_has_no_proved_bound_says_why(arguments, note):
    bound = proved(*arguments)
    assert bound.note is not None
    assert note in bound.note
    starts = draw_starts(problem_of(arguments[0]), 4)
    np.testing.assert_array_equal(bound.at(starts, 1.0), np.zeros(4))


def test_a_model_without_the_noise_breaks_the_hypothesis():
    bound = proved("safe_envs/CubicSDEDisk-v0", "scbf", model={"sigma_1": 0.0})
    assert bound.note == "the model differs from the plant in sigma_1"
    found = findings(CUBIC_DISK, "scbf", model={"sigma_1": 0.0})
    statuses = {b.status for b in promise(found, np.array([[0.1, 0.1]]), 1.0)}
    assert statuses == {"hypothesis fails"}


def test_a_start_outside_is_said_to_be():
    found = findings(DUBINS, "hocbf", "plant", start="thesis")
    (bound,) = promise(found, draw_starts(found.formulas.problem, 1), 1.0)
    assert bound.status == "hypothesis fails"
    assert bound.reason == "the start is outside C_1: b_1 = -1.26"


def test_conditions_without_noise_keep_every_path_if_they_can_be_met():
    found = findings("safe_envs/Scalar-v0", "cbf", noise=0)
    (bound,) = promise(found, np.array([[0.0], [0.5]]), 1.0)
    assert (bound.status, bound.value) == ("proved", 1.0)
    weak = findings("safe_envs/Scalar-v0", "cbf:alpha=0.5", noise=0, box=[-0.8, 0.8])
    near, far = promise(weak, np.array([[0.99]]), 1.0), promise(weak, np.array([[0.0]]), 1.0)
    assert by_name(near, "for sure").status == "hypothesis fails"
    # Missed by .2 at the edge at most: h >= h_0 e^(-t/2) - .4 (1 - e^(-t/2)) is positive up to 1 s from the middle only.
    assert weak.safe.shortfall == pytest.approx(0.2)
    assert (by_name(near, "in spite").value, by_name(far, "in spite").value) == (0.0, 1.0)


def test_zeroing_forms_and_the_misprint():
    bounds = promise(findings(CUBIC_DISK, "szcbf:alphas=2"), np.array([[0.5, 0.0]]), 1.0)
    assert by_name(bounds, "as printed").status == "unproved"
    assert by_name(bounds, "as printed").value == pytest.approx(0.75 * math.exp(-1.0))
    assert by_name(bounds, "corrected").status == "proved"
    assert by_name(bounds, "corrected").value == pytest.approx(0.75 * math.exp(-2.0))
    slow = promise(findings(CUBIC_DISK, "szcbf:alphas=0.5"), np.array([[0.5, 0.0]]), 1.0)
    assert by_name(slow, "as printed").value < by_name(slow, "corrected").value
    assert by_name(slow, "as printed").status == by_name(slow, "corrected").status


def test_every_id_is_verified(env_id):
    problem = problem_of(env_id)
    conditions = parse_conditions(problem.filter, problem)
    found = verify(problem, conditions, samples=512)
    assert len(found.barriers) == len(problem.barriers)
    for barrier in found.barriers:
        assert 0.0 <= barrier.leading <= barrier.typical < math.inf
        assert 0.0 <= barrier.small <= 1.0
        assert math.isfinite(barrier.deepest_h)
        assert barrier.deepest_shortfall >= 0.0
        assert barrier.suprema.shape == (barrier.degree,)
        assert barrier.deepest.shape == barrier.leading_at.shape == (problem.plant.n,)
    for part in (found.safe, found.kept):
        assert part is not None
        assert 0.0 < part.share <= 1.0
        assert 0.0 <= part.infeasible <= 1.0
        assert 0.0 <= part.shortfall < math.inf
        assert found.formulas.barrier_level(part.worst[None])[0] >= 0.0
    bounds = promise(found, draw_starts(problem, 16), problem.horizon)
    assert bounds
    for bound in bounds:
        assert bound.status in STATUSES
        assert bound.value is None or 0.0 <= bound.value <= 1.0
        assert bound.reason or bound.status == "proved"


def test_every_id_has_a_proved_bound_or_a_note(env_id):
    problem = problem_of(env_id)
    conditions = parse_conditions(problem.filter, problem)
    first, again = (proved_bound(problem, conditions) for _ in range(2))
    starts = draw_starts(problem, 16)
    values = first.at(starts, problem.horizon)
    assert values.shape == (16,)
    assert ((values >= 0.0) & (values <= 1.0)).all()
    assert first.note == again.note
    np.testing.assert_array_equal(values, again.at(starts, problem.horizon))
    assert first.note is None or not values.any()


def test_infeasibility_and_shortfall_are_those_of_the_filter():
    problem = problem_of(STOCHASTIC)
    formulas = Formulas(problem, parse_conditions("scbf", problem), "model")
    rng = np.random.default_rng(3)
    x = rng.uniform(-2.0, 2.0, (500, 3))
    result = formulas.safety_filter.filter(x, rng.uniform(-10.0, 10.0, (500, 1)))
    missed = formulas.missed(x)[:, 0]
    np.testing.assert_array_equal(missed > 0.0, ~result.feasible)
    np.testing.assert_allclose(np.maximum(missed, 0.0), result.slack[:, 0])
    assert 0 < (missed > 0.0).sum() < 500


def test_results_depend_on_the_seed_alone():
    problem = problem_of(CUBIC_DISK)
    conditions = parse_conditions("scbf", problem)
    first, again, other = (verify(problem, conditions, samples=256, seed=seed) for seed in (1, 1, 2))
    assert first.safe.infeasible == again.safe.infeasible
    np.testing.assert_array_equal(first.safe.worst, again.safe.worst)
    assert first.safe.points != other.safe.points or not np.array_equal(first.safe.worst, other.safe.worst)


def test_a_tiny_safe_set_is_found():
    problem = replace(system_in_a_box(count=3, half_width=0.004), starts={"middle": Start.at((0.0, 0.0, 0.0))})
    formulas = Formulas(problem, parse_conditions("scbf", problem), "model")
    region = region_of(problem, formulas.system, formulas.expressions)
    found = sample("C", formulas.barrier_level, region, 256, np.random.default_rng(0))
    assert len(found.points) >= 256
    # All of it, not the part where the search arrived.
    assert abs(found.points).max(axis=0) == pytest.approx([0.004] * 3, rel=0.1)


def test_an_empty_safe_set_is_an_error():
    problem = system_in_a_box()
    (x,) = problem.plant.states
    with pytest.raises(ConfigurationError, match="no point of C was found"):
        verify(replace(problem, barriers=(Barrier(-1 - x**2),)), parse_conditions("scbf", problem))


def test_ranges_of_unbounded_states():
    problem = problem_of(STOCHASTIC)
    theta = problem.plant.states[2]
    periodic = region_of(problem, problem.plant, [sp.cos(theta)])
    assert periodic.periodic.tolist() == [False, False, True]
    assert periodic.high[2] - periodic.low[2] == pytest.approx(2 * math.pi)
    assert "a period" in periodic.notes[0]
    grown = region_of(problem, problem.plant, [theta])
    assert not grown.periodic.any()
    assert grown.high[2] - grown.low[2] > 20.0
    assert "its workspace is unbounded" in grown.notes[0]
    wider = periodic.scaled(10.0)
    assert wider.high[0] == pytest.approx(60.0)
    assert wider.high[2] == periodic.high[2]


def test_search_follows_a_ridge_to_a_corner():
    problem = problem_of(CUBIC_DISK)
    formulas = Formulas(problem, parse_conditions("scbf", problem), "model")
    region = region_of(problem, formulas.system, formulas.expressions)
    rng = np.random.default_rng(0)

    def score(x):
        return np.where(x[:, 0] + x[:, 1] <= 1.0, x[:, 0] - 100 * abs(x[:, 1] - 0.25), -np.inf)

    value, state = largest(score, region.draw(8, rng), region, rng)
    np.testing.assert_allclose(state, [0.75, 0.25], atol=1e-6)
    assert value == pytest.approx(0.75, abs=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_search_reaches_a_whole_ridge(seed):
    problem = problem_of(STOCHASTIC)
    region = region_of(problem, problem.plant, [])
    rng = np.random.default_rng(seed)

    def score(x):
        return -abs(x[:, 0] * np.sin(x[:, 2]) - x[:, 1] * np.cos(x[:, 2]))

    assert largest(score, region.draw(12, rng), region, rng)[0] > -1e-9


@pytest.mark.parametrize("arguments", [{"samples": 0}, {"samples": 1.5}, {"seed": -1}, {"knowledge": "guess"}])
def test_arguments_out_of_range_are_refused(arguments):
    problem = problem_of(CUBIC_DISK)
    with pytest.raises(ConfigurationError):
        verify(problem, parse_conditions("scbf", problem), **arguments)
