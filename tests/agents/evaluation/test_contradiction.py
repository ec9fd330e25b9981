"""No bound stands beside episodes that contradict it: systems for which one once did."""

from __future__ import annotations

import bisect
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp
from scipy.stats import binom

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation import bounds, safety_chain
from safe_envs.agents.evaluation import evaluate as evaluation
from safe_envs.agents.evaluation.bounds import judged, upper_ends
from safe_envs.agents.evaluation.evaluate import refine
from safe_envs.agents.evaluation.rows import BoundSummary, PosteriorSummary
from safe_envs.filters.learning.bayesian import identify
from safe_envs.proofs import analysis, guarantees
from safe_envs.proofs.feasibility import verify
from safe_envs.proofs.judge import JudgeResult, Supremum
from safe_envs.wrappers import parse_conditions
from tests.oracles import false_bounds

pytestmark = pytest.mark.filterwarnings("ignore::safe_envs.errors.SystemDefinitionWarning")
HORIZON = 0.5
slow_search = pytest.mark.oracle
"""For searches of several seconds; others are left that show the same."""


def false(make, text, reason, *marks):
    return pytest.param(make, text, reason, marks=marks, id=make.__name__)


@pytest.fixture
def credulous(monkeypatch):
    """A search that knows neither of poles and kinks nor of the starts, and that is cut short: it
    finds what was found before."""
    monkeypatch.setattr(bounds, "SECONDS", 0.5)
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


@pytest.mark.parametrize(
    ("make", "text", "reason"),
    [
        false(false_bounds.kink, "szcbf:alpha=0.1", "h is not twice differentiable"),
        false(false_bounds.pole, "cbf:alpha=1", "h has a pole near"),
        false(false_bounds.island, "scbf", "no action meets the condition"),
        false(false_bounds.rotated, "cbf:alpha=0.1", "no action meets the condition", slow_search),
    ],
)
def test_false_bounds_are_not_estimated(make, text, reason):
    (row,) = evaluate(make(), filters=text, episodes=40).rows
    assert row.safety_rate < 0.2
    assert row.continuous_bound is None
    assert row.continuous_note.startswith(reason)


@pytest.mark.parametrize(
    ("make", "text", "reason"),
    [
        false(false_bounds.kink, "szcbf:alpha=0.1", "withheld: the interval of the measured rate"),
        false(false_bounds.pole, "cbf:alpha=1", "it is 0 at these starts", slow_search),
        false(false_bounds.island, "scbf", "no action meets the condition"),
        false(false_bounds.rotated, "cbf:alpha=0.1", "that an action meets the", slow_search),
    ],
)
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
        false(false_bounds.island, "scbf", "h reaches 28.66, above the supremum of 1"),
        false(false_bounds.rotated, "cbf:alpha=0.1", "the filter violated the condition by"),
    ],
)
@pytest.mark.usefixtures("credulous", "undecided")
def test_what_search_and_judge_miss_the_episodes_contradict(make, text, reason):
    (row,) = evaluate(make(), filters=text, episodes=40).rows
    assert (row.continuous_bound, row.continuous_word) == (None, "withheld")
    assert row.withheld.startswith(reason)
    assert row.continuous_note == f"withheld: {row.withheld}"


def test_margins_of_first_order_of_several_conditions_leave_no_bound():
    name = "cbf:alpha=10:sampling_margin=first-order"
    (row,) = evaluate(false_bounds.corridor(), filters=name, episodes=2).rows
    assert (row.infeasible_rate, row.safe, row.continuous_bound) == (0.0, 2, None)
    assert "of several conditions together" in row.continuous_note


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


@pytest.mark.usefixtures("credulous")
def test_nothing_converges_beside_a_bound_that_is_contradicted():
    answer = refine(false_bounds.kink(), filters=["none", "szcbf:alpha=0.1"], episodes=100)
    bare, filtered = answer.rows
    assert bare.verdict != "contradicted"
    assert (filtered.verdict, bool(filtered.withheld)) == ("contradicted", True)
    # The change itself is small enough for the other verdict.
    assert max(-filtered.change_low, filtered.change_high) < 0.1


@pytest.mark.usefixtures("credulous", "undecided")
def test_a_verification_withholds_what_its_simulation_contradicts(monkeypatch):
    monkeypatch.setattr(safety_chain, "_MULTIPLES", (1,))
    monkeypatch.setattr(safety_chain, "_LONG_MULTIPLES", ())
    problem = false_bounds.island()
    found = verify(problem, parse_conditions("scbf", problem), samples=1024)
    claims = found.guarantee.applicable_bounds(found.analysis.safe.points[:1], problem.duration)
    assert "estimated" in {claim.status for claim in claims}
    claims, measurements = safety_chain.withhold_contradicted(
        claims, safety_chain.measure(found, episodes=40), found
    )
    of_horizons = [claim for m in measurements for h in m.horizons for claim in h.bounds]
    assert {claim.status for claim in claims} <= {"withheld", "hypothesis fails"}
    for each in (*claims, *of_horizons):
        assert each.status != "estimated"
        assert each.value is None or each.status != "withheld"


@pytest.mark.usefixtures("undecided")
def test_a_start_above_a_supremum_withholds_at_once(monkeypatch):
    monkeypatch.setattr(analysis.SafeSetAnalysis, "with_starts", lambda _, points, level: points)
    problem = false_bounds.island()
    found = verify(problem, parse_conditions("scbf", problem), samples=512)
    (claim,) = found.guarantee.applicable_bounds(np.array([[1.5, 0.3]]), HORIZON)
    assert claim.status == "withheld"
    assert "above the supremum" in claim.reason


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
    assert "31.0 %, below 50.0 %" in evaluation._judged(row, finer).withheld
    # What is of the env's own steps is of its own period.
    held = replace(row, continuous_bound=None, held_bound=0.5, held_word="proved")
    assert evaluation._judged(held, finer) == held


def test_a_start_counts_at_every_stage_of_a_chain(monkeypatch, request):
    """h = 1 + x and b_1 = v + .1 h: a start with a large v brakes, so that no later state has as
    large a b_1."""
    x, v, u = sp.symbols("x v u", real=True)
    system = ControlAffineSDE.from_rate((x, v), (u,), [v, u], diffusion=[0, 0.01])
    problem = define_problem(
        system,
        [1 + x],
        input_bounds=(-9, 9),
        workspace={x: (-1, 1), v: (-1, 1)},
        start=(0.0, 0.9),
        dt=0.05,
        horizon=1.0,
        nominal=-5,
    )
    (row,) = evaluate(problem, filters="szcbf:alpha=0.1,0.1", episodes=20).rows
    assert (row.continuous_bound, row.withheld) == (
        pytest.approx((1 / 2 + 1 / 1.2) * np.exp(-0.1) - 1, abs=1e-3),
        None,
    )
    assert row.continuous_word == "proved"
    monkeypatch.setattr(analysis.SafeSetAnalysis, "suprema", np.array([2.0, 0.8]))
    request.getfixturevalue("undecided")
    (row,) = evaluate(problem, filters="szcbf:alpha=0.1,0.1", episodes=20).rows
    assert row.withheld == "b_1 reaches 1, above the supremum of 0.8 that the search found"


@pytest.mark.parametrize(
    ("words", "ends", "withheld"),
    [
        # (held, continuous), (95 %, 99.9 %): bounds of .9 and .5.
        (("proved", "estimated"), (0.9, 0.9), ()),
        (("proved", "estimated"), (0.89, 0.91), ()),
        (("certified", "estimated"), (0.89, 0.91), ()),
        (("computed", "estimated"), (0.89, 0.91), ("held",)),
        (("proved", "estimated"), (0.88, 0.89), ("held",)),
        (("proved", "estimated"), (0.49, 0.91), ("continuous",)),
        (("proved", "proved"), (0.49, 0.91), ()),
        (("computed", "proved"), (0.4, 0.49), ("held", "continuous")),
        (("none", "none"), (0.0, 0.0), ()),
    ],
)
def test_an_interval_contradicts_a_bound_that_is_wholly_above_it(words, ends, withheld):
    """What is proved is held against the wider one; one claim is withheld without the other."""
    row = BoundSummary(
        held_bound=None if words[0] == "none" else 0.9,
        held_word=words[0],
        held_error=0.01,
        continuous_bound=None if words[1] == "none" else 0.5,
        continuous_word=words[1],
    )
    found = judged(row, *ends)
    assert (found == row) == (not withheld)
    for name in ("held", "continuous"):
        bound, word = getattr(found, f"{name}_bound"), getattr(found, f"{name}_word")
        assert (word == "withheld") == (name in withheld)
        if name in withheld:
            assert (bound, getattr(found, f"{name}_error")) == (None, 0.0)
            assert getattr(found, f"{name}_note").startswith("withheld: the interval")


def test_a_contradiction_shows_numbers_that_differ():
    row = BoundSummary(held_bound=0.99993, held_word="computed")
    assert "ends at 99.991 %, below 99.993 %" in (judged(row, 0.999905, 0.999905).withheld or "")


@pytest.mark.parametrize(
    ("word", "most"), [("proved", 5e-4), ("certified", 5e-4), ("computed", 0.025)]
)
def test_what_holds_is_contradicted_by_chance_as_seldom_as_it_says(word, most):
    episodes, worst = 300, 0.0
    for unsafe in np.geomspace(1e-5, 0.9, 25):
        row = BoundSummary(held_bound=1.0 - unsafe, held_word=word)
        # The number of safe episodes from which on it stands.
        least = bisect.bisect_left(
            range(episodes + 1),
            True,
            key=lambda safe, row=row: judged(row, *upper_ends(safe, episodes, 0.95)) == row,
        )
        worst = max(worst, binom.cdf(least - 1, episodes, 1.0 - unsafe))
    assert most / 4 < worst <= most * (1.0 + 1e-9)


def test_a_posterior_keeps_its_numbers_where_its_bound_is_withheld():
    bound = PosteriorSummary(0.9, "", "estimated", delta=0.1)
    row = BoundSummary(continuous_note="learned", posterior_bound=bound)
    found = judged(row, 0.2, 0.2)
    note = f"withheld: {found.withheld}"
    assert found.posterior_bound == PosteriorSummary(None, note, "withheld", delta=0.1)
    assert found.continuous_note == "learned"
