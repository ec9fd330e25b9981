"""Whether the print comes out, decided from the numbers by stated rules."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

from agents.statistics import rate_interval
from scripts.reproduce.artefact import Artefact, Number, Outcome


class Verdict(StrEnum):
    """What is said of an artefact; no others."""

    REPRODUCED = "reproduced"
    ORDERING = "ordering reproduced"
    ELSEWHERE = "reachable only with other settings"
    NOT = "not reproducible"
    WRONG_FORMULA = "printed formula is wrong"


RULES = {
    Verdict.REPRODUCED: "every claim holds, and every printed number agrees: a rate, if ours is inside the 95 % interval of the printed "
    "one at the printed sample size or the printed one inside ours; another number, if it is inside our 95 % interval",
    Verdict.ORDERING: "some number does not agree, but every claim holds, and so does every printed order of two numbers",
    Verdict.ELSEWHERE: "neither of the above, but with the settings that are named every printed number agrees, and every "
    "claim that is looked at there holds",
    Verdict.NOT: "none of the above; the argument stands beside it",
    Verdict.WRONG_FORMULA: "said besides: a number by the printed formula is outside our interval by the corrected one",
}


@dataclass(frozen=True)
class Judgement:
    """A verdict with its reasons.

    Attributes:
        verdict: the main one.
        wrong_formula: whether the printed formula gives something else than the corrected one.
        reasons: what the verdict rests on.
    """

    verdict: Verdict
    wrong_formula: bool
    reasons: tuple[str, ...]

    @property
    def text(self) -> str:
        """The verdict in words."""
        return f"{self.verdict}; {Verdict.WRONG_FORMULA}" if self.wrong_formula else str(self.verdict)

    @property
    def mood(self) -> str:
        """How good that is: "good", "middle" or "bad"."""
        return {Verdict.REPRODUCED: "good", Verdict.NOT: "bad"}.get(self.verdict, "middle")


def judge(artefact: Artefact, outcome: Outcome) -> Judgement:
    """Apply `RULES` to what came out."""
    ours = {number.name: number.ours for number in outcome.numbers}
    wrong = [n for n in outcome.as_printed if not _same(n, outcome.numbers)]
    failed = [claim.sentence for claim in outcome.claims if not claim.holds]
    apart = [number for number in outcome.numbers if not agrees(number)]
    turned = [pair for pair in artefact.orderings if not ours[pair[0]] > ours[pair[1]]]
    reasons = [
        *(f"{n.name}: {n.printed:g}{_unit(n)} printed, {n.ours:.3g}{_unit(n)} here" for n in apart),
        *(f"does not hold: {sentence}" for sentence in failed),
        *(f"{first} is not above {second}" for first, second in turned),
    ]
    other = next((name for name, found in outcome.elsewhere.items() if _reached(found)), None)
    if not apart and not failed:
        verdict = Verdict.REPRODUCED
    elif artefact.orderings and not turned and not failed:
        verdict = Verdict.ORDERING
    elif other is not None:
        verdict, reasons = Verdict.ELSEWHERE, [*reasons, f"agrees with {other}"]
    else:
        verdict, reasons = Verdict.NOT, [*reasons, *([artefact.argument] if artefact.argument else [])]
    reasons += [f"by the printed formula {n.name} is {n.ours:.3g}{_unit(n)}" for n in wrong]
    return Judgement(verdict, bool(wrong), tuple(reasons))


def agrees(number: Number) -> bool:
    """Whether a printed number and ours can be the same; True where none is printed."""
    if number.printed is None:
        return True
    if number.low is not None and number.high is not None and number.low <= number.printed <= number.high:
        return True
    if number.printed_trials is None:
        return False
    low, high = rate_interval(round(number.printed_trials * number.printed / 100), number.printed_trials)
    return 100 * low <= number.ours <= 100 * high


def _reached(outcome: Outcome) -> bool:
    """Whether the print comes out, where there is something that could say otherwise."""
    tested = bool(outcome.claims) or any(number.printed is not None for number in outcome.numbers)
    return tested and all(map(agrees, outcome.numbers)) and all(claim.holds for claim in outcome.claims)


def _same(printed_form: Number, numbers: Sequence[Number]) -> bool:
    ours = next(number for number in numbers if number.name == printed_form.name)
    if ours.low is None or ours.high is None:
        return printed_form.ours == ours.ours
    return _overlap((printed_form.low, printed_form.high, printed_form.ours), (ours.low, ours.high))


def _overlap(first: Iterable[float | None], second: tuple[float, float]) -> bool:
    ends = [end for end in first if end is not None]
    return min(ends) <= second[1] and second[0] <= max(ends)


def _unit(number: Number) -> str:
    return f" {number.unit}" if number.unit else ""
