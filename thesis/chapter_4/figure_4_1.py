"""Figure 4.1: what SRCBF and SCBF cost in adaptive cruise control (Sec. 4.3.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from safe_envs import SafetyFilter, SafeVectorEnv
from safe_envs.agents import NominalController
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.scripts.figures.style import COLORS, QUIET, add_legend, labelled
from safe_envs.wrappers import SafetyFilterVectorWrapper, parse_conditions
from thesis.artefact import Claim, Number, Outcome, Sample
from thesis.chapter_4 import cruise
from thesis.chapter_4.cruise import ASSUMED, CAR, FITTED
from thesis.drawing import SHADED, draw_interval

DISTANCES = np.logspace(-3, math.log10(30.0), 181)  # h at which the force is shown, in m
_CLOSE, _FAR = 0.25, 1.0  # h below and above which the effort is compared, in m
_BLOCK = 10  # control instants of which the figure shows the largest effort


@dataclass(frozen=True)
class Effort:
    """Episodes as long as each is safe and running: arrays (steps, episodes), NaN afterwards.

    Attributes:
        effort: J = u^2 in N^2.
        acting: the same where the filter changed the action, NaN elsewhere.
        barrier: h before the action, in m.
    """

    effort: np.ndarray
    acting: np.ndarray
    barrier: np.ndarray


Efforts = Mapping[str, Effort]
"""By condition, SRCBF and SCBF, with the same noise."""
Forces = Mapping[str, np.ndarray]
"""By condition, what it needs at equal speeds at each of `DISTANCES`, in N."""


def compute(sample: Sample) -> tuple[Outcome, Any]:
    """Compute the effort over time, and against the distance to the edge."""
    episodes = sample.size(CAR.episodes)
    efforts, forces = _simulated(ASSUMED, episodes, sample.seed)
    others = {
        cruise.BY_PRINTED_QP: cruise.PRINTED_QP,
        "the goal, tau and gamma that we fitted to Table 4.1, not to this figure": FITTED,
    }
    alternatives = {}
    for name, other in others.items():
        found = _simulated(other, episodes, sample.seed)
        printed = [claim for claim in claims_of(*found) if claim.printed]
        alternatives[name] = Outcome(numbers_of(found[0]), printed)
    outcome = Outcome(
        numbers_of(efforts),
        claims_of(efforts, forces),
        alternatives,
        notes=[
            "SRCBF asks for A h >= (tau sigma_1)^2/h - gamma h^3, so that it is the stricter one"
            f" only below h = sqrt(tau sigma_1)/gamma^(1/4): {stricter_below(ASSUMED):.3g} m, and"
            f" {stricter_below(FITTED):.3g} m with what we fitted to Table 4.1"
        ],
    )
    return outcome, partial(_draw, efforts, forces)


def stricter_below(setting: SimpleNamespace) -> float:
    """Return the h in m below which A B <= gamma/B asks for more than A h >= 0."""
    return math.sqrt(setting.tau * CAR.noise) / setting.gamma**0.25


def _simulated(setting: SimpleNamespace, episodes: int, seed: int) -> tuple[Efforts, Forces]:
    texts = cruise.filters_of(setting).items()
    efforts = {name: _effort(setting, text, episodes, seed) for name, text in texts}
    return efforts, {name: needed_force(setting, text) for name, text in texts}


def _effort(setting: SimpleNamespace, text: str, episodes: int, seed: int) -> Effort:
    """Return what a filter over the goal's controller does."""
    problem = cruise.problem_of(setting, CAR.unbounded)
    env = SafetyFilterVectorWrapper(
        SafeVectorEnv(problem, episodes), parse_conditions(text, problem)
    )
    actor = NominalController(problem)
    effort, acting, barrier = np.full((3, problem.steps, episodes), np.nan)
    observation, info = env.reset(seed=[episode_seed(seed, i) for i in range(episodes)])
    running = np.ones(episodes, dtype=bool)
    for k in range(problem.steps):
        h = info["barrier"].min(axis=1)
        running &= h > 0.0
        observation, _, terminated, truncated, info = env.step(actor.predict(observation)[0])
        square = info["safe_action"][:, 0] ** 2
        np.copyto(effort[k], square, where=running)
        np.copyto(acting[k], square, where=running & info["intervention"])
        np.copyto(barrier[k], h, where=running)
        running &= ~(terminated | truncated)
        if not running.any():
            break
    return Effort(effort, acting, barrier)


def needed_force(setting: SimpleNamespace, text: str) -> np.ndarray:
    """Return the force that a condition needs at equal speeds at each of `DISTANCES`, in N."""
    problem = cruise.problem_of(setting, CAR.unbounded)
    speed = np.full_like(DISTANCES, CAR.near)
    states = np.stack([speed, speed, setting.tau * CAR.near + DISTANCES], axis=1)
    wanted = NominalController(problem).predict(states)[0] * CAR.unbounded
    safety_filter = SafetyFilter.for_problem(problem, parse_conditions(text, problem))
    return safety_filter.filter(states, wanted).action[:, 0]


def numbers_of(efforts: Efforts) -> list[Number]:
    """Return in which part of the time each effort is larger, and the median peak forces."""
    shares = share_of_time(efforts["SRCBF"], efforts["SCBF"])
    return [
        *(
            Number.mean(f"time in which J of SRCBF is the {word} one", 100 * share, "%", 0.0, 100.0)
            for word, share in zip(("larger", "smaller"), shares, strict=True)
        ),
        *(median_peak(name, peaks(each)) for name, each in efforts.items()),
    ]


def claims_of(efforts: Efforts, forces: Forces) -> list[Claim]:
    """Return the claims of the figure."""
    srcbf, scbf = efforts["SRCBF"], efforts["SCBF"]
    return [
        claim_on_time(*share_of_time(srcbf, scbf)),
        claim_on_edge(forces["SRCBF"]),
        claim_on_bounded(forces["SCBF"]),
        claim_on_total(srcbf, scbf),
        claim_on_peaks(peaks(srcbf), peaks(scbf)),
        claim_on_growth(srcbf),
    ]


def share_of_time(first: Effort, second: Effort) -> tuple[np.ndarray, np.ndarray]:
    """Return the parts of the instants at which J of the first is larger, and is smaller.

    Instants count as long as both are safe and running; shape (episodes,) each.
    """
    both = np.isfinite(first.effort) & np.isfinite(second.effort)
    count = np.maximum(both.sum(axis=0), 1)
    larger, smaller = first.effort > second.effort, first.effort < second.effort
    return (both & larger).sum(axis=0) / count, (both & smaller).sum(axis=0) / count


def peaks(found: Effort) -> np.ndarray:
    """Return the largest effort of each episode where the filter acts, or 0, shape (episodes,)."""
    return np.nan_to_num(found.acting).max(axis=0)


def median_peak(name: str, largest: np.ndarray) -> Number:
    """Return the median over episodes of the largest force, with its 95 % order statistics."""
    force, count = np.sqrt(np.sort(largest)), len(largest)
    reach = math.ceil(0.98 * math.sqrt(count))
    low, high = force[[max(count // 2 - reach - 1, 0), min(count // 2 + reach, count - 1)]].tolist()
    name = f"peak force of {name} where it acts, median"
    return Number(name, float(np.median(force)), low, high, unit="N")


def claim_on_time(larger: np.ndarray, smaller: np.ndarray) -> Claim:
    """Return the claim by the share of time in each episode, so that a few peaks do not decide."""
    ahead = Number.mean("", 100 * (larger - smaller), "points", -100.0, 100.0)
    return Claim(
        "SRCBF requires the higher control effort J = u^2 over time",
        ahead.is_above(),
        f"larger in {100 * larger.mean():.1f} % of the time, smaller in"
        f" {100 * smaller.mean():.1f} %, on average over pairs with the same noise; larger most of"
        f" the time in {(larger > smaller).sum()} of {larger.size}",
    )


def claim_on_edge(force: np.ndarray) -> Claim:
    """Return the claim of Sec. 4.2.1 about reciprocal functions, shown by the experiments."""
    sentence = "SRCBF's effort has no bound towards the edge (Sec. 4.2.1)"
    return Claim(sentence, round(_power(force)) < 0, _growth(force))


def claim_on_bounded(force: np.ndarray) -> Claim:
    """Return the claim of a bound, where the thesis calls the SCBF milder."""
    sentence = "SCBF's effort has a bound towards the edge"
    return Claim(sentence, round(_power(force)) == 0, _growth(force), printed=False)


def _power(force: np.ndarray) -> float:
    """Return the power of h with which J goes near the edge."""
    near = DISTANCES < 0.05
    return float(np.polyfit(np.log(DISTANCES[near]), np.log(force[near] ** 2), 1)[0])


def _growth(force: np.ndarray) -> str:
    return (
        f"at equal speeds J goes like h^{round(_power(force), 2) + 0.0:.2f}, and |u| is"
        f" {abs(force[0]):.3g} N at h = {DISTANCES[0]:g} m"
    )


def claim_on_total(srcbf: Effort, scbf: Effort) -> Claim:
    """Return the claim by the other reading of a higher effort, which rare peaks decide."""
    both = np.isfinite(srcbf.effort) & np.isfinite(scbf.effort)
    first, second = (
        np.where(both, each.effort, 0.0).sum(axis=0) * CAR.step for each in (srcbf, scbf)
    )
    return Claim(
        "SRCBF's effort is the higher one as an integral over time",
        (first > second).mean() > 0.5,
        f"{_compared(first, second)} N^2 s",
        printed=False,
    )


def claim_on_peaks(srcbf: np.ndarray, scbf: np.ndarray) -> Claim:
    """Return the claim by our reading of the larger acceleration in the text, from peaks in N^2."""
    return Claim(
        "SRCBF's effort has the higher peak where it acts",
        (srcbf > scbf).mean() > 0.5,
        f"{_compared(srcbf, scbf)} N^2, largest of all {srcbf.max():.2g} against"
        f" {scbf.max():.2g} N^2",
        printed=False,
    )


def _compared(srcbf: np.ndarray, scbf: np.ndarray) -> str:
    return (
        f"in {(srcbf > scbf).sum()} of {srcbf.size} pairs; median {np.median(srcbf):.2g} against"
        f" {np.median(scbf):.2g}"
    )


def claim_on_growth(srcbf: Effort) -> Claim:
    """Return the claim about the edge in closed loop."""
    acted = np.isfinite(srcbf.acting)
    close, away = (
        srcbf.acting[acted & where] for where in (srcbf.barrier < _CLOSE, srcbf.barrier > _FAR)
    )
    each = [
        f"median J {np.median(part):.2g} N^2 {where}" if part.size else f"never {where}"
        for part, where in ((close, f"below h = {_CLOSE} m"), (away, f"above h = {_FAR} m"))
    ]
    return Claim(
        "SRCBF's effort grows as the edge is neared",
        bool(close.size and away.size and np.median(close) > np.median(away)),
        f"where it acts: {', '.join(each)}",
        printed=False,
    )


def _bands(effort: np.ndarray) -> np.ndarray:
    """Return quantiles over running episodes of the largest effort in a block, at least 1 N^2."""
    blocks = effort[: len(effort) // _BLOCK * _BLOCK].reshape(-1, _BLOCK, effort.shape[1])
    largest = np.nan_to_num(blocks, nan=-1.0).max(axis=1)
    largest[largest < 0.0] = np.nan
    largest[~np.isfinite(largest).any(axis=1)] = 1.0
    return np.maximum(np.nanquantile(largest, (0.05, 0.5, 0.95), axis=1), 1.0)


def _draw(efforts: Efforts, forces: Forces, figure: Figure) -> None:
    """Draw the effort over time, and against h with the edge at the left."""
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    for name, color in {"SRCBF": COLORS[3], "SCBF": COLORS[0]}.items():
        label, bands = f"{name}: median, and 5 to 95 %", _bands(efforts[name].effort)
        time = CAR.step * _BLOCK * np.arange(bands.shape[1])
        draw_interval(left, time, bands, color, 0.2, linewidth=1.3, label=label)
        right.plot(DISTANCES, forces[name] ** 2, color=color, linewidth=1.5)
    for axes, label in ((left, r"$|u| = 0.3\,M g$"), (right, None)):
        axes.axhline(ASSUMED.limit**2, color=QUIET, linestyle=":", label=label)
    left.set_ylabel(labelled("effort $J = u^2$", "N^2"))
    left.set(yscale="log", xlim=(0, CAR.horizon), title="(a)", xlabel=labelled("time", "s"))
    right.set(xscale="log", yscale="log", xlim=(DISTANCES[0], DISTANCES[-1]), title="(b)")
    right.set_xlabel(f"{labelled('barrier $h$', 'm')}, edge at the left")
    one_step = ASSUMED.tau * CAR.noise * math.sqrt(CAR.step)
    right.axvspan(DISTANCES[0], one_step, label="within the noise of one step", **SHADED)
    add_legend(figure, [h for axes in (left, right) for h in axes.get_legend_handles_labels()[0]])


ARTEFACTS = {"figure-4.1": compute}
