"""Verdicts follow from numbers by the stated rules."""

from __future__ import annotations

from dataclasses import replace

import pytest

from thesis.artefact import Claim, Number, Outcome, Sample
from thesis.verdict import Verdict, disagreement, judge, printed_orders

ARGUMENT = "no two are alike"
SAID, SAID_NOT = Claim("it flies", True, ""), Claim("it flies", False, "")
CHECK_FAILS = Claim("it sings", False, "", printed=False)


def rates(high, low, printed=(90.0, 60.0)):
    return [
        Number.rate("high", high, 100, printed[0], 50),
        Number.rate("low", low, 100, printed[1], 50),
    ]


def otherwise(*numbers, claims=()):
    return {"more noise": Outcome(list(numbers), list(claims))}


@pytest.mark.parametrize(
    ("number", "agrees"),
    [
        # 45 of 50 have the interval 78.6 to 95.7 %. Against 79 of 100, [70.0, 85.8], the difference
        # of 11 is not more than hypot(85.8 - 79, 90 - 78.6) = 13.3; against 76.5 it is.
        (Number("a", 79.0, 70.0, 85.8, 90.0, 50, "%"), True),
        (Number("a", 76.5, 70.0, 83.0, 90.0, 50, "%"), False),
        # On the other side: 90 + hypot(95.7 - 90, 99 - 97) = 96.04.
        (Number("a", 95.9, 93.9, 97.9, 90.0, 50, "%"), True),
        (Number("a", 96.2, 94.2, 98.2, 90.0, 50, "%"), False),
        # What is wider than twice the printed 17.1 points says nothing.
        (Number("a", 90.0, 73.0, 107.0, 90.0, 50, "%"), True),
        (Number("a", 90.0, 72.8, 107.2, 90.0, 50, "%"), False),
        (Number("a", 90.0, unit="%"), True),
        # Another number agrees if the printed one is inside.
        (Number("a", 1.0, 0.9, 1.1, 0.9), True),
        (Number("a", 1.0, 0.9, 1.1, 0.89), False),
        (Number("a", 1.0, 0.9, 1.1, 1.1), True),
        (Number("a", 1.0, 0.9, 1.1, 1.11), False),
        (Number("a", 1.0, printed=1.0), True),
        (Number("a", 1.0, printed=1.0001), False),
    ],
)
def test_a_printed_number_agrees_or_not(number, agrees):
    assert (disagreement(number) is None) is agrees


def test_a_disagreement_names_both_numbers():
    far = Number("a", 40.0, 10.0, 70.0, 99.0, 50, "%")
    assert disagreement(far) == "a: 99 % printed, 40 % here"
    wide = Number("a", 90.0, 60.0, 120.0, 90.0, 50, "%")
    assert "too wide to tell" in (disagreement(wide) or "")


def test_orders_are_those_that_the_printed_samples_can_tell_apart():
    def orders(*numbers):
        return [(a.name, b.name) for a, b in printed_orders(numbers)]

    a, b, c = (
        Number.rate(name, 50, 100, printed, 50)
        for name, printed in (("a", 90.0), ("b", 80.0), ("c", 60.0))
    )
    # 90 and 80 % of 50 differ by 10 [-4.6, 24.2]; 80 and 60 % by 20 [1.9, 36.4].
    assert orders(c, b, a) == [("b", "c"), ("a", "c")]
    sized = [replace(n, printed_trials=1000) for n in (c, b, a)]
    assert orders(*sized) == [("b", "c"), ("a", "c"), ("a", "b")]
    x, y = Number("x", 1.0, printed=2.0), Number("y", 1.0, printed=1.0)
    assert orders(x, y) == [("x", "y")]
    assert orders(replace(x, unit="s"), y) == orders(x, Number("z", 1.0, printed=2.0)) == []


@pytest.mark.parametrize(
    ("outcome", "verdict"),
    [
        (Outcome(rates(88, 60)), Verdict.REPRODUCED),
        (Outcome(rates(88, 60), [SAID_NOT]), Verdict.NOT),
        (Outcome(rates(88, 60), [CHECK_FAILS]), Verdict.REPRODUCED),
        (Outcome(rates(40, 20)), Verdict.ORDERING),
        (Outcome(rates(40, 20), [CHECK_FAILS]), Verdict.ORDERING),
        (Outcome(rates(40, 20), [SAID_NOT]), Verdict.NOT),
        (Outcome(rates(20, 40)), Verdict.NOT),
        (Outcome(rates(75, 75)), Verdict.NOT),  # equal ones are turned, too
        (Outcome(rates(20, 40), [], otherwise(*rates(88, 60))), Verdict.ALTERNATIVE),
        (Outcome(rates(20, 40), [], otherwise(*rates(88, 20))), Verdict.NOT),
        (Outcome(rates(20, 40), [], otherwise(*rates(75, 75))), Verdict.NOT),
        (Outcome(rates(20, 40), [], otherwise(rates(88, 60)[0])), Verdict.NOT),
        (Outcome(rates(20, 40), [], otherwise(*rates(88, 60), claims=[SAID_NOT])), Verdict.NOT),
        (Outcome(rates(20, 40), [SAID_NOT], otherwise(*rates(88, 60))), Verdict.NOT),
        (
            Outcome(rates(20, 40), [SAID_NOT], otherwise(*rates(88, 60), claims=[SAID])),
            Verdict.ALTERNATIVE,
        ),
        (
            Outcome(rates(20, 40), [], otherwise(*rates(88, 60), claims=[CHECK_FAILS])),
            Verdict.ALTERNATIVE,
        ),
        (Outcome([], [SAID_NOT], otherwise(claims=[SAID])), Verdict.ALTERNATIVE),
        (
            Outcome([], [SAID_NOT], otherwise(claims=[replace(SAID, sentence="another")])),
            Verdict.NOT,
        ),
        (Outcome([], [SAID]), Verdict.REPRODUCED),
        # With nothing that is printed, nothing is reproduced.
        (Outcome([Number("ours", 1.0)], [replace(SAID, printed=False)]), Verdict.NOT),
    ],
)
def test_the_verdict_follows_from_the_numbers(outcome, verdict):
    judgement = judge(outcome, Sample(), ARGUMENT)
    assert judgement.verdict == verdict
    reached = "agrees with the other setting: more noise" in judgement.reasons
    assert reached is (verdict == Verdict.ALTERNATIVE)
    assert (ARGUMENT in judgement.reasons) is (verdict == Verdict.NOT)
    assert judge(outcome, Sample(quick=True)).verdict == Verdict.NONE


def test_orders_that_are_turned_are_named():
    assert "high is not above low" in judge(Outcome(rates(75, 75)), Sample()).reasons


@pytest.mark.parametrize(
    ("by_formula", "text"),
    [
        (rates(88, 60)[0], "reproduced"),
        (Number.rate("high", 10, 100), "reproduced; printed formula is wrong"),
        (Number.rate("high", 100, 100), "reproduced; printed formula is wrong"),
        (Number("exact", 3.0), "reproduced; printed formula is wrong"),
        (Number("exact", 2.0), "reproduced"),
    ],
)
def test_a_printed_formula_is_wrong_if_it_gives_another_number(by_formula, text):
    ours = Outcome([*rates(88, 60), Number("exact", 2.0)], printed_formula=[by_formula])
    assert judge(ours, Sample()).text == text


def test_a_wrong_formula_that_gives_the_printed_number_is_said_to():
    def text(by_formula):
        return judge(Outcome(rates(40, 20), printed_formula=[by_formula]), Sample()).text

    wrong = "ordering reproduced; printed formula is wrong"
    assert text(Number("high", 90.0, unit="%")) == f"{wrong}, and gives the thesis' numbers"
    # What is outside the printed number's interval gives something else again.
    assert text(Number("high", 10.0, unit="%")) == wrong
    # A number by the printed formula may have a printed one of its own.
    own = Number("high", 35.0, printed=35.0, unit="%")
    other = Outcome([Number("high", 27.0, unit="%"), rates(40, 20)[1]], printed_formula=[own])
    assert judge(other, Sample()).matches_thesis


def test_a_mean_has_students_interval_within_its_bounds():
    # The quantile of 3 degrees of freedom is 3.182446; the deviation of the four is sqrt(500/3).
    values, half = [10.0, 20.0, 30.0, 40.0], 3.182446 * (500.0 / 3.0) ** 0.5 / 2.0
    number = Number.mean("n", values, "s")
    assert (number.low, number.ours, number.high) == pytest.approx((25 - half, 25.0, 25 + half))
    bounded = Number.mean("n", values, "%", 10.0, 30.0)
    assert (bounded.low, bounded.high) == (10.0, 30.0)
    # Equal repetitions have an interval of no width, and a single one says nothing.
    for values, ends in (([3.0, 3.0, 3.0], (3.0, 3.0)), ([3.0], (0.0, 100.0))):
        assert Number.mean("n", values, "%", 0.0, 100.0).ends == ends
