"""Proofs of whole systems: no bound that is proved is above the rate of episodes."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.errors import SafeEnvsError
from safe_envs.wrappers import SafetyFilter, parse_conditions
from tests.oracles import false_bounds
from tests.oracles.nasty_systems import NASTY, REFUSED, UNPROVED
from tests.oracles.random_systems import (
    Rate,
    contradictions,
    proved_starts,
    random_system,
    rates,
)
from tests.proofs.verified import made_bound

pytestmark = pytest.mark.filterwarnings("ignore::safe_envs.errors.SystemDefinitionWarning")

SYSTEMS = 200
COMPARISONS = 20 * (SYSTEMS + len(NASTY))
ERROR = 0.01 / COMPARISONS
"""Of one comparison, so that all true bounds pass together with a probability of 99 %."""

TELLING = (3, 7, 17, 20, 30)
"""Random systems with a proved bound that is not far below the rate, or of relative degree two."""


def _false(problem, text, parts, episodes, only=""):
    starts = proved_starts(problem, text, parts)
    found = rates(problem, text, starts, episodes, only)
    assert len(found) <= 20
    return bool(starts), contradictions(problem, text, found, ERROR)


@pytest.mark.parametrize("seed", TELLING)
def test_a_random_system_is_proved_and_its_bound_holds(seed):
    proved, false = _false(*random_system(seed), [0.6], 60, "against")
    assert proved
    assert false == []


@pytest.mark.oracle
def test_no_bound_of_random_systems_is_above_the_rate():
    proved, false, tried = 0, [], 0
    for seed in range(SYSTEMS):
        try:
            problem, text = random_system(seed)
            positive, found = _false(problem, text, [1.0, 0.5], 300)
        except SafeEnvsError:
            continue  # The barriers have different relative degrees.
        tried, proved, false = tried + 1, proved + positive, [*false, *found]
    assert false == []
    assert tried > 0.9 * SYSTEMS
    assert proved > 0.4 * SYSTEMS


@pytest.mark.oracle
@pytest.mark.parametrize("name", [n for n in NASTY if n not in REFUSED])
def test_no_bound_of_a_nasty_system_is_above_the_rate(name):
    assert _false(*NASTY[name](), [1.0, 0.5], 300)[1] == []


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_derivatives_is_refused(name):
    with pytest.raises(SafeEnvsError):
        proved_starts(*NASTY[name](), [1.0])


@pytest.mark.parametrize("name", UNPROVED)
def test_the_judge_does_not_rely_on_the_search_for_kinks_and_poles(name):
    problem, text = NASTY[name]()
    proof = made_bound(problem, text).proof
    verdicts = [proof.smooth, proof.continuous]
    assert "undecided" in [verdict.word for verdict in verdicts]
    assert any("where evaluation meets a kink, a jump, a pole" in v.reason for v in verdicts)


def _slack(problem, text, state):
    """By how much the filter's action violates its conditions at a state."""
    found = SafetyFilter.for_problem(problem, parse_conditions(text, problem))
    return found.filter(state, np.zeros(problem.plant.m)).slack.max()


def test_a_second_peak_makes_the_supremum_right_and_refutes_that_the_condition_can_be_met():
    problem = false_bounds.island()
    guarantee = made_bound(problem)
    (peak,) = guarantee.proof.suprema
    assert peak.verdict.word == "proved"
    assert 28.66 < peak.value < 29
    verdict = guarantee.proof.feasible
    assert verdict.word == "refuted"
    assert _slack(problem, "scbf", verdict.state) > 0.0
    assert guarantee.at(np.array([[1.5, 0.3]]), 0.5)[0] == 0.0


def test_a_shortfall_of_turned_axes_is_refuted_with_a_state():
    problem, text = false_bounds.rotated(), "cbf:alpha=0.1"
    verdict = made_bound(problem, text).proof.feasible
    assert verdict.word == "refuted"
    assert _slack(problem, text, verdict.state) > 0.0


def test_margins_of_first_order_are_not_proved():
    problem = false_bounds.corridor()
    text = "cbf:alpha=10:sampling_margin=first-order"
    verdict = made_bound(problem, text).proof.feasible
    assert verdict.word == "undecided"
    assert "margin of first order" in verdict.reason


def test_a_false_bound_would_be_contradicted_at_any_step():
    problem, text = NASTY["hidden kink"]()
    start = (np.array([0.1]), 0.95)
    (said,) = contradictions(problem, text, rates(problem, text, [start], 60, "nominal"), ERROR)
    assert "proved 0.95, safe" in said
    assert Rate("nominal", (0.1,), 0.95, 60, 60).upper(ERROR) == 1.0
