"""Table 4.1: safety of SRCBF and SCBF in adaptive cruise control (Sec. 4.3.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np
from scipy.special import ndtr, ndtri

from safe_envs.systems.acc import WEIGHT
from thesis.artefact import Claim, Number, Outcome, Sample, texts
from thesis.chapter_4 import cruise
from thesis.chapter_4.cruise import ASSUMED, CAR, FITTED
from thesis.rates import difference, measure

PRINTED = texts()["table-4.1"].printed
Safe = Mapping[str, np.ndarray]
"""Which episodes are safe in each cell, by the cell's name."""


def compute(sample: Sample) -> tuple[Outcome, None]:
    """Compute Table 4.1, also with other settings."""
    episodes, more = sample.size(CAR.episodes), sample.size(CAR.fitted_episodes)
    step = CAR.coarse_step if sample.quick else CAR.step
    safe, by_printed_qp, fitted = (
        _cells(each, count, sample.seed, step)
        for each, count in (
            (ASSUMED, episodes),
            (cruise.PRINTED_QP, episodes),
            (FITTED, more),
        )
    )
    count = f"{len(PRINTED)} printed numbers by {len(vars(FITTED))} quantities"
    return Outcome(
        numbers_of(safe),
        claims_of(safe),
        {
            cruise.BY_PRINTED_QP: Outcome(numbers_of(by_printed_qp), claims_of(by_printed_qp)),
            f"fitted by us, {count}; {more} episodes": Outcome(
                numbers_of(fitted), claims_of(fitted)
            ),
        },
        notes=[
            _gaussian(),
            f"a search of ours fitted {count}: where they agree, that shows that the table can be"
            " reached, and not how it was",
            *([] if sample.quick else _sweep(episodes, sample.seed)),
        ],
    ), None


def _cells(setting: SimpleNamespace, episodes: int, seed: int, step: float) -> Safe:
    """Return which episodes are safe in the four cells of the table."""
    return {
        f"{condition}, {control}": _safe(setting, text, limit, episodes, seed, step)
        for control, limit in (("unbounded", CAR.unbounded), ("bounded", setting.limit))
        for condition, text in cruise.filters_of(setting).items()
    }


def _safe(
    setting: SimpleNamespace, text: str, limit: float, episodes: int, seed: int, step: float
) -> np.ndarray:
    return measure(cruise.problem_of(setting, limit, step), text, episodes, seed).flags[0]


def numbers_of(safe: Safe) -> list[Number]:
    """Return the numbers of the table."""
    return [
        Number.rate(name, int(flags.sum()), len(flags), PRINTED[name], CAR.episodes)
        for name, flags in safe.items()
    ]


def claims_of(safe: Safe) -> list[Claim]:
    """Return the claims of the text, each by the same episodes in two or all of the four cells."""
    flags = {name: [each] for name, each in safe.items()}
    unbounded = difference("", flags["SRCBF, unbounded"], flags["SCBF, unbounded"])
    bounded = difference("", flags["SCBF, bounded"], flags["SRCBF, bounded"])
    lost = {
        name: safe[f"{name}, unbounded"].astype(float) - safe[f"{name}, bounded"]
        for name in ("SRCBF", "SCBF")
    }
    more = Number.mean("", 100 * (lost["SRCBF"] - lost["SCBF"]), "points", -200.0, 200.0)
    each = ", ".join(f"{name} {100 * values.mean():.1f} points" for name, values in lost.items())
    return [
        Claim(
            "with unbounded control SRCBF is the safer one (Sec. 4.3.1, 4.2.3)",
            unbounded.is_above(),
            f"SRCBF - SCBF of {unbounded.text} on the same episodes",
        ),
        Claim(
            "with bounded control SCBF is the safer one",
            bounded.is_above(),
            f"SCBF - SRCBF of {bounded.text} on the same episodes",
        ),
        Claim(
            "saturation costs SRCBF more safety than SCBF",
            more.is_above(),
            f"it costs {each}; a difference of {more.text} on the same episodes",
        ),
    ]


def most_unsafe(tau: float) -> float:
    """Return the largest probability of a violation under any controller with A h >= 0.

    Then h >= h_0 - tau sigma_1 W_t, for the headway tau in s.
    """
    deviation = tau * CAR.noise * math.sqrt(CAR.horizon)
    return float(2.0 * ndtr(-(CAR.start[2] - tau * CAR.start[0]) / deviation))


def headway_for(unsafe: float) -> float:
    """Return the tau in s at which `most_unsafe` is a given probability."""
    reach = float(ndtri(unsafe / 2.0)) * CAR.noise * math.sqrt(CAR.horizon)
    return CAR.start[2] / (CAR.start[0] - reach)


def _gaussian() -> str:
    unsafe = 1 - PRINTED["SCBF, unbounded"] / 100
    return (
        "under any controller with A h >= 0, h >= h_0 - tau sigma_1 W_t, so that P(unsafe) <= 2"
        f" Phi(-h_0/(tau sigma_1 sqrt(T))) = {most_unsafe(ASSUMED.tau):.1g} for tau ="
        f" {ASSUMED.tau} s, {most_unsafe(FITTED.tau):.2f} for tau = {FITTED.tau} s;"
        f" {100 * unsafe:.0f} % unsafe with unbounded SCBF needs tau >= {headway_for(unsafe):.2f} s"
    )


def _sweep(episodes: int, seed: int) -> list[str]:
    """Return the rates with other limits of the force, and with other gammas, in words."""
    filters = cruise.filters_of(ASSUMED)
    cases = [(text, share * WEIGHT) for share in CAR.further_limits for text in filters.values()]
    cases += [
        (f"srcbf:gamma={gamma}", limit)
        for gamma in CAR.further_gammas
        for limit in (CAR.unbounded, ASSUMED.limit)
    ]
    return [
        f"{text}, |u| <= {limit:.4g} N: {100 * safe.mean():.0f} % safe"
        for text, limit in cases
        for safe in [_safe(ASSUMED, text, limit, episodes, seed, CAR.step)]
    ]


ARTEFACTS = {"table-4.1": compute}
