"""Thesis Sec. 4.3.1: what SRCBF and SCBF cost in adaptive cruise control (Figure 4.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from safe_envs.agents.evaluation.rollout import episode_seed
from safe_envs.agents.policies.nominal import NominalController
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.scripts.figures.evaluation_figure import COLORS, QUIET, UNSAFE, add_legend
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
    STEP,
    TAKEN,
    UNBOUNDED,
    CruiseSettings,
    describe,
)
from safe_envs.scripts.reproduce.chapter_4.paired_episodes import is_above
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Claim, Number, Outcome, Sample
from safe_envs.wrappers import SafetyFilter, SafetyFilterVectorWrapper, parse_conditions

NEAR = 20.0
"""Speed of both cars at which the force is shown against h, in m/s."""
DISTANCES = np.logspace(-3, math.log10(30.0), 181)
"""h at which it is shown, in m."""
CLOSE, FAR = 0.25, 1.0
"""h below and above which the effort is compared, in m."""
BLOCK = 10
"""Control instants of which the figure shows the largest effort."""


@dataclass(frozen=True)
class Run:
    """Episodes as long as each is safe and under way: arrays (steps, episodes), NaN afterwards.

    Attributes:
        effort: J = u^2 in N^2.
        acting: the same where the filter changed the action, NaN elsewhere.
        barrier: h before the action, in m.
    """

    effort: np.ndarray
    acting: np.ndarray
    barrier: np.ndarray

    @property
    def peaks(self) -> np.ndarray:
        """Largest effort of each episode where the filter acts, 0 where it never does, shape
        (episodes,)."""
        return np.nan_to_num(self.acting).max(axis=0)


Runs = Mapping[str, Run]
"""Of SRCBF and SCBF, with the same noise."""


def run(setting: CruiseSettings, text: str, episodes: int, seed: int) -> Run:
    """Simulate a filter over the goal's controller, and keep what it does."""
    problem = setting.problem(UNBOUNDED)
    env = SafetyFilterVectorWrapper(
        SafeVectorEnv(problem, episodes), parse_conditions(text, problem)
    )
    policy = NominalController(problem)
    observation, info = env.reset(seed=[episode_seed(seed, i) for i in range(episodes)])
    effort, acting, barrier = (np.full((problem.steps, episodes), np.nan) for _ in range(3))
    counts = np.ones(episodes, dtype=bool)
    for k in range(problem.steps):
        h = info["barrier"][:, 0]
        counts &= h > 0.0
        observation, _, terminated, _, info = env.step(policy.predict(observation)[0])
        square = info["safe_action"][:, 0] ** 2
        for kept, values, where in (
            (effort, square, counts),
            (acting, square, counts & info["intervention"]),
            (barrier, h, counts),
        ):
            np.copyto(kept[k], values, where=where)
        counts &= ~terminated
    return Run(effort, acting, barrier)


def needed(setting: CruiseSettings, text: str) -> np.ndarray:
    """Force at equal speeds, at each of `DISTANCES`, in N."""
    problem = setting.problem(UNBOUNDED)
    states = np.stack(
        [
            np.full_like(DISTANCES, NEAR),
            np.full_like(DISTANCES, NEAR),
            setting.tau * NEAR + DISTANCES,
        ],
        axis=1,
    )
    wanted = NominalController(problem).predict(states)[0] * UNBOUNDED
    return (
        SafetyFilter.for_problem(problem, parse_conditions(text, problem))
        .filter(states, wanted)
        .action[:, 0]
    )


def compute_figure(sample: Sample) -> Outcome:
    """Figure 4.1: effort over time, and against the distance to the edge."""
    episodes = sample.size(EPISODES)
    runs, forces = simulated(TAKEN, episodes, sample.seed)
    others = {
        AS_PRINTED: PRINTED_PROGRAM,
        "the goal, tau and gamma that we fitted to Table 4.1, not to this figure": FITTED,
    }
    return replace(
        outcome_of(runs, forces),
        alternative_settings={
            name: _by_the_print(outcome_of(*simulated(setting, episodes, sample.seed)))
            for name, setting in others.items()
        },
        data={
            "time": (np.arange(len(runs["SCBF"].effort) // BLOCK) * BLOCK * STEP).tolist(),
            "h": DISTANCES.tolist(),
            "effort": {name: _bands(r.effort) for name, r in runs.items()},
            "forces": {name: values.tolist() for name, values in forces.items()},
        },
        notes=[_strict_note(), _ends_note(runs)],
    )


def _by_the_print(outcome: Outcome) -> Outcome:
    return replace(outcome, claims=[claim for claim in outcome.claims if claim.printed])


def simulated(
    setting: CruiseSettings, episodes: int, seed: int
) -> tuple[Runs, Mapping[str, np.ndarray]]:
    """Runs of both conditions, and the forces that they need at the edge."""
    runs = {name: run(setting, text, episodes, seed) for name, text in setting.filters.items()}
    return runs, {name: needed(setting, text) for name, text in setting.filters.items()}


def outcome_of(runs: Runs, forces: Mapping[str, np.ndarray]) -> Outcome:
    """Numbers and claims of the figure."""
    larger, smaller = (
        share_of_time(runs[a], runs[b]) for a, b in (("SRCBF", "SCBF"), ("SCBF", "SRCBF"))
    )
    shares = [
        Number.mean(f"time in which J of SRCBF is the {word} one", 100 * share, "%", 0.0, 100.0)
        for word, share in (("larger", larger), ("smaller", smaller))
    ]
    return Outcome(
        [*shares, *(median_peak(name, r.peaks) for name, r in runs.items())],
        [
            claim_on_time(larger, smaller),
            claim_on_edge(forces["SRCBF"]),
            claim_on_bounded(forces["SCBF"]),
            claim_on_total(runs),
            claim_on_peaks(runs["SRCBF"].peaks, runs["SCBF"].peaks),
            claim_on_growth(runs["SRCBF"]),
        ],
    )


def share_of_time(first: Run, second: Run) -> np.ndarray:
    """Share of the instants, in each episode, in which the first effort is the larger one, as long
    as both runs are safe and under way."""
    both = np.isfinite(first.effort) & np.isfinite(second.effort)
    return (both & (first.effort > second.effort)).sum(axis=0) / np.maximum(both.sum(axis=0), 1)


def median_peak(name: str, peaks: np.ndarray) -> Number:
    """Median over episodes of the largest force, between the order statistics that hold it with 95
    %."""
    force, count = np.sqrt(np.sort(peaks)), len(peaks)
    reach = math.ceil(0.98 * math.sqrt(count))
    low, middle, high = (
        force[max(count // 2 - reach - 1, 0)],
        np.median(force),
        force[min(count // 2 + reach, count - 1)],
    )
    return Number(
        f"peak force of {name} where it acts, median",
        float(middle),
        float(low),
        float(high),
        unit="N",
    )


def claim_on_time(larger: np.ndarray, smaller: np.ndarray) -> Claim:
    """By the share of time in each episode, so that a few peaks do not decide."""
    ahead = Number.mean("", 100 * (larger - smaller), "points", -100.0, 100.0)
    return Claim(
        "SRCBF requires the higher control effort J = u^2 over time",
        is_above(ahead),
        "on average over the pairs with the same noise its J is the larger one in"
        f" {100 * larger.mean():.1f} % of the time and the smaller one in"
        f" {100 * smaller.mean():.1f} %; it is the larger one most of the time in"
        f" {(larger > smaller).sum()} of {larger.size} pairs",
    )


def claim_on_edge(force: np.ndarray) -> Claim:
    """Sec. 4.2.1 says it of reciprocal functions, and that the experiments show it."""
    power = _power(force)
    return Claim(
        "SRCBF's effort has no bound towards the edge (Sec. 4.2.1)",
        round(power) < 0,
        _growth(power, force),
    )


def claim_on_bounded(force: np.ndarray) -> Claim:
    """The thesis calls the SCBF milder, and names no bound."""
    power = _power(force)
    return Claim(
        "SCBF's effort has a bound towards the edge",
        round(power) == 0,
        _growth(power, force),
        printed=False,
    )


def _power(force: np.ndarray) -> float:
    """Of h, by which J goes near the edge."""
    near = DISTANCES < 0.05
    return float(np.polyfit(np.log(DISTANCES[near]), np.log(force[near] ** 2), 1)[0])


def _growth(power: float, force: np.ndarray) -> str:
    return (
        f"at equal speeds J goes like h^{round(power, 2) + 0.0:.2f}, and |u| is {abs(force[0]):.3g}"
        f" N at h = {DISTANCES[0]:g} m"
    )


def claim_on_total(runs: Runs) -> Claim:
    """The other reading of a higher effort, which rare peaks decide."""
    both = np.isfinite(runs["SRCBF"].effort) & np.isfinite(runs["SCBF"].effort)
    srcbf, scbf = (
        np.where(both, runs[name].effort, 0.0).sum(axis=0) * STEP for name in ("SRCBF", "SCBF")
    )
    larger = srcbf > scbf
    return Claim(
        "SRCBF's effort is the higher one as an integral over time",
        bool(larger.mean() > 0.5),
        f"in {larger.sum()} of {larger.size} pairs; median {np.median(srcbf):.2g} against"
        f" {np.median(scbf):.2g} N^2 s",
        printed=False,
    )


def claim_on_peaks(srcbf: np.ndarray, scbf: np.ndarray) -> Claim:
    """Our reading of the larger acceleration that the text tells of."""
    larger = srcbf > scbf
    return Claim(
        "SRCBF's effort has the higher peak where it acts",
        bool(larger.mean() > 0.5),
        f"in {larger.sum()} of {larger.size} pairs; median {np.median(srcbf):.2g} against"
        f" {np.median(scbf):.2g} N^2, largest of all {srcbf.max():.2g} against"
        f" {scbf.max():.2g} N^2",
        printed=False,
    )


def claim_on_growth(srcbf: Run) -> Claim:
    """The same as at the edge, in closed loop."""
    acted = np.isfinite(srcbf.acting)
    close, away = (
        srcbf.acting[acted & where] for where in (srcbf.barrier < CLOSE, srcbf.barrier > FAR)
    )
    grows = bool(close.size and away.size and np.median(close) > np.median(away))
    each = [
        f"median J {np.median(part):.2g} N^2 {where}" if part.size else f"never {where}"
        for part, where in ((close, f"below h = {CLOSE} m"), (away, f"above h = {FAR} m"))
    ]
    return Claim(
        "SRCBF's effort grows as the edge is neared",
        grows,
        "where it acts: " + ", ".join(each),
        printed=False,
    )


def _strict_note() -> str:
    return (
        "SRCBF asks for A h >= (tau sigma_1)^2/h - gamma h^3, so that it is the stricter one only"
        f" below h = sqrt(tau sigma_1)/gamma^(1/4): {TAKEN.stricter_below():.3g} m, and"
        f" {FITTED.stricter_below():.3g} m with what we fitted to Table 4.1, {FITTED_GOAL}"
    )


def _ends_note(runs: Runs) -> str:
    kept = ", ".join(
        f"{name} {np.isfinite(r.effort[-1]).sum()} of {r.effort.shape[1]}"
        for name, r in runs.items()
    )
    first, other = (float(np.median(runs[name].effort[0])) for name in ("SRCBF", "SCBF"))
    return (
        f"episodes that are safe and under way at the end: {kept}; effort counts up to an episode's"
        f" first violation, of either in a pair. At the start J of SRCBF is {first:.2g} N^2, that"
        f" of SCBF {other:.2g}"
    )


def _bands(effort: np.ndarray) -> list[list[float]]:
    """Quantiles over the episodes under way of the largest effort in each block, at least 1 N^2."""
    blocks = effort[: len(effort) // BLOCK * BLOCK].reshape(-1, BLOCK, effort.shape[1])
    largest = np.nan_to_num(blocks, nan=-1.0).max(axis=1)
    largest[largest < 0.0] = np.nan
    largest[~np.isfinite(largest).any(axis=1)] = 1.0
    return np.maximum(np.nanquantile(largest, (0.05, 0.5, 0.95), axis=1), 1.0).tolist()


def draw_figure(figure: Figure, outcome: Outcome) -> None:
    """Left: effort over time. Right: effort against h, with the edge at the left."""
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    data = outcome.data
    for name, color in {"SRCBF": COLORS[3], "SCBF": COLORS[0]}.items():
        low, middle, high = np.array(data["effort"][name])
        left.fill_between(data["time"], low, high, color=color, alpha=0.2, linewidth=0)
        left.plot(
            data["time"], middle, color=color, linewidth=1.3, label=f"{name}: median, and 5 to 95 %"
        )
        right.plot(data["h"], np.square(data["forces"][name]), color=color, linewidth=2)
    for axes in (left, right):
        axes.axhline(
            TAKEN.limit**2,
            color=QUIET,
            linestyle=":",
            label="|u| = .3 M g" if axes is left else None,
        )
    left.set(
        yscale="log",
        xlabel="time (s)",
        ylabel=r"effort J = u$^2$ (N$^2$)",
        xlim=(0, HORIZON),
        title="(a)",
    )
    right.set(
        xscale="log",
        yscale="log",
        xlabel="barrier h (m), edge at the left",
        xlim=(DISTANCES[0], DISTANCES[-1]),
        title="(b)",
    )
    _mark_step(right)
    add_legend(figure, left.get_legend_handles_labels()[0])


def _mark_step(axes: Axes) -> None:
    """Shade the distances that the noise of one control period crosses."""
    axes.axvspan(
        DISTANCES[0],
        TAKEN.tau * NOISE * math.sqrt(STEP),
        color=UNSAFE,
        alpha=0.35,
        linewidth=0,
        zorder=0,
    )
    axes.text(
        0.03,
        0.2,
        "within the noise\nof one step",
        transform=axes.transAxes,
        color=QUIET,
        fontsize=8,
    )


FIGURE = Artefact(
    name="figure-4.1",
    title="Effort of SRCBF and SCBF in adaptive cruise control",
    compute=compute_figure,
    setting=lambda sample: describe(sample.size(EPISODES), STEP),
    assumptions=(
        *CHOSEN,
        "the force has no bound: of which control its curves are, the print does not say",
    ),
    errata=CORRECTIONS,
    draw=draw_figure,
    size=(7.0, 3.8),
)
