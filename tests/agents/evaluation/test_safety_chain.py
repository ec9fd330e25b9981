"""The chain of a filter that is verified, and what contradicts parts of it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from safe_envs.agents.evaluation import safety_chain as of
from safe_envs.agents.evaluation.bounds import FilteredPolicy
from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.agents.evaluation.safety_chain import Horizon, MeasuredSafety, safety_chain
from safe_envs.agents.evaluation.yardstick import against_attainable, chained
from safe_envs.proofs.guarantees import Bound
from safe_envs.wrappers import parse_conditions
from tests.agents.evaluation.made_up import attainable
from tests.conftest import problem_of

PROVED = Bound("a", 0.42, "proved", "")
ESTIMATED = Bound("b", 0.6, "estimated", "undecided: a box is left")
FAILS = Bound("c", 0.9, "hypothesis fails", "no action meets it")


@pytest.fixture
def chain_of(monkeypatch):
    """Makes a chain with a bound for held input, or a reason, and a table, if there is one."""

    def made(bounds=(PROVED,), measured=(), held="no table", best=None):
        problem = problem_of("safe_envs/Scalar-v0")
        conditions = tuple(parse_conditions("scbf", problem))
        filtered = FilteredPolicy(problem, conditions, "model", "nominal")
        monkeypatch.setattr(of, "held_bound_of", lambda *_: held)
        return safety_chain(filtered, np.zeros((1, 1)), list(bounds), list(measured), best)

    return made


def measured(rate, episodes=100, repeats=False):
    safe = round(rate * episodes)
    horizon = Horizon(1.0, safe, rate, rate - 0.05, min(rate + 0.05, 1.0), ())
    return MeasuredSafety("the start", None, episodes, repeats, (horizon,))


def held_of(value, word="proved"):
    return SimpleNamespace(
        word=word,
        note="of a certificate",
        nowhere="",
        at=lambda starts: np.full(len(starts), value),
        contradiction=lambda visited: "",
    )


def test_a_proved_bound_comes_before_a_larger_estimate(chain_of):
    found = chain_of((ESTIMATED, FAILS, PROVED)).bounds
    assert (found.continuous_bound, found.continuous_word) == (0.42, "proved")
    found = chain_of((FAILS, ESTIMATED)).bounds
    assert (found.continuous_bound, found.continuous_word) == (0.6, "estimated")
    assert found.continuous_note == "undecided: a box is left"
    found = chain_of((FAILS,)).bounds
    assert (found.continuous_bound, found.continuous_word) == (None, "none")
    assert found.continuous_note == "no action meets it"
    found = chain_of((replace(PROVED, value=None, status="withheld", reason="why"), FAILS)).bounds
    assert (found.continuous_word, found.continuous_note) == ("withheld", "why")
    assert "it is 0" in chain_of((replace(PROVED, value=0.0),)).bounds.continuous_note


def test_a_chain_that_holds_is_kept(chain_of):
    found = chain_of(measured=[measured(0.9)], held=held_of(0.8), best=attainable(0.9, 0.99))
    assert (found.bounds.held_bound, found.rate, found.best.upper) == (0.8, 0.9, 0.99)
    document = found.as_dict()
    assert (document["held_word"], document["safety_rate"]) == ("proved", 0.9)
    assert document["best"]["upper"] == 0.99
    assert "posterior_bound" not in document


def test_without_a_simulation_there_is_no_rate(chain_of):
    found = chain_of(held=held_of(0.8))
    assert (found.rate, found.ci_low, found.ci_high) == (None, None, None)
    assert found.bounds.held_bound == 0.8


def test_a_bound_above_the_interval_is_withheld(chain_of):
    # The 95 % interval ends at 75 %, and what is proved is held against one of 99.9 %.
    assert chain_of(measured=[measured(0.7)], held=held_of(0.8)).bounds.held_bound == 0.8
    found = chain_of(measured=[measured(0.7)], held=held_of(0.8, "computed")).bounds
    assert (found.held_bound, found.held_word) == (None, "withheld")
    assert found.continuous_bound == 0.42
    # Episodes that are one and the same have no interval.
    assert chain_of(measured=[measured(0.6)], held=held_of(0.8)).bounds.held_word == "withheld"
    one = measured(0.78, repeats=True)
    assert chain_of(measured=[one], held=held_of(0.8)).bounds.held_word == "withheld"
    assert chain_of(measured=[replace(one, repeats=False)], held=held_of(0.8)).bounds.held_bound


@pytest.mark.parametrize(("word", "left"), [("computed", None), ("proved", 0.8)])
def test_a_bound_above_what_is_attainable_withholds_the_table(chain_of, word, left):
    found = chain_of(held=held_of(0.8, word), best=attainable(0.1, 0.7))
    assert found.best.upper is None
    assert found.best.contradiction.startswith("scbf: the bound for held input, 80.0 %, is above")
    assert found.bounds.held_bound == left


def test_rows_of_an_evaluation_are_held_against_the_table():
    summaries = {
        "low": BoundSummary(held_bound=0.5, held_word="proved"),
        "high": BoundSummary(held_bound=0.8, held_word="computed"),
    }
    best, upper = attainable(0.1, 0.7), 0.7
    best, low = against_attainable(best, upper, "low", summaries["low"])
    assert (best.upper, low) == (0.7, summaries["low"])
    best, high = against_attainable(best, upper, "high", summaries["high"])
    assert (best.upper, high.held_word) == (None, "withheld")
    # It is of the table's end that both are judged, whatever withheld it.
    assert against_attainable(best, upper, "high", summaries["high"])[1].held_word == "withheld"
    rows = [SimpleNamespace(filter="none")]
    assert chained(None, rows) == (None, rows)
