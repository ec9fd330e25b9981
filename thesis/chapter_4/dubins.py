"""Sec. 4.3.2, a Dubins vehicle with noise in a disk: episodes of Figures 4.2 and 4.3."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem
from safe_envs.agents import evaluate, make_problem
from safe_envs.dynamics.lie import generator
from safe_envs.scripts.figures.style import COLORS
from safe_envs.wrappers import AffineConstraint, Condition
from thesis.artefact import Claim, Number, Outcome, settings
from thesis.rates import PrintedCondition, difference

DUBINS = settings(4, "dubins")
HORIZON, ALPHAS = DUBINS.horizon, DUBINS.rates
STARTS = {"uniform": "all starts", "inward": "starts with A h > 0"}  # the first: the thesis
BY_PRINTED_FORM = f"SZCBF by the printed h_2, {STARTS['uniform']}"


def printed_szcbf(
    alphas: Sequence[float], model: ControlAffineSDE, barrier: Barrier
) -> AffineConstraint:
    """Return the constraint of h_1 = A h + alpha_1 h, h_2 = A h_1 + alpha_2 h >= 0.

    That is the printed formula: with h in place of h_1 in the second term.
    """
    h = barrier.expression
    first = generator(model, h) + alphas[0] * h
    return AffineConstraint.after(model, (h, first), generator(model, first) + alphas[1] * h)


FILTERS = {"SCBF": "scbf", **{name: f"szcbf:alpha={a},{b}" for name, (a, b) in ALPHAS.items()}}
PRINTED_FORM = {
    name: PrintedCondition(partial(printed_szcbf, alphas)) for name, alphas in ALPHAS.items()
}
COLOR = dict(zip(FILTERS, COLORS, strict=False))
LABEL = {
    "SCBF": "SCBF",
    **{name: rf"SZCBF, $\alpha$ = {a:g}, {b:g}" for name, (a, b) in ALPHAS.items()},
}


@dataclass(frozen=True)
class Violations:
    """When the episodes of a filter are first unsafe.

    Attributes:
        instant: first control instant with h <= 0 of each episode, past the last one if there is
            none, shape (episodes,).
        infeasible: share of the steps before it in which no action meets the condition.
    """

    instant: np.ndarray
    infeasible: float

    def safe(self, horizon: float) -> np.ndarray:
        """Return which episodes are safe up to a horizon in s, inclusive, shape (episodes,)."""
        return self.instant > round(horizon / DUBINS.step)

    def rate(self, name: str = "", horizon: float = HORIZON) -> Number:
        """Return the share of these episodes in per cent."""
        return Number.rate(name, int(self.safe(horizon).sum()), len(self.instant))


ByFilter = Mapping[str, Violations]
"""Of the same episodes, by the name of the filter."""


def problem_of(noise: float, start: Any) -> SafetyProblem:
    """Return the problem of the vehicle up to the longest horizon, noise in m/sqrt(s)."""
    return make_problem(
        DUBINS.env,
        noise=noise,
        start=start,
        input_bounds=(-DUBINS.turn_rate, DUBINS.turn_rate),
        dt=DUBINS.step,
        horizon=max(DUBINS.horizons),
        barrier={"radius": DUBINS.radius},
    )


def simulate(
    filters: Mapping[str, str | Condition], noise: float, start: Any, episodes: int, seed: int
) -> dict[str, Violations]:
    """Return the same episodes under each of some filters, with the nominal turn rate 0."""
    problem = problem_of(noise, start)
    how: dict[str, Any] = {"episodes": episodes, "seed": seed, "bounds": False}
    found = {}
    for name, condition in filters.items():
        evaluation = evaluate(problem, "zero", [condition], keep_episodes=True, **how)
        (results,) = next(iter(evaluation.episodes.values()))
        instant = np.where(results.safe, problem.steps + 1, results.first_violation)
        infeasible = results.infeasible.sum() / max(results.counted.sum(), 1)
        found[name] = Violations(instant, infeasible)
    return found


def ahead_of(rival: str, runs: ByFilter, horizon: float, where: str = "") -> Number:
    """Return by how many points SCBF is safer than a rival on the same episodes."""
    first, second = ([runs[name].safe(horizon)] for name in ("SCBF", rival))
    return difference(f"SCBF - {rival}{where}", first, second)


def alternatives_of(
    named: Mapping[str, Any], printed: Any, claim: Callable[[Any, float], Claim]
) -> dict[str, Outcome]:
    """Return the claim by the printed SZCBF, for the other horizons, and from the other starts.

    `named` holds what the claim is about by the name of the starts, `printed` that with the printed
    SZCBF.
    """
    horizons = (HORIZON, *(t for t in DUBINS.horizons if t != HORIZON))
    found = {BY_PRINTED_FORM: printed, **named}
    claims = {
        f"{name}, T = {t:g} s": Outcome(claims=[claim(runs, t)])
        for name, runs in found.items()
        for t in horizons
    }
    del claims[f"{STARTS['uniform']}, T = {HORIZON:g} s"]
    return claims


def bands_of(runs: Sequence[Violations], horizon: float = HORIZON) -> np.ndarray:
    """Return lower ends, rates and upper ends of runs of one filter in %, shape (3, runs)."""
    rates = [run.rate("", horizon) for run in runs]
    return np.array([[n.low, n.ours, n.high] for n in rates], dtype=float).T
