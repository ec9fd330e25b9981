"""Whether an artefact is reproduced, decided from the numbers by stated rules."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from importlib.resources import files
from itertools import permutations

import yaml

from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Findings, Number, Workload


class Verdict(StrEnum):
    """The verdicts on an artefact; there are no others."""

    REPRODUCED = "reproduced"
    ORDERING = "ordering reproduced"
    ALTERNATIVE = "reachable only with other settings"
    NOT = "not reproducible"
    WRONG_FORMULA = "printed formula is wrong"
    NONE = "no verdict, for a quick run"


_TEXTS = yaml.safe_load(
    (files("safe_envs.scripts.reproduce") / "thesis" / "verdicts.yaml").read_text("utf-8")
)
RULES = {verdict: _TEXTS[verdict.value] for verdict in Verdict}
"""By what each verdict is reached, in words."""

_WIDEST = 2.0
"""How many times wider than that of a printed rate our interval may be, to say that the two agree.
"""


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
        """Return the verdict in words."""
        if not self.wrong_formula:
            return self.verdict.value
        matches = ", and gives the thesis' numbers" if self.matches_thesis else ""
        return f"{self.verdict}; {Verdict.WRONG_FORMULA}{matches}"

    @property
    def mood(self) -> str:
        """Return how good that is: "good", "middle" or "bad"."""
        return {Verdict.REPRODUCED: "good", Verdict.NOT: "bad"}.get(self.verdict, "middle")


def judge(artefact: Artefact, outcome: Findings, sample: Workload) -> Judgement:
    """Return the verdict by `RULES`.

    Args:
        artefact: that was computed.
        outcome: of it.
        sample: how much was simulated.
    """
    if sample.quick:
        return Judgement(Verdict.NONE)
    apart = [text for number in outcome.numbers if (text := disagreement(number))]
    failed = [claim.sentence for claim in outcome.claims if claim.printed and not claim.holds]
    orders = printed_orders(outcome.numbers)
    turned = _turned(orders)
    reasons = [
        *apart,
        *(f"does not hold: {sentence}" for sentence in failed),
        *(f"{first.name} is not above {second.name}" for first, second in turned),
    ]
    other = next(
        (
            name
            for name, found in outcome.alternative_settings.items()
            if _reached(found, outcome, failed)
        ),
        None,
    )
    if not reasons and _says_something(outcome):
        verdict = Verdict.REPRODUCED
    elif orders and not turned and not failed:
        verdict = Verdict.ORDERING
    elif other is not None:
        verdict, reasons = (
            Verdict.ALTERNATIVE,
            [*reasons, f"agrees with the other setting: {other}"],
        )
    else:
        verdict, reasons = (
            Verdict.NOT,
            [*reasons, *([artefact.argument] if artefact.argument else [])],
        )
    wrong = [number for number in outcome.printed_formula if not _same(number, outcome.numbers)]
    reasons += [f"by the printed formula {n.name} is {n.ours:.3g}{n.suffix}" for n in wrong]
    return Judgement(verdict, bool(wrong), _matches_thesis(outcome), tuple(reasons))


def _says_something(outcome: Findings) -> bool:
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
    low, high = _ends(number)
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
    """Return pairs of printed numbers of one unit that the printed sample sizes can tell apart.

    The larger number comes first.
    """
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


def _reached(found: Findings, outcome: Findings, failed: Sequence[str]) -> bool:
    """Return whether another setting gives all that is printed, and what fails otherwise."""
    claims = {claim.sentence: claim.holds for claim in found.claims if claim.printed}
    names = {number.name for number in found.numbers if number.printed is not None}
    return (
        names >= {number.name for number in outcome.numbers if number.printed is not None}
        and claims.keys() >= set(failed)
        and all(claims.values())
        and not any(map(disagreement, found.numbers))
        and not _turned(printed_orders(found.numbers))
    )


def _matches_thesis(outcome: Findings) -> bool:
    """Return whether numbers by the printed formula agree with the printed ones."""
    printed = {number.name: number for number in outcome.numbers}
    both = [
        n if n.printed is not None else _compared(n, printed[n.name])
        for n in outcome.printed_formula
    ]
    both = [number for number in both if number.printed is not None]
    return bool(both) and not any(map(disagreement, both))


def _compared(number: Number, other: Number) -> Number:
    """Return a number with the printed value of another one."""
    return replace(number, printed=other.printed, printed_trials=other.printed_trials)


def _same(printed_form: Number, numbers: Sequence[Number]) -> bool:
    ours = next(number for number in numbers if number.name == printed_form.name)
    (low, high), (our_low, our_high) = _ends(printed_form), _ends(ours)
    return low <= our_high and our_low <= high


def _ends(number: Number) -> tuple[float, float]:
    """Return the ends of our interval; the number itself where it has none."""
    return (
        (number.ours, number.ours)
        if number.low is None or number.high is None
        else (number.low, number.high)
    )


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
