"""Verdicts follow from numbers by the stated rules."""

from __future__ import annotations

from dataclasses import replace

import pytest

from scripts.reproduce.artefact import Artefact, Claim, Number, Outcome
from scripts.reproduce.verdict import RULES, Verdict, agrees, judge

TABLE = Artefact("table-0.0", "", lambda _: Outcome(), (), orderings=(("high", "low"),), argument="no two are alike")


def rates(high, low, printed=(90.0, 60.0)):
    return [Number.rate("high", high, 100, printed[0], 50), Number.rate("low", low, 100, printed[1], 50)]


def test_a_number_agrees_by_either_interval():
    assert agrees(Number("a", 1.0))
    assert agrees(Number("a", 1.0, 0.9, 1.1, printed=1.05))
    assert not agrees(Number("a", 1.0, 0.9, 1.1, printed=1.2))
    assert not agrees(Number("a", 1.0, printed=1.0001))
    # 45 of 50 have the interval 78.6 to 95.7 %.
    assert agrees(Number.rate("a", 79, 100, 90.0, 50))
    assert not agrees(Number.rate("a", 700, 1000, 90.0, 50))


@pytest.mark.parametrize(
    ("outcome", "verdict"),
    [
        (Outcome(rates(88, 60)), Verdict.REPRODUCED),
        (Outcome(rates(88, 60), [Claim("", False, "")]), Verdict.NOT),
        (Outcome(rates(40, 20)), Verdict.ORDERING),
        (Outcome(rates(20, 40)), Verdict.NOT),
        (Outcome(rates(20, 40), elsewhere={"more noise": Outcome(rates(88, 60))}), Verdict.ELSEWHERE),
        (Outcome(rates(20, 40), elsewhere={"more noise": Outcome(rates(88, 20))}), Verdict.NOT),
        (Outcome(rates(20, 40), elsewhere={"more noise": Outcome(rates(88, 60), [Claim("", False, "")])}), Verdict.NOT),
        (Outcome(rates(20, 40), elsewhere={"more noise": Outcome([Number("nothing printed", 1.0)])}), Verdict.NOT),
        (Outcome(claims=[Claim("", False, "")], elsewhere={"more noise": Outcome(claims=[Claim("", True, "")])}), Verdict.ELSEWHERE),
        (Outcome(claims=[Claim("", True, "")]), Verdict.REPRODUCED),
        (Outcome(claims=[Claim("it flies", False, "")]), Verdict.NOT),
    ],
)
def test_the_verdict_follows_from_the_numbers(outcome, verdict):
    judgement = judge(replace(TABLE, orderings=TABLE.orderings if outcome.numbers else ()), outcome)
    assert judgement.verdict == verdict
    assert verdict in RULES
    if verdict == Verdict.ELSEWHERE:
        assert "agrees with more noise" in judgement.reasons
    if verdict == Verdict.NOT:
        assert TABLE.argument in judgement.reasons


def test_a_printed_formula_is_wrong_if_it_gives_another_number():
    ours = rates(88, 60)
    for as_printed, wrong in (([ours[0]], False), ([Number.rate("high", 10, 100)], True), ([Number("high", 3.0)], True)):
        judgement = judge(TABLE, Outcome(ours, as_printed=as_printed))
        assert judgement.wrong_formula is wrong
        assert ("printed formula" in judgement.text) is wrong
        assert judgement.text.startswith("reproduced")
