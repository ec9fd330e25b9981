"""Texts of specifications, and how robustly traces meet them."""

from __future__ import annotations

import random

import numpy as np
import pytest

from safe_envs.errors import ConfigurationError
from safe_envs.filters.specification import Specification, parsed
from tests.oracles.formulas import NAMES, random_text, robustness

SETS = ("safe", "goal", "G1", "G2")


def test_robustness_is_that_of_the_definition() -> None:
    draw, rng, done = random.Random(3), np.random.default_rng(0), 0
    for _ in range(120):
        text = random_text(draw, 3)
        try:
            specification = Specification(text, NAMES)
        except ConfigurationError:
            continue
        traces = rng.normal(size=(7, len(specification.atoms), 4))
        registers = specification.start(traces[0])
        for n in range(1, 8):
            if n > 1:
                registers = specification.advance(n - 1, registers, traces[n - 1])
            found = specification.robustness(registers)
            expected = [
                robustness(
                    parsed(text, NAMES),
                    [dict(zip(specification.atoms, at[:, b], strict=True)) for at in traces[:n]],
                )
                for b in range(4)
            ]
            np.testing.assert_array_equal(found, expected, err_msg=text)
        np.testing.assert_array_equal(specification.robustness_of(traces), found)
        done += 1
    assert done > 80


def test_set_values_that_move_by_less_than_the_robustness_change_no_truth() -> None:
    specification = Specification("safe until goal & always (safe | eventually goal)", NAMES)
    rng = np.random.default_rng(1)
    traces = rng.normal(size=(6, 2, 500))
    robust = specification.robustness_of(traces)
    moved = traces + rng.uniform(-1.0, 1.0, traces.shape) * abs(robust) * 0.999
    assert ((specification.robustness_of(moved) > 0) == (robust > 0)).all()
    worst = traces - np.nextafter(robust, np.inf)  # every negation-free formula falls
    assert (specification.robustness_of(worst)[robust > 0] <= 0).all()


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


def test_a_sequence_is_nested_reaching() -> None:
    sequence = Specification("eventually (G1 then G2)", SETS)
    traces = np.random.default_rng(2).normal(size=(6, 2, 50))
    reach = Specification("eventually (G1 & eventually G2)", SETS)
    np.testing.assert_array_equal(sequence.robustness_of(traces), reach.robustness_of(traces))


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        ("alway safe", 1, "'alway' is no set; did you mean 'always'"),
        ("always safe eventually goal", 13, "follows a complete formula; join formulas by"),
        ("always safe $ goal", 13, r"the character '\$' has no meaning; use names"),
        ("always[3,1] safe", 7, r"the window is \[3,1\]; give its first and its last"),
        ("eventually[0,100001] goal", 11, "up to 100000"),
        ("eventually[0,5 goal", 16, r"'goal' is given in place of '\]'; write a window"),
        ("eventually[0,x] goal", 14, "'x' is no control step"),
        ("eventually[-1,2] goal", 12, "the character '-' has no meaning"),
        (
            "always (safe",
            13,
            r"the end is given in place of '\)'; it closes",
        ),
        ("goal & ", 7, "the text ends where a formula has to begin; allowed: safe, goal, G1, G2"),
        ("safe until then goal", 12, "no formula begins with 'then'"),
        ("(eventually G1) then G2", 1, "what precedes 'then' is a set"),
        ("(" * 30 + "safe" + ")" * 30, 22, "nested more than 20 deep"),
        ("Safe", 1, "did you mean 'safe'"),
        ("sáfe", 2, "has no meaning"),
    ],
)
def test_mistakes_are_placed(text: str, place: int, message: str) -> None:
    with pytest.raises(ConfigurationError, match=f"at character {place}: .*{message}"):
        parsed(text, SETS)


@pytest.mark.parametrize("text", ["", "  ", None, 3, "safe & " * 100 + "safe"])
def test_texts_of_no_or_too_many_characters_are_refused(text: object) -> None:
    with pytest.raises(ConfigurationError, match="give"):
        parsed(text, SETS)


def test_windows_within_operators_are_short() -> None:
    with pytest.raises(ConfigurationError, match="more than 6 temporal operators"):
        Specification("always eventually[0,7] goal", SETS)


def test_windows_end_within_the_horizon() -> None:
    specification = Specification("eventually[0,50] goal & always[10,60] safe", SETS)
    assert specification.clocks == (10, 51, 61)
    specification.require_horizon(60)
    with pytest.raises(ConfigurationError, match="ends at step 60, and an episode has 59 steps"):
        specification.require_horizon(59)
