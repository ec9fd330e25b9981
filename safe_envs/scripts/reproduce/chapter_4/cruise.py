"""Thesis Sec. 4.3.1: safety of SRCBF and SCBF in adaptive cruise control (Table 4.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from safe_envs.scripts.reproduce.chapter_4 import cruise_setting as car
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.episodes import violations
from safe_envs.scripts.reproduce.framework.paired import difference, is_above, with_interval
from safe_envs.systems.acc import WEIGHT

COARSE = 0.2  # control period of a quick look at the table, in s
MORE = 1000  # episodes with the fitted setting, which is to be told from its neighbours
SWEEP = (0.25, 0.4)  # further limits of the force, in M g
GAMMAS = (0.01, 100.0)  # further gammas, in 1/(m^2 s)
PRINTED = car.CHAPTER.printed("table-4.1")
Safe = Mapping[str, np.ndarray]
"""Which episodes are safe in each cell, by the cell's name."""


def cells(setting: car.CruiseSettings, episodes: int, seed: int, step: float) -> Safe:
    """Return which episodes are safe in the four cells of the table.

    Args:
        setting: of the car.
        episodes: of each cell.
        seed: of all of them.
        step: control period, in s.
    """
    limits = {"unbounded": car.UNBOUNDED, "bounded": setting.limit}
    return {
        f"{condition}, {control}": safe_with(setting, text, limit, episodes, seed, step)
        for control, limit in limits.items()
        for condition, text in setting.filters.items()
    }


def safe_with(
    setting: car.CruiseSettings, text: str, limit: float, episodes: int, seed: int, step: float
) -> np.ndarray:
    """Return which episodes are safe to the end, shape (episodes,).

    Args:
        setting: of the car.
        text: of the condition.
        limit: of the force, in N.
        episodes: how many.
        seed: of all of them.
        step: control period, in s.
    """
    problem = setting.problem(limit, step)
    return violations(problem, text, "nominal", episodes, seed).safe(problem.steps)


def outcome_of(safe: Safe) -> Findings:
    """Return numbers and claims of the table."""
    rates = [
        Number.rate(name, int(flags.sum()), len(flags), PRINTED[name], car.EPISODES)
        for name, flags in safe.items()
    ]
    return Findings(rates, claims_of_table(safe))


def claims_of_table(safe: Safe) -> list[Claim]:
    """Return the claims of the text, each by the same episodes in two or all of the four cells."""
    flags = {name: [each] for name, each in safe.items()}
    unbounded = difference("", flags["SRCBF, unbounded"], flags["SCBF, unbounded"])
    bounded = difference("", flags["SCBF, bounded"], flags["SRCBF, bounded"])
    lost = {
        name: safe[f"{name}, unbounded"].astype(float) - safe[f"{name}, bounded"]
        for name in ("SRCBF", "SCBF")
    }
    more = Number.mean("", 100 * (lost["SRCBF"] - lost["SCBF"]), "points", -200.0, 200.0)
    each = ", ".join(f"{name} {_change(values)}" for name, values in lost.items())
    gaps = {"unbounded": unbounded, "bounded": bounded, "saturation": more}
    return [
        car.CHAPTER.claim("table-4.1", name, is_above(gap), gap=with_interval(gap), each=each)
        for name, gap in gaps.items()
    ]


def _change(lost: np.ndarray) -> str:
    points = 100 * float(lost.mean())
    if not points:
        return "loses nothing"
    return f"{'loses' if points > 0 else 'gains'} {abs(points):.1f} points"


def compute_table(sample: Workload) -> Findings:
    """Compute Table 4.1, also with other settings."""
    episodes, step = sample.size(car.EPISODES), _step(sample)
    settings = {
        car.BY_PRINTED_QP: (car.PRINTED_QP, episodes),
        _fitted(sample): (car.FITTED, sample.size(MORE)),
    }
    found = {
        name: cells(setting, count, sample.seed, step)
        for name, (setting, count) in settings.items()
    }
    notes = [_gaussian_note(), _odd_note(), _fitted_note(found[_fitted(sample)])]
    return replace(
        outcome_of(cells(car.ASSUMED, episodes, sample.seed, step)),
        alternative_settings={name: outcome_of(safe) for name, safe in found.items()},
        notes=[*notes, *([] if sample.quick else _sweep(episodes, sample.seed, step))],
    )


def _step(sample: Workload) -> float:
    return COARSE if sample.quick else car.STEP


def _fitted(sample: Workload) -> str:
    return (
        f"fitted by us, {len(PRINTED)} printed numbers by {car.QUANTITIES} quantities;"
        f" {sample.size(MORE)} episodes"
    )


def _fitted_note(safe: Safe) -> str:
    before, after = (
        100 * float(safe[f"SCBF, {control}"].mean()) for control in ("unbounded", "bounded")
    )
    numbers = {"count": len(PRINTED), "quantities": car.QUANTITIES, "goal": car.FITTED_GOAL}
    rates = {"before": before, "after": after, "printed": PRINTED}
    return car.CHAPTER.note("table-4.1", "fitted", fitted=car.FITTED, **numbers, **rates)


def headway_for(unsafe: float) -> float:
    """Return the tau in s at which `CruiseSettings.most_unsafe` is a given probability."""
    return car.START[2] / (
        car.START[0] - float(ndtri(unsafe / 2.0)) * car.NOISE * math.sqrt(car.HORIZON)
    )


def _gaussian_note() -> str:
    unsafe = 1 - PRINTED["SCBF, unbounded"] / 100
    settings = {"assumed": car.ASSUMED, "fitted": car.FITTED}
    numbers = {"unsafe": 100 * unsafe, "needed": headway_for(unsafe)}
    return car.CHAPTER.note("table-4.1", "gaussian", **settings, **numbers)


def _odd_note() -> str:
    printed = PRINTED["SRCBF, bounded"]
    return car.CHAPTER.note("table-4.1", "odd", printed=printed, runs=printed * car.EPISODES / 100)


def _sweep(episodes: int, seed: int, step: float) -> list[str]:
    """Return the rates with other limits of the force, and with other gammas, in words."""

    def rate(text: str, limit: float) -> str:
        return f"{100 * safe_with(car.ASSUMED, text, limit, episodes, seed, step).mean():.0f} %"

    limits = [
        f"|u| <= {share:g} M g: "
        + ", ".join(
            f"{name} {rate(text, share * WEIGHT)}" for name, text in car.ASSUMED.filters.items()
        )
        for share in SWEEP
    ]
    gammas = [
        f"SRCBF with gamma = {gamma:g}: {rate(text, car.UNBOUNDED)} unbounded,"
        f" {rate(text, car.ASSUMED.limit)} bounded"
        for gamma, text in ((gamma, f"srcbf:gamma={gamma}") for gamma in GAMMAS)
    ]
    return [*limits, *gammas]


ARTEFACTS = (
    car.CHAPTER.artefact(
        "table-4.1", compute_table, lambda sample: car.setting_values(sample, _step(sample))
    ),
)
