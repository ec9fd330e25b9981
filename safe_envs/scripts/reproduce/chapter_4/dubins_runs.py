"""Thesis Sec. 4.3.2, a Dubins vehicle with noise in a disk: episodes and their comparison."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem, SafeVectorEnv
from safe_envs.agents import make_problem
from safe_envs.dynamics.lie import generator
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number
from safe_envs.scripts.reproduce.framework.episodes import Violations, episode_seed, violations
from safe_envs.scripts.reproduce.framework.paired import difference
from safe_envs.scripts.reproduce.framework.printed_condition import PrintedCondition
from safe_envs.scripts.reproduce.framework.thesis_data import chapter
from safe_envs.wrappers import AffineConstraint, Condition

CHAPTER = chapter(4)
SETTINGS = CHAPTER.settings["dubins"]
DUBINS = "safe_envs/StochasticDubins-v0"
RADIUS, STEP = SETTINGS["radius"], SETTINGS["step"]
HORIZONS, HORIZON = SETTINGS["horizons"], SETTINGS["horizon"]
ALPHAS = SETTINGS["rates"]
STARTS = {"uniform": "all starts", "inward": "starts with A h > 0"}  # the first: the thesis
BY_PRINTED_FORM = f"SZCBF by the printed h_2, {STARTS['uniform']}"
ByFilter = Mapping[str, Violations]
"""Of the same episodes, by the name of the filter."""


def printed_szcbf(
    alphas: Sequence[float], model: ControlAffineSDE, barrier: Barrier
) -> AffineConstraint:
    """Return the constraint of h_1 = A h + alpha_1 h, h_2 = A h_1 + alpha_2 h >= 0.

    That is the printed formula: with h in place of h_1 in the second term.

    Args:
        alphas: the two rates, in 1/s.
        model: along which A differentiates.
        barrier: with h.
    """
    h = barrier.expression
    first = generator(model, h) + alphas[0] * h
    return AffineConstraint.after(model, (h, first), generator(model, first) + alphas[1] * h)


SCBF_ONLY = {"SCBF": "scbf"}
FILTERS = {**SCBF_ONLY, **{name: f"szcbf:alphas={a},{b}" for name, (a, b) in ALPHAS.items()}}
PRINTED_FORM = {
    name: PrintedCondition(partial(printed_szcbf, alphas)) for name, alphas in ALPHAS.items()
}


def dubins_problem(noise: float, start: Any) -> SafetyProblem:
    """Return the problem of the vehicle up to the longest horizon.

    Args:
        noise: sigma_1 = sigma_2, in m/sqrt(s).
        start: of the episodes.
    """
    box = (-SETTINGS["turn_rate"], SETTINGS["turn_rate"])
    options = {"noise": noise, "start": start, "box": box, "dt": STEP, "horizon": max(HORIZONS)}
    return make_problem(DUBINS, **options, barrier={"radius": RADIUS})


def simulate(
    filters: Mapping[str, str | Condition], noise: float, start: Any, episodes: int, seed: int
) -> dict[str, Violations]:
    """Return the same episodes under each of some filters, with the nominal turn rate 0.

    Args:
        filters: conditions or their texts, by name.
        noise: sigma_1 = sigma_2, in m/sqrt(s).
        start: of the episodes.
        episodes: how many.
        seed: of all of them.
    """
    problem = dubins_problem(noise, start)
    return {
        name: violations(problem, condition, "zero", episodes, seed)
        for name, condition in filters.items()
    }


def random_starts(start: str, noise: float, count: int, seed: int) -> np.ndarray:
    """Return states from a distribution of starts, shape (count, 3).

    Args:
        start: name of the distribution.
        noise: sigma_1 = sigma_2, in m/sqrt(s).
        count: how many.
        seed: of all of them.
    """
    world = SafeVectorEnv(dubins_problem(noise, start), count)
    world.reset(seed=[episode_seed(seed, i) for i in range(count)])
    return world.state


def step_of(horizon: float) -> int:
    """Return the control instant at a horizon in s."""
    return round(horizon / STEP)


def counts(run: Violations) -> np.ndarray:
    """Return how many episodes are safe up to each control instant, shape (steps + 1,)."""
    return np.array([run.safe(k).sum() for k in range(step_of(max(HORIZONS)) + 1)])


def ahead_of(rival: str, runs: ByFilter, horizon: float, where: str = "") -> Number:
    """Return by how many points SCBF is safer than a rival on the same episodes.

    Args:
        rival: name of the other filter.
        runs: of both.
        horizon: up to which, in s.
        where: end of the number's name.
    """
    first, second = ([runs[name].safe(step_of(horizon))] for name in ("SCBF", rival))
    return difference(f"SCBF - {rival}{where}", first, second)


def turning_time(better: Violations, other: Violations) -> float | None:
    """Return from when on more episodes are safe with the first than with the other, in s.

    Args:
        better: the first.
        other: on the same episodes.

    Returns:
        None if that is not so at the end.
    """
    ahead = counts(better) > counts(other)
    if not ahead[-1]:
        return None
    behind = np.flatnonzero(~ahead)
    return STEP * float(behind[-1] + 1 if behind.size else 0)


def scbf_of(runs: ByFilter) -> dict[str, Violations]:
    """Return those of the SCBF alone."""
    return {"SCBF": runs["SCBF"]}


def alternatives_of(
    named: Mapping[str, Any], printed: Any, claim: Callable[[Any, float], Claim]
) -> dict[str, Findings]:
    """Return the claim by the printed SZCBF, for the other horizons, and from the other starts.

    Args:
        named: what the claim is about, by the name of the starts.
        printed: the same with the printed SZCBF.
        claim: by a horizon in s.
    """
    horizons = (HORIZON, *(t for t in HORIZONS if t != HORIZON))
    found = {BY_PRINTED_FORM: printed, **named}
    claims = {
        f"{name}, T = {t:g} s": Findings(claims=[claim(runs, t)])
        for name, runs in found.items()
        for t in horizons
    }
    del claims[f"{STARTS['uniform']}, T = {HORIZON:g} s"]
    return claims


def holds_note(alternatives: Mapping[str, Findings]) -> str:
    """Return in which of the other settings all holds, in words."""
    yes, no = (
        [
            name
            for name, found in alternatives.items()
            if all(c.holds for c in found.claims) == holds
        ]
        for holds in (True, False)
    )
    return (
        f"what is printed holds with: {'; '.join(yes) or 'none of the other settings'}. It does not"
        f" with: {'; '.join(no) or 'none of them'}"
    )


def bands_of(runs: Sequence[Violations], horizon: float = HORIZON) -> list[list[float]]:
    """Return lower end, rate and upper end for each run, in %.

    Args:
        runs: of one filter.
        horizon: up to which, in s.
    """
    rates = [run.rate("", step_of(horizon)) for run in runs]
    return [[float(n.low or 0.0), n.ours, float(n.high or 0.0)] for n in rates]
