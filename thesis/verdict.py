"""Whether an artefact is reproduced, decided from the numbers by these rules.

- **reproduced**: every claim of the thesis holds, every printed number agrees, and no order of
  printed numbers is turned. A rate agrees if the 95 % interval of its difference to the printed
  one, at the printed sample size, holds 0, and ours is at most twice as wide as the thesis';
  another number, if the printed one is inside our 95 % interval. An order counts if the printed
  sample sizes can tell the two numbers apart at 95 %.
- **ordering reproduced**: some number does not agree, but every claim holds, and no order of
  printed numbers is turned.
- **reachable only with other settings**: neither of the above, but with the settings that are
  named every printed number agrees, no order is turned, and the claims that are looked at there
  hold, among them all that do not hold otherwise.
- **not reproducible**: none of the above; the argument is given, if one is known.
- **printed formula is wrong**: said in addition: a number by the printed formula is outside our
  interval by the corrected one. It gives the thesis' numbers where these agree with them.
- **no verdict, for a quick run**: a twentieth of the work shows that it works, and not what comes
  out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import permutations

from safe_envs.agents import rate_interval
from thesis.artefact import Number, Outcome, Sample


class Verdict(StrEnum):
    """The verdicts on an artefact; there are no others."""

    REPRODUCED = "reproduced"
    ORDERING = "ordering reproduced"
    ALTERNATIVE = "reachable only with other settings"
    NOT = "not reproducible"
    WRONG_FORMULA = "printed formula is wrong"
    NONE = "no verdict, for a quick run"


_WIDEST = 2.0
"""How many times wider than that of a printed rate our interval may be, to say that they agree."""


@dataclass(frozen=True)
class Judgement:
    """A verdict with its reasons.

    Attributes:
        verdict: the main one.
        wrong_formula: whether the printed formula gives something else than the corrected one.
        matches_thesis: whether the numbers by the printed formula agree with the printed ones.
        reasons: of the verdict.
    """

    verdict: Verdict
    wrong_formula: bool = False
    matches_thesis: bool = False
    reasons: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The verdict in words."""
        if not self.wrong_formula:
            return self.verdict.value
        matches = ", and gives the thesis' numbers" if self.matches_thesis else ""
        return f"{self.verdict}; {Verdict.WRONG_FORMULA}{matches}"


def judge(outcome: Outcome, sample: Sample, argument: str = "") -> Judgement:
    """Return the verdict by the rules of the module, with the argument where it says "not"."""
    if sample.quick:
        return Judgement(Verdict.NONE)
    failed = [claim.sentence for claim in outcome.claims if claim.printed and not claim.holds]
    orders = printed_orders(outcome.numbers)
    turned = _turned(orders)
    reasons = [
        *filter(None, map(disagreement, outcome.numbers)),
        *(f"does not hold: {sentence}" for sentence in failed),
        *(f"{first.name} is not above {second.name}" for first, second in turned),
    ]
    others = outcome.alternative_settings.items()
    reached = [name for name, other in others if _reached(other, outcome, failed)]
    if not reasons and _says_something(outcome):
        verdict = Verdict.REPRODUCED
    elif orders and not turned and not failed:
        verdict = Verdict.ORDERING
    elif reached:
        verdict = Verdict.ALTERNATIVE
        reasons.append(f"agrees with the other setting: {reached[0]}")
    else:
        verdict = Verdict.NOT
        reasons += [argument] if argument else []
    ours = {number.name: number for number in outcome.numbers}
    wrong = [n for n in outcome.printed_formula if not _overlap(n.ends, ours[n.name].ends)]
    reasons += [f"by the printed formula {n.name} is {n.ours:.3g}{n.suffix}" for n in wrong]
    return Judgement(verdict, bool(wrong), _matches_thesis(outcome), tuple(reasons))


def _says_something(outcome: Outcome) -> bool:
    return any(number.printed is not None for number in outcome.numbers) or any(
        claim.printed for claim in outcome.claims
    )


def disagreement(number: Number) -> str | None:
    """Return why a printed number and ours differ; None where they may agree or none is printed."""
    if number.printed is None:
        return None
    text = (
        f"{number.name}: {number.printed:g}{number.suffix} printed,"
        f" {number.ours:.3g}{number.suffix} here"
    )
    low, high = number.ends
    if number.printed_trials is None:
        return None if low <= number.printed <= high else text
    printed_low, printed_high = _printed_ends(number.printed, number.printed_trials)
    below, above = _difference(
        (number.ours, low, high), (number.printed, printed_low, printed_high)
    )
    if not below <= 0.0 <= above:
        return text
    wide = high - low > _WIDEST * (printed_high - printed_low)
    return f"{text}, where [{low:.3g}, {high:.3g}] is too wide to tell" if wide else None


def printed_orders(numbers: Sequence[Number]) -> list[tuple[Number, Number]]:
    """Return pairs of printed numbers, larger first, that their sample sizes can tell apart."""
    return [(a, b) for a, b in permutations(numbers, 2) if a.unit == b.unit and _is_above(a, b)]


def _is_above(first: Number, second: Number) -> bool:
    if first.printed is None or second.printed is None:
        return False
    if first.printed_trials is None or second.printed_trials is None:
        return first.printed > second.printed
    above = (first.printed, *_printed_ends(first.printed, first.printed_trials))
    below = (second.printed, *_printed_ends(second.printed, second.printed_trials))
    return _difference(above, below)[0] > 0.0


def _turned(orders: Sequence[tuple[Number, Number]]) -> list[tuple[Number, Number]]:
    return [(first, second) for first, second in orders if not first.ours > second.ours]


def _reached(other: Outcome, outcome: Outcome, failed: Sequence[str]) -> bool:
    """Return whether another setting gives all that is printed, and what fails otherwise."""
    claims = {claim.sentence: claim.holds for claim in other.claims if claim.printed}
    printed, wanted = (
        {number.name for number in each.numbers if number.printed is not None}
        for each in (other, outcome)
    )
    return (
        printed >= wanted
        and claims.keys() >= set(failed)
        and all(claims.values())
        and not any(map(disagreement, other.numbers))
        and not _turned(printed_orders(other.numbers))
    )


def _matches_thesis(outcome: Outcome) -> bool:
    """Return whether numbers by the printed formula agree with the printed ones."""
    ours = {number.name: number for number in outcome.numbers}
    both = [
        n
        if n.printed is not None
        else replace(n, printed=ours[n.name].printed, printed_trials=ours[n.name].printed_trials)
        for n in outcome.printed_formula
    ]
    both = [number for number in both if number.printed is not None]
    return bool(both) and not any(map(disagreement, both))


def _overlap(first: tuple[float, float], second: tuple[float, float]) -> bool:
    return first[0] <= second[1] and second[0] <= first[1]


def _printed_ends(rate: float, trials: int) -> tuple[float, float]:
    low, high = rate_interval(round(trials * rate / 100), trials)
    return 100 * low, 100 * high


def _difference(
    first: tuple[float, float, float], second: tuple[float, float, float]
) -> tuple[float, float]:
    """Return the interval of the difference of two independent quantities, each with its own.

    Source: R. G. Newcombe, Interval estimation for the difference between independent proportions,
        Statistics in Medicine 17 (1998) 873-890, method 10.
    """
    (a, a_low, a_high), (b, b_low, b_high) = first, second
    return a - b - math.hypot(a - a_low, b_high - b), a - b + math.hypot(a_high - a, b - b_low)
