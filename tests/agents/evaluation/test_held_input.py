"""Bounds for the env's own steps: who makes them, and their mean over starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from safe_envs.agents.evaluation.bounds import (
    MAKERS,
    NO_FILTER,
    NO_MAKER,
    FilteredPolicy,
    HeldAverager,
    PromiseBound,
    held_averager_of,
    held_bound_of,
)
from safe_envs.agents.evaluation.episodes import VisitedStates
from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.values.promise_filter import PromiseSettings
from safe_envs.wrappers import parse_conditions
from tests.conftest import problem_of

SCALAR = "safe_envs/Scalar-v0"


@dataclass
class Parabola:
    """1 - x^2, for any filter."""

    word: str = "proved"
    note: str = "of a certificate"
    why_none: str = ""
    nowhere: str = "no start is in its set"
    against: str = ""

    def at(self, starts):
        return np.maximum(1.0 - starts[:, 0] ** 2, 0.0)

    def contradiction(self, visited):
        return self.against


@pytest.fixture(scope="module")
def problem():
    return problem_of(SCALAR)


@pytest.fixture
def nothing(problem):
    return VisitedStates.nothing(problem)


def test_each_filter_has_the_bound_of_the_first_that_makes_one(problem):
    conditions = parse_conditions("scbf", problem)
    unfiltered = FilteredPolicy(problem, (), "model", "nominal")
    filtered = FilteredPolicy(problem, conditions, "plant", "nominal")
    assert held_bound_of(unfiltered) == NO_FILTER
    assert held_bound_of(filtered) == NO_MAKER
    first, second = Parabola(why_none="not of this plant"), Parabola()
    found = [lambda _: None, lambda _: first, lambda _: second]
    assert held_bound_of(filtered, found) is second
    assert held_bound_of(filtered, found[:2]) == "not of this plant"
    # A policy alone may have one too.
    assert held_bound_of(unfiltered, found) is second


def test_the_makers_know_the_promise_filter(problem):
    short = problem_of(SCALAR, horizon=0.05)
    of_filter = FilteredPolicy(short, PromiseSettings(0.9), "model", "random")
    (made,) = [made for make in MAKERS if (made := make(of_filter)) is not None]
    assert isinstance(made, PromiseBound)
    assert made.word == "computed"
    of_condition = FilteredPolicy(problem, parse_conditions("scbf", problem), "model", "random")
    assert [make(of_condition) for make in MAKERS] == [None] * len(MAKERS)


def test_the_mean_over_starts_has_an_error(nothing):
    starts = np.linspace(-1.0, 1.0, 101)[:, None]
    averager = HeldAverager(Parabola())
    for part in (starts[:7], starts[7:]):
        averager.add(part)
    row = averager.put_in(BoundSummary(continuous_bound=0.3, continuous_word="proved"), nothing)
    values = 1.0 - starts[:, 0] ** 2
    assert row.held_bound == pytest.approx(values.mean())
    assert row.held_error == pytest.approx(values.std(ddof=1) / np.sqrt(101))
    assert (row.held_word, row.held_note) == ("proved", "of a certificate")
    assert (row.continuous_bound, row.continuous_word) == (0.3, "proved")


def test_one_start_has_no_error(nothing):
    averager = HeldAverager(Parabola())
    averager.add(np.full((1000, 1), 0.3))
    row = averager.put_in(BoundSummary(), nothing)
    assert (row.held_bound, row.held_error) == (pytest.approx(0.91), 0.0)


def test_without_a_bound_there_is_a_reason(nothing):
    said = HeldAverager("not of this plant")
    said.add(np.zeros((3, 1)))
    outside = HeldAverager(Parabola())
    outside.add(np.full((3, 1), 2.0))
    contradicted = HeldAverager(Parabola(against="it left"))
    contradicted.add(np.zeros((3, 1)))
    rows = [each.put_in(BoundSummary(), nothing) for each in (said, outside, contradicted)]
    assert [row.held_bound for row in rows] == [None] * 3
    assert [row.held_word for row in rows] == ["none", "none", "withheld"]
    assert [row.held_note for row in rows] == [
        "not of this plant",
        "no start is in its set",
        "withheld: it left",
    ]


@pytest.mark.parametrize(
    ("text", "monitoring", "why_not", "note"),
    [
        (None, "continuous", "it was not asked for", NO_FILTER),
        ("scbf", "discrete", "it was not asked for", "it was not asked for"),
        ("scbf", "continuous", None, "not of the time between them"),
        ("scbf", "discrete", None, NO_MAKER),
    ],
)
def test_what_is_watched_between_instants_has_none(
    problem, nothing, text, monitoring, why_not, note
):
    parts = parse_conditions(text, problem) if text else ()
    averager = held_averager_of(
        FilteredPolicy(problem, parts, "model", "nominal"), monitoring, why_not
    )
    row = averager.put_in(BoundSummary(), nothing)
    assert row.held_note.endswith(note)
