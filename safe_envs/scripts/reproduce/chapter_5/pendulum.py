"""The pendulum under unknown noise (thesis Sec. 5.4.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from safe_envs.agents import make_problem
from safe_envs.agents.evaluation.bound_check import starts_of
from safe_envs.agents.evaluation.contradiction import by_rate
from safe_envs.scripts.reproduce.chapter_5.noise_identification import (
    NoiseIdentification,
    identifications,
    learning_values,
    models,
    repeated,
)
from safe_envs.scripts.reproduce.chapter_5.noise_terms import draw_learning, learning_outcome
from safe_envs.scripts.reproduce.chapter_5.paired_rates import (
    CHAPTER,
    EPISODES,
    NO_RATE,
    close,
    explain_gap,
    measured,
)
from safe_envs.scripts.reproduce.framework.artefact import Findings, Workload
from safe_envs.scripts.reproduce.framework.paired import MeasuredFilter, safer
from safe_envs.scripts.reproduce.framework.verdict import disagreement
from safe_envs.wrappers import DDSCBF, SCBF, SafetyFilter
from safe_envs.wrappers.verification.feasibility import verify

_SETTINGS = CHAPTER.settings["pendulum"]
ENV, NOISE, THRESHOLD = (_SETTINGS[name] for name in ("env", "noise", "threshold"))
PRINTED = CHAPTER.printed("table-5.1")
WITHOUT = f"cbf:alpha={NO_RATE}"
_UNBOUNDED = [-1e4, 1e4]  # input bounds that are never met, N m


@dataclass(frozen=True)
class PendulumSetting:
    """What the thesis leaves open.

    Attributes:
        name: a letter.
        start: of the environment.
        horizon: in s.
        alpha: class-K rate of the CBF, in 1/s.
        longest: up to which horizon the printed rates are looked for, in s.
    """

    name: str
    start: str
    horizon: float
    alpha: float
    longest: float

    @property
    def cbf(self) -> str:
        """Return the text of the CBF."""
        return f"cbf:alpha={self.alpha}"

    def options(self, sample: Workload) -> dict[str, Any]:
        """Return the environment's arguments: a quick sample ends after 5 s at the latest."""
        return {"start": self.start, "horizon": sample.work(round(2 * self.horizon)) / 2}

    def describe(self, sample: Workload) -> str:
        """Return it in words."""
        where = {"near-origin": "from (.1 rad, .1 rad/s)", "uniform": "uniform in C"}[self.start]
        return (
            f"{self.name}: {where}, {self.options(sample)['horizon']:g} s, CBF with alpha(h) ="
            f" {self.alpha:g} h 1/s"
        )


A, B = (
    PendulumSetting(name, *values) for name, values in CHAPTER.settings["pendulum_settings"].items()
)


def compute_table(sample: Workload) -> Findings:
    """Compute Table 5.1 in both settings."""
    learned = repeated(ENV, NOISE, sample)
    found = {
        each: measured(
            ENV, each.options(sample), [each.cbf, WITHOUT, "scbf"], models(learned), sample
        )
        for each in (B, A)
    }
    (main, runs), (other, others) = (
        (outcome_of(each, found[each], _quiet(each, sample)), found[each]) for each in (B, A)
    )
    literal = measured(ENV, B.options(sample), [], models(learned, "printed"), sample)["ddscbf"]
    return Findings(
        numbers=main.numbers,
        claims=main.claims,
        alternative_settings={A.describe(sample): other},
        printed_formula=[literal.number("DDSCBF", PRINTED["DDSCBF"])],
        data={each.name: {text: run.curve for text, run in found[each].items()} for each in (B, A)},
        notes=[
            in_other_setting(other),
            explain_gap(runs, B.cbf, "in B"),
            explain_gap(others, A.cbf, "in A"),
            _by_printed_estimator(learned, sample),
            _sampled(sample),
            *([] if sample.quick else [_horizons(each, sample) for each in (B, A)]),
            *_bounds(learned[0], runs["scbf"], sample),
        ],
    )


def _quiet(setting: PendulumSetting, sample: Workload) -> MeasuredFilter:
    """Return the rate of the CBF on the same episodes without noise."""
    return measured(ENV, {**setting.options(sample), "noise": 0.0}, [setting.cbf], [], sample)[
        setting.cbf
    ]


def outcome_of(
    setting: PendulumSetting, runs: dict[str, MeasuredFilter], quiet: MeasuredFilter
) -> Findings:
    """Return numbers and claims in a setting.

    Args:
        setting: which.
        runs: of SCBF, DDSCBF, and the CBF with and without its class-K term.
        quiet: of the CBF on the same episodes without noise.
    """
    cbf, ddscbf = runs[setting.cbf], runs["ddscbf"]
    numbers = [
        *(
            runs[text].number(name, PRINTED[name])
            for name, text in (("SCBF", "scbf"), ("DDSCBF", "ddscbf"), ("CBF", setting.cbf))
        ),
        runs[WITHOUT].number("CBF with alpha = 0"),
    ]
    ends = {"low": 100 * ddscbf.row.ci_low, "high": 100 * ddscbf.row.ci_high}
    claim = partial(CHAPTER.claim, "table-5.1")
    claims = [
        claim("unsafe", cbf.row.safe == 0, row=cbf.row),
        safer(
            "the noise makes trajectories unsafe with the CBF that are safe without it", quiet, cbf
        ),
        claim("above", ddscbf.rate > THRESHOLD, rate=ddscbf.rate, **ends),
        close(runs, PRINTED["SCBF"], PRINTED["DDSCBF"]),
    ]
    return Findings(numbers, claims)


def in_other_setting(other: Findings) -> str:
    """Return the verdict's reasons had the other setting been the main one, in words."""
    apart = [text for number in other.numbers if (text := disagreement(number))]
    failed = [
        f"it does not hold that {claim.sentence}"
        for claim in other.claims
        if claim.printed and not claim.holds
    ]
    reasons = "; ".join([*apart, *failed]) or "all as in the thesis"
    return CHAPTER.note("table-5.1", "other", reasons=reasons)


def _by_printed_estimator(learned: list[NoiseIdentification], sample: Workload) -> str:
    printed = models(learned, "printed")
    options = ({**A.options(sample), **box} for box in ({}, {"box": _UNBOUNDED}))
    rates = (measured(ENV, each, [], printed, sample)["ddscbf"].rate for each in options)
    bounded, free = rates
    return CHAPTER.note("table-5.1", "estimator", bounded=bounded, free=free)


def _sampled(sample: Workload) -> str:
    """Return what the CBF of A loses to the control period alone, in words."""
    ahead = f"{A.cbf}:sampling_margin=first-order"
    said = []
    for where, noise in (("without noise", 0.0), ("with it", NOISE)):
        found = measured(ENV, {**A.options(sample), "noise": noise}, [A.cbf, ahead], [], sample)
        runs = {"plain": found[A.cbf], "ahead": found[ahead]}
        said.append(CHAPTER.note("table-5.1", "sampled", where=where, **runs))
    return f"the CBF is held for 10 ms; safe in A: {'; '.join(said)}"


def _horizons(setting: PendulumSetting, sample: Workload) -> str:
    """Return up to which horizons the printed rates of SCBF and CBF are reproduced, in words."""
    found = measured(
        ENV, {"start": setting.start, "horizon": setting.longest}, [setting.cbf, "scbf"], [], sample
    )
    agreeing = []
    for name, text in (("SCBF", "scbf"), ("CBF", setting.cbf)):
        numbers = found[text].at_each_horizon(PRINTED[name])
        times = found[text].curve["time"]
        agreeing.append({t for t, n in zip(times, numbers, strict=True) if disagreement(n) is None})
    both, tried = sorted(agreeing[0] & agreeing[1]), len(found["scbf"].row.curve.time)
    said = f"{len(both)} of {tried} horizons up to {setting.longest:g} s" + (
        f", from {both[0]:.3g} to {both[-1]:.3g} s" if both else ""
    )
    return f"{setting.name}: the printed rates of SCBF and of CBF are both reproduced at {said}"


def _bounds(first: NoiseIdentification, scbf: MeasuredFilter, sample: Workload) -> list[str]:
    """Return what Prop. 4.2.8 gives, and what Prop. 5.2.2 asks for at the origin, in words."""
    problem, model = make_problem(ENV, **B.options(sample)), first.learned["martingale"]
    margin = next(iter(model.record.errors.values()))
    answer = SafetyFilter.for_problem(problem, DDSCBF(model, margin=margin))
    slack = float(np.max(answer.filter([0.0, 0.0], [0.0]).slack))
    met = (
        f"violates the condition by {slack:.2g} 1/s, so that h/sup h does not apply to DDSCBF"
        if slack > 0.0
        else "meets the condition"
    )
    notes = [CHAPTER.note("table-5.1", "margin", margin=margin, met=met)]
    if sample.quick:
        return notes
    guarantee = verify(problem, (SCBF(),)).guarantee
    bound = guarantee.applicable_bounds(starts_of(problem), problem.duration)[0]
    bound = bound.without(by_rate(bound.value, scbf.row.ci_high))
    value = f"none, {bound.reason}" if bound.value is None else f"{100 * bound.value:.1f} %"
    return [*notes, CHAPTER.note("table-5.1", "bound", bound=bound, value=value)]


def printed_term(theta: Any) -> Any:
    """Return Eq. (5.19) at sigma = .1, for theta in rad."""
    return -math.sqrt(3) * (0.1 * theta) ** 2


def _table_values(sample: Workload) -> dict[str, Any]:
    return {
        "main": B.describe(sample),
        "count": sample.size(EPISODES),
        "identifications": identifications(sample),
    }


ARTEFACTS = (
    CHAPTER.artefact(
        "figure-5.1",
        partial(learning_outcome, ENV, NOISE, 0, "-sqrt(3) (.1 theta)^2", printed_term),
        partial(learning_values, region="C", law=f"sigma = {NOISE:g} theta"),
        draw_learning,
    ),
    CHAPTER.artefact("table-5.1", compute_table, _table_values),
)
