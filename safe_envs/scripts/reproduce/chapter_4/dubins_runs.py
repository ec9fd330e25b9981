"""Thesis Sec. 4.3.2, a Dubins vehicle with noise in a disk: what is simulated, and how SCBF and
SZCBF compare."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.rollout import episode_seed
from safe_envs.agents.policies.nominal import ZeroController
from safe_envs.dynamics.lie import generator
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.problem.barrier import Barrier
from safe_envs.problem.problem import SafetyProblem
from safe_envs.registry import make_problem
from safe_envs.scripts.reproduce.chapter_4.paired_episodes import Exits, difference, exits
from safe_envs.scripts.reproduce.framework.artefact import Claim, Number, Outcome
from safe_envs.wrappers import AffineConstraint, Condition

DUBINS = "safe_envs/StochasticDubins-v0"
RADIUS = 3.0
"""Of the disk, in m."""
BOX = (-10.0, 10.0)
"""Of the turn rate, in rad/s."""
STEP = 0.05
"""Control period, in s."""
HORIZONS = (3.0, 5.0, 10.0)
"""In s; one run to the last gives all."""
HORIZON = 5.0
"""Of the numbers, in s."""
STARTS = {"uniform": "all starts", "inward": "starts with A h > 0"}
"""The first of them is the print's."""
AS_PRINTED = f"SZCBF by the printed h_2, {STARTS['uniform']}"
ALPHAS = {"SZCBF(1, 1)": (1.0, 1.0), "SZCBF(.5, .5)": (0.5, 0.5)}
"""Rates of the zeroing form, in 1/s."""
SETTING = (
    (
        f"v = 2 m/s, disk of radius {RADIUS:g} m, control period {STEP} s, min omega^2 subject to"
        f" the row and |omega| <= {BOX[1]:g} rad/s"
    ),
    (
        "SZCBF with the rates in brackets, h_2 = A h_1 + alpha_2 h_1; safe: h > 0 at every control"
        " instant up to T"
    ),
    (
        "starts uniform in the disk and in heading; the same starts and the same noise for all"
        " filters, which are compared pair by pair"
    ),
)
CHOSEN = (
    (
        f"T is not printed: {HORIZON:g} s for the numbers, the others of"
        f" {', '.join(f'{t:g}' for t in HORIZONS)} s as other settings"
    ),
    "the rates of the SZCBF are not printed: a claim about it has to hold for both pairs of rates",
    (
        "Thm. 4.2.10 presumes starts with A h > 0, Sec. 4.3.2 names random ones: those with A h > 0"
        " are another setting"
    ),
    "nominal turn rate 0, and the box of the turn rate",
)
CORRECTIONS = (
    (
        "Sec. 4.3.2: h_2 = A h_1 + alpha_2 h_1, not alpha_2 h; by the print even paths without"
        " noise can leave the set"
    ),
    (
        "Thm. 4.2.10: the product is no valid bound for degree 2, since Eq. (4.23) conditions on"
        " the future; the union bound is"
    ),
)
Runs = Mapping[str, Exits]
"""Of the same episodes, by the name of the filter."""


@dataclass(frozen=True)
class PrintedSZCBF(Condition):
    """h_1 = A h + alpha_1 h, h_2 = A h_1 + alpha_2 h >= 0, as it is printed: with h in place of h_1
    in the second term."""

    alphas: tuple[float, float] = (1.0, 1.0)
    name = "printed-szcbf"
    stochastic = True

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """The row by hand."""
        h = barrier.expression
        first = generator(model, h) + self.alphas[0] * h
        return AffineConstraint.after(
            model, (h, first), generator(model, first) + self.alphas[1] * h
        )

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> PrintedSZCBF:
        """With two rates."""
        return cls((gains[0], gains[1]))


SCBF_ONLY = {"SCBF": "scbf"}
FILTERS = {**SCBF_ONLY, **{name: f"szcbf:alphas={a},{b}" for name, (a, b) in ALPHAS.items()}}
PRINTED_FORM = {name: PrintedSZCBF(alphas) for name, alphas in ALPHAS.items()}


def dubins_problem(noise: float, start: Any) -> SafetyProblem:
    """The vehicle up to the longest horizon."""
    options = {"noise": noise, "start": start, "box": BOX, "dt": STEP, "horizon": max(HORIZONS)}
    return make_problem(DUBINS, **options, barrier={"radius": RADIUS})


def simulate(
    filters: Mapping[str, str | Condition], noise: float, start: Any, episodes: int, seed: int
) -> dict[str, Exits]:
    """The same episodes under each of some filters, without a wish to turn."""
    problem = dubins_problem(noise, start)
    return {
        name: exits(problem, condition, ZeroController(problem), episodes, seed)
        for name, condition in filters.items()
    }


def random_starts(start: str, noise: float, count: int, seed: int) -> np.ndarray:
    """States from a distribution of starts, shape (count, 3)."""
    world = SafeVectorEnv(dubins_problem(noise, start), count)
    world.reset(seed=[episode_seed(seed, i) for i in range(count)])
    return world.state


def step_of(horizon: float) -> int:
    """The control instant at a horizon in s."""
    return round(horizon / STEP)


def counts(run: Exits) -> np.ndarray:
    """How many episodes are safe up to each control instant, shape (steps + 1,)."""
    return np.array([run.safe(k).sum() for k in range(step_of(max(HORIZONS)) + 1)])


def ahead_of(rival: str, runs: Runs, horizon: float, where: str = "") -> Number:
    """By how many points SCBF is safer than a rival up to a horizon in s, on the same episodes."""
    first, second = (runs[name].safe(step_of(horizon)) for name in ("SCBF", rival))
    return difference(f"SCBF - {rival}{where}", first, second)


def turning_time(better: Exits, other: Exits) -> float | None:
    """From when on more episodes are safe with the first than with the other, in s; None if not at
    the end."""
    ahead = counts(better) > counts(other)
    if not ahead[-1]:
        return None
    behind = np.flatnonzero(~ahead)
    return STEP * float(behind[-1] + 1 if behind.size else 0)


def scbf_of(runs: Runs) -> dict[str, Exits]:
    """Those of the SCBF alone."""
    return {"SCBF": runs["SCBF"]}


def elsewhere_of(
    named: Mapping[str, Any], printed: Any, claim: Callable[[Any, float], Claim]
) -> dict[str, Outcome]:
    """The claim by the printed SZCBF, for the other horizons, and from the other starts.

    Args:
        named: what the claim is about, by the name of the starts.
        printed: the same with the printed SZCBF.
        claim: by a horizon in s.
    """
    horizons = (HORIZON, *(t for t in HORIZONS if t != HORIZON))
    found = {AS_PRINTED: printed, **named}
    claims = {
        f"{name}, T = {t:g} s": Outcome(claims=[claim(runs, t)])
        for name, runs in found.items()
        for t in horizons
    }
    del claims[f"{STARTS['uniform']}, T = {HORIZON:g} s"]
    return claims


def holds_note(elsewhere: Mapping[str, Outcome]) -> str:
    """In which of the other settings all holds."""
    yes, no = (
        [name for name, found in elsewhere.items() if all(c.holds for c in found.claims) == holds]
        for holds in (True, False)
    )
    return (
        f"what is printed holds with: {'; '.join(yes) or 'none of the other settings'}. It does not"
        f" with: {'; '.join(no) or 'none of them'}"
    )


def bands_of(runs: Sequence[Exits], horizon: float = HORIZON) -> list[list[float]]:
    """Lower end, rate and upper end for each run, in %."""
    return [_band(run.rate("", step_of(horizon))) for run in runs]


def _band(rate: Number) -> list[float]:
    return [float(rate.low or 0.0), rate.ours, float(rate.high or 0.0)]
