"""No bound stands beside episodes that contradict it: systems for which one once did."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp
from scipy.stats import binom

from safe_envs import ControlAffineSDE, state_problem
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation import evaluate as evaluation
from safe_envs.agents.evaluation import safety_chain
from safe_envs.agents.evaluation.bounds import (
    above_attainable,
    by_rate,
    end_for,
    judged,
    upper_ends,
)
from safe_envs.agents.evaluation.evaluate import refine
from safe_envs.agents.evaluation.rows import BoundSummary, PosteriorSummary
from safe_envs.filters.learning.bayesian import identify
from safe_envs.proofs import analysis, guarantees
from safe_envs.proofs.feasibility import verify
from safe_envs.proofs.judge import JudgeResult, Supremum
from safe_envs.wrappers import parse_conditions
from tests.oracles import false_bounds

pytestmark = pytest.mark.filterwarnings("ignore::safe_envs.errors.SystemDefinitionWarning")
FALSE = [
    (
        false_bounds.kink,
        "szcbf:alphas=0.1",
        "h is not twice differentiable",
        "withheld: the interval of the measured rate ends at",
    ),
    (
        false_bounds.pole,
        "cbf:alpha=1",
        "h has a pole near",
        "it is 0 at these starts",
    ),
    (
        false_bounds.island,
        "scbf",
        "no action meets the condition somewhere, by up to",
        "no action meets the condition somewhere, by up to",
    ),
    (
        false_bounds.rotated,
        "cbf:alpha=0.1",
        "no action meets the condition somewhere, by up to",
        "that an action meets the condition everywhere is not proved",
    ),
]
HORIZON = 0.5


@pytest.fixture
def credulous(monkeypatch):
    """A search that knows neither of poles and kinks nor of the starts, and that is cut short: it
    finds what was found before."""
    monkeypatch.setattr(analysis, "roughness", lambda *_: "")
    monkeypatch.setattr(analysis.SafeSetAnalysis, "with_starts", lambda _, points, level: points)


@pytest.fixture
def undecided(monkeypatch):
    """A judge that decides nothing but that C is bounded."""
    verdict = JudgeResult("undecided", 0, reason="not looked at")
    monkeypatch.setattr(guarantees, "judge", lambda *_: verdict)
    monkeypatch.setattr(
        guarantees, "supremum", lambda *_: Supremum(math.inf, -math.inf, None, 0, "not looked at")
    )


@pytest.mark.parametrize(("make", "text", "reason"), [case[:3] for case in FALSE])
def test_false_bounds_are_not_estimated(make, text, reason):
    (row,) = evaluate(make(), filters=text, episodes=40).rows
    assert row.safety_rate < 0.2
    assert row.continuous_bound is None
    assert row.continuous_note.startswith(reason)


@pytest.mark.parametrize(("make", "text", "reason"), [(*case[:2], case[3]) for case in FALSE])
@pytest.mark.usefixtures("credulous")
def test_what_the_search_misses_the_judge_finds_or_the_episodes_contradict(make, text, reason):
    (row,) = evaluate(make(), filters=text, episodes=40).rows
    assert row.continuous_bound is None
    assert row.continuous_note.startswith(reason)
    withheld = row.continuous_word == "withheld"
    assert withheld == (row.withheld is not None) == reason.startswith("withheld")


@pytest.mark.parametrize(
    ("make", "text", "reason"),
    [
        (*FALSE[2][:2], "h reaches 28.66, above the supremum of 1 that"),
        (*FALSE[3][:2], "the filter violated the condition by"),
    ],
)
@pytest.mark.usefixtures("credulous", "undecided")
def test_what_search_and_judge_miss_the_episodes_contradict(make, text, reason):
    (row,) = evaluate(make(), filters=text, episodes=40).rows
    assert (row.continuous_bound, row.continuous_word) == (None, "withheld")
    assert row.withheld.startswith(reason)
    assert row.continuous_note == f"withheld: {row.withheld}"


def test_margins_of_first_order_of_several_conditions_leave_no_bound():
    (row,) = evaluate(
        false_bounds.corridor(), filters="cbf:alpha=10:sampling_margin=first-order", episodes=2
    ).rows
    assert (row.infeasible_rate, row.safe) == (0.0, 2)
    assert (row.continuous_bound, row.continuous_note) == (
        None,
        "the shortfall of several conditions together is not established",
    )
    (plain,) = evaluate(
        false_bounds.corridor(), filters="cbf:alpha=10", episodes=2, options=None
    ).rows
    assert plain.infeasible_rate == 0.0


@pytest.mark.filterwarnings("ignore::safe_envs.filters.learning.bayesian.IdentifiabilityWarning")
def test_a_bound_over_a_posterior_sees_a_hidden_kink(monkeypatch):
    problem = false_bounds.kink()
    name = "bayesian-scbf:simultaneous=0.9"
    learned = identify(problem, starts=100, repetitions=30, degree=1)
    (row,) = evaluate(problem, filters=[name], learned=[learned], episodes=40).rows
    assert row.posterior_bound.probability is None
    assert row.posterior_bound.note.startswith(
        "h is not twice differentiable, which Ito's formula asks for, near x = "
    )
    monkeypatch.setattr("safe_envs.proofs.posterior.roughness", lambda *_: "")
    (row,) = evaluate(problem, filters=[name], learned=[learned], episodes=40).rows
    assert row.posterior_bound.probability is None
    # The judge looks at the kink, where the condition has no value.
    assert "has no finite value at x = 0" in row.posterior_bound.note


@pytest.mark.slow
@pytest.mark.usefixtures("credulous")
def test_nothing_converges_beside_a_bound_that_is_contradicted():
    answer = refine(false_bounds.kink(), filters=["none", "szcbf:alphas=0.1"], episodes=100)
    bare, filtered = answer.rows
    assert bare.verdict != "contradicted"
    assert (filtered.verdict, bool(filtered.withheld)) == ("contradicted", True)
    # The change itself is small enough for the other verdict.
    assert max(-filtered.change_low, filtered.change_high) < 0.1


@pytest.mark.slow
@pytest.mark.usefixtures("credulous", "undecided")
def test_a_verification_withholds_what_its_simulation_contradicts(monkeypatch):
    monkeypatch.setattr(safety_chain, "_MULTIPLES", (1,))
    monkeypatch.setattr(safety_chain, "_LONG_MULTIPLES", ())
    for make, text in ((false_bounds.island, "scbf"), (false_bounds.rotated, "cbf:alpha=0.1")):
        problem = make()
        found = verify(problem, parse_conditions(text, problem), samples=1024)
        inside = found.analysis.safe.points[:1]
        bounds = found.guarantee.applicable_bounds(inside, problem.duration)
        assert "estimated" in {bound.status for bound in bounds}
        bounds, measurements = safety_chain.withhold_contradicted(
            bounds, safety_chain.measure(found, episodes=40), found
        )
        assert all(bound.value is None for bound in bounds if bound.status == "withheld")
        assert {bound.status for bound in bounds} <= {"withheld", "hypothesis fails"}
        horizons = [bound for m in measurements for h in m.horizons for bound in h.bounds]
        assert all(bound.value is None for bound in horizons if bound.status == "withheld")
        assert "estimated" not in {bound.status for bound in horizons}


@pytest.mark.usefixtures("undecided")
def test_a_start_above_a_supremum_withholds_at_once(monkeypatch):
    monkeypatch.setattr(analysis.SafeSetAnalysis, "with_starts", lambda _, points, level: points)
    problem = false_bounds.island()
    found = verify(problem, parse_conditions("scbf", problem), samples=512)
    bounds = found.guarantee.applicable_bounds(np.array([[1.5, 0.3]]), HORIZON)
    assert {bound.status for bound in bounds} == {"hypothesis fails", "withheld"}
    assert all(
        "above the supremum" in bound.reason for bound in bounds if bound.status == "withheld"
    )


def test_a_rate_with_a_smaller_period_withholds_too():
    (row,) = evaluate("Scalar-v0", filters="scbf", episodes=2, bounds=False).rows
    row = replace(row, continuous_bound=0.5, continuous_word="estimated", continuous_note="")
    spec = SimpleNamespace(confidence=0.95)
    finer = [
        SimpleNamespace(
            spec=spec, row=lambda _, safe=safe: replace(row, safe=safe, episodes=10_000)
        )
        for safe in (5000, 3000)
    ]
    assert evaluation._judged(row, finer[:1]) == row
    assert evaluation._judged(row, finer).withheld.startswith(
        "the interval of the measured rate ends at 31.0 %, below 50.0 %"
    )
    # What is of the env's own steps is of its own period.
    held = replace(row, continuous_bound=None, held_bound=0.5, held_word="proved")
    assert evaluation._judged(held, finer) == held


def test_a_start_counts_at_every_stage_of_a_chain(monkeypatch, request):
    """h = 1 + x and b_1 = v + .1 h: a start with a large v brakes, so that no later state has as
    large a b_1."""
    x, v, u = sp.symbols("x v u", real=True)
    system = ControlAffineSDE.from_rate((x, v), (u,), [v, u], diffusion=[0, 0.01])
    problem = state_problem(
        system,
        [1 + x],
        box=(-9, 9),
        workspace={x: (-1, 1), v: (-1, 1)},
        start=(0.0, 0.9),
        dt=0.05,
        horizon=1.0,
        nominal=-5,
    )
    (row,) = evaluate(problem, filters="szcbf:alphas=0.1,0.1", episodes=20).rows
    assert (row.continuous_bound, row.withheld) == (
        pytest.approx((1 / 2 + 1 / 1.2) * np.exp(-0.1) - 1, abs=1e-3),
        None,
    )
    assert row.continuous_word == "proved"
    monkeypatch.setattr(analysis.SafeSetAnalysis, "suprema", np.array([2.0, 0.8]))
    request.getfixturevalue("undecided")
    (row,) = evaluate(problem, filters="szcbf:alphas=0.1,0.1", episodes=20).rows
    assert row.withheld == "b_1 reaches 1, above the supremum of 0.8 that the search found"


@pytest.mark.parametrize(
    ("bound", "high", "reason"),
    [(0.5, 0.5, ""), (0.5, 0.49, "ends at 49.0 %, below 50.0 %"), (None, 0.1, "")],
)
def test_an_interval_contradicts_a_bound_that_is_wholly_above_it(bound, high, reason):
    assert reason in by_rate(bound, high)
    assert bool(by_rate(bound, high)) == bool(reason)
    for row in (
        BoundSummary(continuous_bound=bound, continuous_word="estimated"),
        BoundSummary(held_bound=bound, held_word="proved"),
    ):
        assert (judged(row, high, high) == row) == (not reason)


def test_what_is_proved_is_contradicted_by_chance_as_seldom_as_it_says():
    counts = np.arange(1001)
    ends = np.array([upper_ends(int(safe), 1000, 0.95) for safe in counts])
    for unsafe in np.geomspace(1e-6, 0.9, 40):
        bound, chance = 1.0 - unsafe, binom.pmf(counts, 1000, 1.0 - unsafe)
        for word, most in (("proved", 5e-4), ("certified", 5e-4), ("computed", 0.025)):
            against = [bool(by_rate(bound, end_for(word, *each))) for each in ends]
            assert chance[against].sum() <= most * (1.0 + 1e-9)


def test_a_contradiction_shows_numbers_that_differ():
    assert "ends at 99.991 %, below 99.993 %" in by_rate(0.99993, 0.999905)


def test_one_claim_is_withheld_without_the_other():
    row = BoundSummary(
        held_bound=0.9, held_word="proved", continuous_bound=0.4, continuous_word="estimated"
    )
    found = judged(row, 0.85, 0.85)
    assert (found.held_bound, found.held_word, found.held_error) == (None, "withheld", 0.0)
    assert found.held_note == f"withheld: {found.withheld}"
    assert "report an error" in found.withheld
    assert (found.continuous_bound, found.continuous_word) == (0.4, "estimated")
    both = judged(replace(row, continuous_bound=0.95), 0.85, 0.85)
    assert (both.held_word, both.continuous_word) == ("withheld", "withheld")
    other = judged(replace(row, continuous_bound=0.95), 0.92, 0.92)
    assert (other.held_bound, other.continuous_word) == (0.9, "withheld")
    assert "try a smaller dt" in other.withheld


@pytest.mark.parametrize("word", ["proved", "certified", "computed"])
def test_what_is_proved_is_held_against_a_wider_interval(word):
    sure = word != "computed"
    row = BoundSummary(held_bound=0.9, held_word=word)
    assert (judged(row, 0.89, 0.91) == row) == sure
    assert judged(row, 0.89, 0.895).held_word == "withheld"
    given = {"continuous_bound": 0.9, "continuous_word": "proved" if sure else "estimated"}
    assert (judged(BoundSummary(**given), 0.89, 0.91).continuous_bound == 0.9) == sure


def test_a_held_bound_above_what_is_attainable_is_a_contradiction():
    row = BoundSummary(held_bound=0.9, held_word="computed", held_error=0.01)
    assert above_attainable(row, None) == ""
    assert above_attainable(row, 0.88) == ""
    assert "90.0 %, is above what any policy can attain, 86.0 %" in above_attainable(row, 0.86)
    assert above_attainable(BoundSummary(), 0.1) == ""


def test_a_posterior_keeps_its_numbers_where_its_bound_is_withheld():
    bound = PosteriorSummary(0.9, "", "estimated", delta=0.1)
    row = BoundSummary(continuous_note="learned", posterior_bound=bound)
    found = judged(row, 0.2, 0.2)
    note = f"withheld: {found.withheld}"
    assert found.posterior_bound == PosteriorSummary(None, note, "withheld", delta=0.1)
    assert found.continuous_note == "learned"
