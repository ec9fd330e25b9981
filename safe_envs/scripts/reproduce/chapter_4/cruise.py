"""Thesis Sec. 4.3.1: safety of SRCBF and SCBF in adaptive cruise control (Table 4.1), and the
artefacts of that section."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from safe_envs.agents.policies.nominal import NominalController
from safe_envs.scripts.reproduce.chapter_4.cruise_effort import FIGURE
from safe_envs.scripts.reproduce.chapter_4.cruise_setting import (
    AS_PRINTED,
    CHOSEN,
    CORRECTIONS,
    EPISODES,
    FITTED,
    FITTED_GOAL,
    HORIZON,
    NOISE,
    PRINTED_PROGRAM,
    QUANTITIES,
    START,
    STEP,
    TAKEN,
    UNBOUNDED,
    CruiseSettings,
    describe,
)
from safe_envs.scripts.reproduce.chapter_4.paired_episodes import (
    difference,
    exits,
    is_above,
    with_interval,
)
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Claim, Number, Outcome, Sample
from safe_envs.systems.acc import WEIGHT

COARSE = 0.2
"""Control period of a quick look at the table, in s."""
MORE = 1000
"""Episodes with the fitted setting, which is to be told from its neighbours."""
SWEEP = (0.25, 0.4)
"""Further limits of the force, in M g."""
GAMMAS = (0.01, 100.0)
"""Further gammas, in 1/(m^2 s)."""
PRINTED = {
    "SRCBF, unbounded": 92.0,
    "SCBF, unbounded": 80.0,
    "SRCBF, bounded": 25.0,
    "SCBF, bounded": 70.0,
}
"""Table 4.1, in %."""
Safe = Mapping[str, np.ndarray]
"""Which episodes are safe in each cell, by the cell's name."""


def cells(setting: CruiseSettings, episodes: int, seed: int, step: float) -> Safe:
    """Simulate the four cells of the table."""
    limits = {"unbounded": UNBOUNDED, "bounded": setting.limit}
    return {
        f"{condition}, {control}": safe_with(setting, text, limit, episodes, seed, step)
        for control, limit in limits.items()
        for condition, text in setting.filters.items()
    }


def safe_with(
    setting: CruiseSettings, text: str, limit: float, episodes: int, seed: int, step: float
) -> np.ndarray:
    """Which episodes are safe to the end with a condition and a limit of the force in N, shape
    (episodes,)."""
    problem = setting.problem(limit, step)
    return exits(problem, text, NominalController(problem), episodes, seed).safe(problem.steps)


def outcome_of(safe: Safe) -> Outcome:
    """Numbers and claims of the table."""
    rates = [
        Number.rate(name, int(flags.sum()), len(flags), PRINTED[name], EPISODES)
        for name, flags in safe.items()
    ]
    return Outcome(rates, claims_of_table(safe))


def claims_of_table(safe: Safe) -> list[Claim]:
    """What the text says of the four cells, each by the same episodes in two or all of them."""
    unbounded = difference("", safe["SRCBF, unbounded"], safe["SCBF, unbounded"])
    bounded = difference("", safe["SCBF, bounded"], safe["SRCBF, bounded"])
    lost = {
        name: safe[f"{name}, unbounded"].astype(float) - safe[f"{name}, bounded"]
        for name in ("SRCBF", "SCBF")
    }
    more = Number.mean("", 100 * (lost["SRCBF"] - lost["SCBF"]), "points", -200.0, 200.0)
    each = ", ".join(f"{name} {_change(values)}" for name, values in lost.items())
    return [
        Claim(
            "with unbounded control SRCBF is the safer one (Sec. 4.3.1, 4.2.3)",
            is_above(unbounded),
            _by(unbounded, "SRCBF - SCBF"),
        ),
        Claim(
            "with bounded control SCBF is the safer one",
            is_above(bounded),
            _by(bounded, "SCBF - SRCBF"),
        ),
        Claim(
            "saturation costs SRCBF more safety than SCBF",
            is_above(more),
            f"{each}; {_by(more, 'a difference')}",
        ),
    ]


def _change(lost: np.ndarray) -> str:
    points = 100 * float(lost.mean())
    return (
        f"{'loses' if points > 0 else 'gains'} {abs(points):.1f} points"
        if points
        else "loses nothing"
    )


def _by(number: Number, what: str) -> str:
    return f"{what} of {with_interval(number)} points on the same episodes"


def compute_table(sample: Sample) -> Outcome:
    """Table 4.1, and with other settings."""
    episodes, step = sample.size(EPISODES), _step(sample)
    settings = {
        AS_PRINTED: (PRINTED_PROGRAM, episodes),
        _fitted(sample): (FITTED, sample.size(MORE)),
    }
    found = {
        name: cells(setting, count, sample.seed, step)
        for name, (setting, count) in settings.items()
    }
    notes = [_gaussian_note(), _odd_note(), _fitted_note(found[_fitted(sample)])]
    return replace(
        outcome_of(cells(TAKEN, episodes, sample.seed, step)),
        alternative_settings={name: outcome_of(safe) for name, safe in found.items()},
        notes=[*notes, *([] if sample.quick else _sweep(episodes, sample.seed, step))],
    )


def _step(sample: Sample) -> float:
    return COARSE if sample.quick else STEP


def _fitted(sample: Sample) -> str:
    return (
        f"fitted by us, {len(PRINTED)} printed numbers by {QUANTITIES} quantities;"
        f" {sample.size(MORE)} episodes"
    )


def _fitted_note(safe: Safe) -> str:
    before, after = (
        100 * float(safe[f"SCBF, {control}"].mean()) for control in ("unbounded", "bounded")
    )
    return (
        f"a search of ours fitted {len(PRINTED)} numbers by {QUANTITIES} quantities, {FITTED_GOAL},"
        f" |u| <= {FITTED.limit:g} N: where they agree, that shows that the table can be reached,"
        f" and not how it was. SCBF is {before:.1f} % safe there without and {after:.1f} % with a"
        f" bound; the print has {PRINTED['SCBF, unbounded']:g} % and {PRINTED['SCBF, bounded']:g} %"
    )


def headway_for(unsafe: float) -> float:
    """The tau in s at which `CruiseSettings.most_unsafe` is a given probability."""
    return START[2] / (START[0] - float(ndtri(unsafe / 2.0)) * NOISE * math.sqrt(HORIZON))


def _gaussian_note() -> str:
    unsafe = 1 - PRINTED["SCBF, unbounded"] / 100
    return (
        "under any controller with A h >= 0, h >= h_0 - tau sigma_1 W_t, so that P(unsafe) <= 2"
        f" Phi(-h_0/(tau sigma_1 sqrt(T))) = {TAKEN.most_unsafe():.1g} for tau = {TAKEN.tau} s,"
        f" {FITTED.most_unsafe():.2f} for tau = {FITTED.tau} s; {100 * unsafe:.0f} % unsafe with"
        f" unbounded SCBF needs tau >= {headway_for(unsafe):.2f} s"
    )


def _odd_note() -> str:
    printed = PRINTED["SRCBF, bounded"]
    return f"{printed:g} % of {EPISODES} runs is {printed * EPISODES / 100:g} runs"


def _sweep(episodes: int, seed: int, step: float) -> list[str]:
    """Other limits of the force, and other gammas."""

    def rate(text: str, limit: float) -> str:
        return f"{100 * safe_with(TAKEN, text, limit, episodes, seed, step).mean():.0f} %"

    limits = [
        f"|u| <= {share:g} M g: "
        + ", ".join(f"{name} {rate(text, share * WEIGHT)}" for name, text in TAKEN.filters.items())
        for share in SWEEP
    ]
    gammas = [
        f"SRCBF with gamma = {gamma:g}: {rate(text, UNBOUNDED)} unbounded,"
        f" {rate(text, TAKEN.limit)} bounded"
        for gamma, text in ((gamma, f"srcbf:gamma={gamma}") for gamma in GAMMAS)
    ]
    return [*limits, *gammas]


ARTEFACTS: tuple[Artefact, ...] = (
    FIGURE,
    Artefact(
        name="table-4.1",
        title=(
            "Safety of SRCBF and SCBF in adaptive cruise control, with unbounded and bounded force"
        ),
        compute=compute_table,
        setting=lambda sample: describe(sample.size(EPISODES), _step(sample)),
        assumptions=(*CHOSEN, "bounded control: |u| <= .3 M g"),
        errata=CORRECTIONS,
        argument=(
            f"with tau = {TAKEN.tau} s A h >= 0 makes P(unsafe) at most {TAKEN.most_unsafe():.1g},"
            f" so that {PRINTED['SCBF, unbounded']:g} % for the unbounded SCBF is out of reach"
        ),
    ),
)
