"""Verdicts follow from numbers by the stated rules."""

from __future__ import annotations

from dataclasses import replace

import pytest

from safe_envs.scripts.reproduce.framework.artefact import (
    Artefact,
    Claim,
    Findings,
    Number,
    Workload,
)
from safe_envs.scripts.reproduce.framework.verdict import (
    RULES,
    Verdict,
    disagreement,
    judge,
    printed_orders,
)

TABLE = Artefact("table-0.0", "", lambda _: Findings(), lambda _: (), argument="no two are alike")
SAMPLE = Workload()
SAID, SAID_NOT = Claim("it flies", True, ""), Claim("it flies", False, "")
CHECK_FAILS = Claim("it sings", False, "", printed=False)


def rates(high, low, printed=(90.0, 60.0)):
    return [
        Number.rate("high", high, 100, printed[0], 50),
        Number.rate("low", low, 100, printed[1], 50),
    ]


def claims(*found):
    return Findings(claims=list(found))


def test_a_rate_agrees_by_the_interval_of_the_difference():
    # 45 of 50 have the interval 78.6 to 95.7 %. Against 79 of 100, [70.0, 85.8], the difference of
    # 11 is not more than hypot(85.8 - 79, 90 - 78.6) = 13.3; against 76.5 it is.
    assert disagreement(Number("a", 79.0, 70.0, 85.8, 90.0, 50, "%")) is None
    assert "90 % printed, 76.5 % here" in (
        disagreement(Number("a", 76.5, 70.0, 83.0, 90.0, 50, "%")) or ""
    )
    # On the other side: 90 + hypot(95.7 - 90, 99 - 97) = 96.04.
    assert disagreement(Number("a", 95.9, 93.9, 97.9, 90.0, 50, "%")) is None
    assert disagreement(Number("a", 96.2, 94.2, 98.2, 90.0, 50, "%")) is not None
    assert disagreement(Number("a", 90.0, unit="%")) is None


@pytest.mark.parametrize(("half", "told"), [(17.0, None), (17.2, "too wide to tell")])
def test_an_interval_that_is_too_wide_says_nothing(half, told):
    # Twice the printed one's 17.1 points.
    text = disagreement(Number("a", 90.0, 90.0 - half, 90.0 + half, 90.0, 50, "%"))
    assert text is None if told is None else told in str(text)


def test_what_is_far_from_the_print_is_so_however_wide():
    assert (
        disagreement(Number("a", 40.0, 10.0, 70.0, 99.0, 50, "%")) == "a: 99 % printed, 40 % here"
    )


def test_another_number_agrees_if_the_printed_one_is_inside():
    for printed, inside in ((0.9, True), (1.1, True), (0.89, False), (1.11, False)):
        assert (disagreement(Number("a", 1.0, 0.9, 1.1, printed)) is None) is inside
    assert disagreement(Number("a", 1.0, printed=1.0)) is None
    assert (
        disagreement(Number("a", 1.0, printed=1.0001, unit="s")) == "a: 1.0001 s printed, 1 s here"
    )


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
    assert orders(Number("x", 1.0, printed=2.0), Number("y", 1.0, printed=1.0)) == [("x", "y")]
    assert orders(Number("x", 1.0, printed=2.0, unit="s"), Number("y", 1.0, printed=1.0)) == []
    assert (
        orders(Number("x", 1.0, printed=2.0), Number("y", 1.0), Number("z", 1.0, printed=2.0)) == []
    )


@pytest.mark.parametrize(
    ("outcome", "verdict"),
    [
        (Findings(rates(88, 60)), Verdict.REPRODUCED),
        (Findings(rates(88, 60), [SAID_NOT]), Verdict.NOT),
        (Findings(rates(88, 60), [CHECK_FAILS]), Verdict.REPRODUCED),
        (Findings(rates(40, 20)), Verdict.ORDERING),
        (Findings(rates(40, 20), [CHECK_FAILS]), Verdict.ORDERING),
        (Findings(rates(40, 20), [SAID_NOT]), Verdict.NOT),
        (Findings(rates(20, 40)), Verdict.NOT),
        # Equal ones are turned, too.
        (Findings(rates(75, 75)), Verdict.NOT),
        (
            Findings(rates(20, 40), alternative_settings={"more noise": Findings(rates(88, 60))}),
            Verdict.ALTERNATIVE,
        ),
        (
            Findings(rates(20, 40), alternative_settings={"more noise": Findings(rates(88, 20))}),
            Verdict.NOT,
        ),
        (
            Findings(rates(20, 40), alternative_settings={"more noise": Findings(rates(75, 75))}),
            Verdict.NOT,
        ),
        (
            Findings(
                rates(20, 40), alternative_settings={"more noise": Findings(rates(88, 60)[:1])}
            ),
            Verdict.NOT,
        ),
        (
            Findings(
                rates(20, 40),
                alternative_settings={"more noise": Findings(rates(88, 60), [SAID_NOT])},
            ),
            Verdict.NOT,
        ),
        (
            Findings(
                rates(20, 40),
                [SAID_NOT],
                alternative_settings={"more noise": Findings(rates(88, 60))},
            ),
            Verdict.NOT,
        ),
        (
            Findings(
                rates(20, 40),
                [SAID_NOT],
                alternative_settings={"more noise": Findings(rates(88, 60), [SAID])},
            ),
            Verdict.ALTERNATIVE,
        ),
        (
            Findings(
                rates(20, 40),
                alternative_settings={"more noise": Findings(rates(88, 60), [CHECK_FAILS])},
            ),
            Verdict.ALTERNATIVE,
        ),
        (
            Findings(
                rates(20, 40),
                alternative_settings={"more noise": Findings([Number("nothing printed", 1.0)])},
            ),
            Verdict.NOT,
        ),
        (
            Findings(claims=[SAID_NOT], alternative_settings={"more noise": claims(SAID)}),
            Verdict.ALTERNATIVE,
        ),
        (
            Findings(
                claims=[SAID_NOT],
                alternative_settings={"more noise": claims(replace(SAID, sentence="another"))},
            ),
            Verdict.NOT,
        ),
        (claims(SAID), Verdict.REPRODUCED),
        # With nothing that is printed, nothing is reproduced.
        (Findings([Number("ours", 1.0)], [replace(SAID, printed=False)]), Verdict.NOT),
        (claims(SAID_NOT), Verdict.NOT),
    ],
)
def test_the_verdict_follows_from_the_numbers(outcome, verdict):
    judgement = judge(TABLE, outcome, SAMPLE)
    assert judgement.verdict == verdict
    assert verdict in RULES
    assert ("agrees with the other setting: more noise" in judgement.reasons) is (
        verdict == Verdict.ALTERNATIVE
    )
    assert (TABLE.argument in judgement.reasons) is (verdict == Verdict.NOT)
    assert judge(TABLE, outcome, Workload(quick=True)).verdict == Verdict.NONE


def test_orders_that_are_turned_are_named():
    assert "high is not above low" in judge(TABLE, Findings(rates(75, 75)), SAMPLE).reasons


def test_a_printed_formula_is_wrong_if_it_gives_another_number():
    ours = [*rates(88, 60), Number("exact", 2.0)]
    for printed_formula, wrong in (
        (ours[0], False),
        (Number.rate("high", 10, 100), True),
        (Number.rate("high", 100, 100), True),
        (Number("exact", 3.0), True),
        (Number("exact", 2.0), False),
    ):
        judgement = judge(TABLE, Findings(ours, printed_formula=[printed_formula]), SAMPLE)
        assert judgement.wrong_formula is wrong
        assert judgement.text == "reproduced; printed formula is wrong" if wrong else "reproduced"


def test_a_wrong_formula_that_gives_the_print_is_said_to():
    text = judge(
        TABLE, Findings(rates(40, 20), printed_formula=[Number("high", 90.0, unit="%")]), SAMPLE
    ).text
    assert text == "ordering reproduced; printed formula is wrong, and gives the thesis' numbers"
    own = Number("high", 35.0, printed=35.0, unit="%")
    assert judge(
        TABLE,
        Findings([Number("high", 27.0, unit="%"), rates(40, 20)[1]], printed_formula=[own]),
        SAMPLE,
    ).matches_thesis
    # What is outside the printed number's interval gives something else again.
    text = judge(
        TABLE, Findings(rates(40, 20), printed_formula=[Number("high", 10.0, unit="%")]), SAMPLE
    ).text
    assert text == "ordering reproduced; printed formula is wrong"
