"""Specifications mean what their definition says: truth, robustness, verdicts and values."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE, SafetyProblem, define_problem
from safe_envs.filters.specification import (
    MOST_STATES,
    Automaton,
    Parsed,
    Specification,
    SpecificationTracker,
    automaton_of,
    parsed,
    problem_automaton,
)
from tests.oracles.formulas import NAMES, random_text, robustness, satisfied

LONGEST = 5
STATES = sp.symbols("x_1:8", real=True)
WORDS = list(itertools.product(itertools.product((False, True), repeat=2), repeat=LONGEST))


def problem_of(steps: int = LONGEST - 1) -> SafetyProblem:
    """Return a problem whose sets are half-spaces: each of a state, whose value is its own."""
    u = sp.Symbol("u", real=True)
    system = ControlAffineSDE(STATES, (u,), [0] * 7, [1] + [0] * 6, [[0]] * 7)
    problem = define_problem(
        system, STATES[0], input_bounds=(-1, 1), start=[1.0] * 7, dt=1.0, horizon=float(steps)
    )
    regions = dict(zip(("a", "b", "c", "d", "e"), STATES[2:], strict=True))
    return replace(problem, goal=STATES[1], regions=regions)


PROBLEM = problem_of()


def followed(text: str, traces: np.ndarray, problem: SafetyProblem = PROBLEM) -> list[Any]:
    """Return what is said of traces (instants, sets, B) after each instant."""
    tracker, count = SpecificationTracker(problem, text, traces.shape[2]), traces.shape[2]
    found = []
    for k, at in enumerate(traces):
        x = (*at, *np.zeros((7 - len(at), count)))
        tracker.begin(x, np.ones(count, dtype=bool)) if k == 0 else tracker.advance(x)
        found.append(tracker.report())
    return found


def require_meaning(text: str, *, early: bool) -> bool:
    """Compare truth, robustness and verdicts with their definitions, on all words of five letters.

    Args:
        text: of a specification.
        early: whether verdicts have to fall as soon as they are known.

    Returns:
        False where the text has too many states, or long windows within others.
    """
    sizes = np.random.default_rng(0).uniform(0.1, 2.0, (LONGEST, 2, len(WORDS)))
    truth = np.array(WORDS).transpose(1, 2, 0)
    traces = np.where(truth, sizes, -sizes)
    try:
        found = followed(text, traces)
    except ConfigurationError:
        return False
    formula = parsed(text, NAMES)
    known: dict[Any, bool] = {}
    for n in range(1, LONGEST + 1):
        for word in {word[:n] for word in WORDS}:
            named = [dict(zip(NAMES, letter, strict=True)) for letter in word]
            known[word] = satisfied(formula, named)
        expected = [known[word[:n]] for word in WORDS]
        np.testing.assert_array_equal(found[n - 1]["satisfied"], expected, err_msg=text)
        np.testing.assert_array_equal(found[n - 1]["robustness"] > 0, expected, err_msg=text)
        for b in range(0, len(WORDS), 97):
            named = [dict(zip(NAMES, at[:, b], strict=True)) for at in traces[:n]]
            assert found[n - 1]["robustness"][b] == robustness(formula, named), text
    outcomes: dict[Any, set[int]] = {}
    for word, held in known.items():
        for n in range(1, len(word) + 1):
            outcomes.setdefault(word[:n], set()).add(1 if held else -1)
    for n in range(1, LONGEST):
        for word, verdict in zip(WORDS, found[n - 1]["verdict"], strict=True):
            ends = outcomes[word[:n]]
            settled = next(iter(ends)) if len(ends) == 1 else 0
            # What one more letter cannot change may still change later.
            assert verdict == settled or (not early and (verdict == 0 or n == LONGEST - 1)), text
    return True


def test_random_formulas_mean_what_their_definition_says() -> None:
    draw = random.Random(0)
    assert sum(require_meaning(random_text(draw, 3), early=False) for _ in range(40)) > 20


@pytest.mark.oracle
def test_many_random_formulas_mean_what_their_definition_says() -> None:
    draw = random.Random(1)
    assert sum(require_meaning(random_text(draw, 3), early=False) for _ in range(400)) > 220


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("always safe & eventually goal", 3),
        ("safe until goal", 3),
        ("eventually (safe then goal)", 3),
        ("eventually[1,3] goal", 2),
        ("always[0,2] safe | eventually[2,4] goal", 2),
        ("safe & always (goal | safe)", 2),
    ],
)
def test_verdicts_fall_as_soon_as_they_are_known_and_states_are_few(text: str, size: int) -> None:
    assert require_meaning(text, early=True)
    assert problem_automaton(PROBLEM, text).size == size


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("always (safe | eventually goal)", 2),
        ("safe then goal then !safe", 4),
        ("eventually[0,2] goal & eventually[4,6] !goal", 3),
        ("always eventually[0,2] goal", 4),
        ("eventually[0,50] goal & always[10,60] safe", 3),
        ("always[10,20000] (safe | eventually[0,2] goal)", 4),
    ],
)
def test_long_windows_need_no_states(text: str, size: int) -> None:
    assert automaton_of(Specification(text, NAMES)).size == size


def test_windows_open_and_close_at_their_instants() -> None:
    text, count = "eventually[0,50] goal & always[10,60] safe", 3
    traces = np.ones((61, 2, count))
    traces[:, 1] = -1.0  # No goal but that of the first trace.
    traces[50, 1, 0] = traces[51, 1, 1] = 1.0
    traces[9, 0, 0] = traces[60, 0, 2] = -1.0
    verdicts = np.array([each["verdict"] for each in followed(text, traces, problem_of(60))])
    assert verdicts[49].tolist() == [0, 0, 0]
    assert verdicts[50].tolist() == [0, -1, -1]
    assert verdicts[60].tolist() == [1, -1, -1]


def test_traces_may_be_at_different_instants() -> None:
    tracker = SpecificationTracker(problem_of(9), "eventually[2,3] goal", 3)
    no, yes = (tuple(np.full(3, value) for _ in range(7)) for value in (-1.0, 1.0))
    tracker.begin(no, np.array([True, True, True]))
    tracker.advance(no)
    tracker.begin(no, np.array([False, True, False]))
    tracker.advance(yes)
    assert tracker.report()["verdict"].tolist() == [1, 0, 1]
    tracker.advance(yes)
    assert tracker.report()["verdict"].tolist() == [1, 1, 1]


SETS = ("safe", "goal", "G1", "G2")


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("always safe & eventually goal", "(always safe) & (eventually goal)"),
        ("safe & goal | G1", "(safe & goal) | G1"),
        ("safe until goal & G1", "(safe until goal) & G1"),
        ("safe until goal until G1", "safe until (goal until G1)"),
        ("eventually G1 then G2", "eventually (G1 then G2)"),
        ("eventually (G1 then G2 then goal)", "eventually (G1 then (G2 then goal))"),
        ("always safe until goal", "(always safe) until goal"),
        ("not G1 and (safe or goal)", "!G1 & (safe | goal)"),
        ("eventually[ 0 , 5 ]goal", "eventually[0,5] (goal)"),
        ("!G1 then G2", "(!G1) then G2"),
    ],
)
def test_precedence(text: str, same: str) -> None:
    assert parsed(text, SETS) == parsed(same, SETS)


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("alway safe", "1: 'alway'"),
        ("always safe eventually goal", "13: "),
        ("always safe $ goal", r"13: .*'\$'"),
        ("always[3,1] safe", r"7: .*\[3,1\]"),
        ("eventually[0,100001] goal", "11: .*100000"),
        ("eventually[0,5 goal", "16: 'goal'"),
        ("eventually[0,x] goal", "14: 'x'"),
        ("eventually[-1,2] goal", "12: .*'-'"),
        ("always (safe", "13: "),
        ("goal & ", "7: .*safe, goal, G1, G2"),
        ("safe until then goal", "12: .*'then'"),
        ("(eventually G1) then G2", "1: .*'then'"),
        ("(" * 30 + "safe" + ")" * 30, "22: .*20"),
        ("Safe", "1: .*'safe'"),
        ("sáfe", "2: "),
        ("", "give"),
        ("  ", "give"),
        (None, "give"),
        (3, "give"),
        ("safe & " * 100 + "safe", "give"),
        ("always eventually[0,7] goal", "6 temporal"),
    ],
)
def test_mistakes_in_texts_are_placed(text: Any, fragment: str) -> None:
    with pytest.raises(ConfigurationError, match=fragment):
        Specification(text, SETS)


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("eventually a & eventually b & eventually c & always safe", "9 states"),
        ("safe | goal | a | b | c | d | e", "7 sets"),
        ("eventually[0,50] goal & always[10,60] safe", "step 60.* 59 "),
        ("eventually nowhere", "nowhere"),
    ],
)
def test_what_a_problem_cannot_follow_is_refused(text: str, fragment: str) -> None:
    with pytest.raises(ConfigurationError, match=fragment):
        SpecificationTracker(problem_of(59), text, 1)
    most = problem_automaton(problem_of(), "eventually a & eventually b & eventually c")
    assert most.size == MOST_STATES


STEPS = 4
INSIDE = {"safe": (1, 1, 0, 1), "G1": (0, 1, 0, 0), "G2": (1, 0, 0, 1)}
"""Which of the four states of a Markov chain are in the set."""


def best_with_memory(
    kernel: np.ndarray, formula: Parsed, ended: set[int], path: tuple[int, ...]
) -> float:
    """Return the largest probability of satisfaction over all policies, after a path.

    A policy sees the whole path; satisfaction is by definition.
    """
    if len(path) == STEPS + 1 or path[-1] in ended:
        word = [{name: bool(inside[x]) for name, inside in INSIDE.items()} for x in path]
        return float(satisfied(formula, word))
    following = [best_with_memory(kernel, formula, ended, (*path, x)) for x in range(4)]
    return float((kernel[:, path[-1]] @ following).max())


def values_of_pairs(kernel: np.ndarray, automaton: Automaton, ended: set[int]) -> np.ndarray:
    """Return V_0 of each start, by a dynamic program over states and those of the automaton."""
    labels = automaton.label([INSIDE[name] for name in automaton.atoms])
    accepted = np.broadcast_to(automaton.accepting.astype(float), (4, automaton.size))
    table, states = accepted, np.arange(automaton.size)
    for k in reversed(range(STEPS)):
        following = automaton.step(k + 1, states, labels[:, None])  # of x' and a
        values = (kernel @ np.take_along_axis(table, following, axis=1)).max(axis=0)
        table = np.where(np.isin(np.arange(4), list(ended))[:, None], accepted, values)
        verdict = automaton.verdict(k, states)
        np.testing.assert_allclose(table[:, verdict == 1], 1.0, rtol=1e-13)
        assert (table[:, verdict == -1] == 0.0).all()
    return table[np.arange(4), automaton.step(0, automaton.initial, labels)]


@pytest.mark.parametrize("ended", [set(), {0, 2}])
@pytest.mark.parametrize(
    "text",
    [
        "eventually (G1 then G2) & always !(G1 & G2)",
        "safe until G2 | eventually[3,4] G1",
        "eventually[1,2] G1 & always[2,3] safe",
        "always eventually[0,1] G2",
        "always (G1 | eventually G2) until !safe",
    ],
)
def test_the_state_of_the_automaton_is_all_that_a_policy_needs(text: str, ended: set[int]) -> None:
    automaton, formula = automaton_of(Specification(text, INSIDE)), parsed(text, INSIDE)
    for seed in range(2):
        weights = np.random.default_rng(seed).exponential(size=(2, 4, 4)) ** 2
        kernel = weights / weights.sum(axis=2, keepdims=True)
        expected = [best_with_memory(kernel, formula, ended, (x,)) for x in range(4)]
        np.testing.assert_allclose(values_of_pairs(kernel, automaton, ended), expected, rtol=1e-13)
