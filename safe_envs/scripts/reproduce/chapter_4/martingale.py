"""Thesis Sec. 4.2.2 and Prop. 4.2.8: what a reciprocal condition asks for under noise, and a bound
that is attained."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import ndtr

from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.evaluation.rollout import episode_seed
from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.barrier import Barrier
from safe_envs.problem.initial_distribution import Start
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.registry import make_problem
from safe_envs.scripts.figures.evaluation_figure import COLORS, add_legend
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Claim, Number, Outcome, Sample
from safe_envs.wrappers import SafetyFilter, parse_conditions
from safe_envs.wrappers.verification.bounds import proposition_4_2_8

SCALAR = "safe_envs/Scalar-v0"
GAMMA = 1.0
NOISE = 0.5
"""sigma of the scalar system, in 1/sqrt(s)."""
LIMITS = (1.5, 2.0, 5.0, 20.0)
"""Bounds on |u|, in 1/s."""
UNBOUNDED = 1e12
"""A box so wide that it never counts, in 1/s."""
STARTS = (0.25, 0.5, 0.75)
"""x_0 of the system on which h/c is attained."""
SCALE = 1.0
"""s of that system, in 1/sqrt(s)."""
STEP = 0.005
HORIZON = 5.0
"""Control period and length of an episode, in s."""
EPISODES = 2000
ROUNDING = 1e-6
"""Relative difference up to which two inputs are the same."""
SHIFT = 0.5826
"""By so many standard deviations of a step a boundary that is watched at the steps only seems to be
further away."""
DISTANCES = np.logspace(0, -6, 61)
"""h at which the conditions are asked for the largest input that they allow."""
CHOSEN = (
    f"no number is printed; sigma = {NOISE}, bounds of the input, steps and starts are ours",
    "the system on which h/c is attained is ours",
)


def setting(sample: Sample) -> tuple[str, ...]:
    """What is computed and simulated."""
    return (
        (
            "largest input that each condition allows, from the filter itself: dx = (x + u) dt +"
            f" sigma dW, h = 1 - x, gamma = {GAMMA:g}"
        ),
        (
            f"the same system with sigma = {NOISE} from x = 0, bounds on the input, control period"
            f" {STEP} s, {HORIZON:g} s, nominal u = 1 - 2 x"
        ),
        (
            f"P >= h/c: dx = u dt + s x dW, s = {SCALE:g}, h = 1 - x^2, c = 1, nominal u = 0, start"
            f" x_0, {HORIZON:g} s; there the SCBF's action is u = -s^2 x/2, so that A h = 0"
        ),
        f"episodes of each rate under noise: {sample.size(EPISODES)}",
    )


def largest_inputs(text: str, noise: float) -> np.ndarray:
    """The largest u that a condition allows at each of `DISTANCES`: a filter's answer to a far
    larger one."""
    problem = make_problem(SCALAR, noise=noise, box=[-UNBOUNDED, UNBOUNDED])
    answer = SafetyFilter.for_problem(problem, parse_conditions(text, problem))
    state = (1.0 - DISTANCES)[:, None]
    return answer.filter(state, np.full_like(state, UNBOUNDED)).action[:, 0]


def attaining_problem(start: float) -> SafetyProblem:
    """The system dx = u dt + s x dW with h = 1 - x^2, from a start: without a wish of its own, h is
    a martingale under the SCBF."""
    x, u, s = sp.symbols("x u s", real=True)
    system = ControlAffineSDE(
        states=(x,),
        inputs=(u,),
        drift=[0],
        input_matrix=[1],
        diffusion=[s * x],
        parameters={s: SCALE},
    )
    return SafetyProblem(
        name="Martingale",
        plant=system,
        model=system,
        barriers=(Barrier(1 - x**2),),
        states=(Variable(x, -math.inf, math.inf),),
        inputs=(Variable(u, -50.0, 50.0, "1/s"),),
        reward=sp.Integer(0),
        nominal=(sp.Integer(0),),
        starts={"given": Start.at((start,))},
        dt=STEP,
        horizon=HORIZON,
        filter="scbf",
    )


def safe_up_to(start: float, horizon: float, step: float = 0.0) -> float:
    """P(|x| < 1 up to the horizon) for dx = -s^2 x/2 dt + s x dW: log |x| is a Brownian motion with
    drift -s^2.

    Args:
        start: x_0.
        horizon: in s; infinite for ever, where it is 1 - x_0^2.
        step: between the instants at which x is looked at, in s; 0 for all.
    """
    a = -math.log(start) + SHIFT * SCALE * math.sqrt(step)
    ever = math.exp(-2.0 * a)
    if math.isinf(horizon):
        return 1.0 - ever
    drift, deviation = SCALE**2 * horizon, SCALE * math.sqrt(horizon)
    return 1.0 - float(ndtr((-a - drift) / deviation) + ever * ndtr((-a + drift) / deviation))


def compute(sample: Sample) -> Outcome:
    """Both parts: what the conditions ask for, and how safe they are."""
    episodes = sample.size(EPISODES)
    asked = {
        "RCBF": largest_inputs(f"rcbf:gamma={GAMMA}", 0.0),
        "SRCBF": largest_inputs(f"srcbf:gamma={GAMMA}", NOISE),
    }
    limited = [
        _limited(limit, episodes, sample.seed)
        for limit in (*LIMITS[: 1 if sample.quick else None], UNBOUNDED)
    ]
    calm = evaluate(
        SCALAR,
        filters=["rcbf"],
        options={"noise": 0.0, "box": [-LIMITS[0], LIMITS[0]]},
        episodes=1,
        bounds=False,
    ).rows[0]
    attained = [
        _attained(start, episodes, episode_seed(sample.seed, i)) for i, start in enumerate(STARTS)
    ]
    numbers = [
        *(
            Number.rate(f"SCBF where h/c is attained, x_0 = {s:g}", r["safe"], episodes)
            for s, r in zip(STARTS, attained, strict=True)
        ),
        *(number for pair in limited for number in pair),
        Number(f"RCBF without noise, |u| <= {LIMITS[0]:g}", 100 * calm["safety_rate"], unit="%"),
    ]
    rates = numbers[: len(STARTS)]
    bounds = [float(proposition_4_2_8(1.0 - s**2, 1.0)) for s in STARTS]
    closed = [
        [safe_up_to(s, t, step) for s in STARTS] for t, step in ((math.inf, 0.0), (HORIZON, STEP))
    ]
    return Outcome(
        numbers=numbers,
        claims=[
            *claims_on_inputs(asked),
            claim_on_limits(limited[0][0], limited[-1][0]),
            claim_on_bound(rates, bounds),
            claim_on_attaining([_together(r) for r in attained], closed[1]),
        ],
        data={
            "h": DISTANCES.tolist(),
            "asked": {name: values.tolist() for name, values in asked.items()},
            "curves": [
                {key: r["curve"][key] for key in ("time", "rate", "ci_low", "ci_high")}
                | {"bound": b, "start": s}
                for s, r, b in zip(STARTS, attained, bounds, strict=True)
            ],
            "closed": [
                [safe_up_to(s, t, STEP) for t in attained[0]["curve"]["time"][1:]] for s in STARTS
            ],
        },
        notes=[
            f"x_0 = {s:g}: h/c = {100 * b:.2f} %, closed form for ever {100 * e:.2f} %, for"
            f" {HORIZON:g} s looked at every {STEP:g} s {100 * f:.2f} %, simulated"
            f" {100 * r['safety_rate']:.2f} %"
            for s, b, e, f, r in zip(STARTS, bounds, *closed, attained, strict=True)
        ]
        + [_held_note(limited[-1][0])],
    )


def _attained(start: float, episodes: int, seed: int) -> dict[str, Any]:
    return evaluate(
        attaining_problem(start), filters=["scbf"], episodes=episodes, seed=seed, bounds=False
    ).rows[0]


def _together(row: Mapping[str, Any]) -> Number:
    """A rate with an interval that holds it at all of `STARTS` with 95 %."""
    low, high = rate_interval(row["safe"], row["episodes"], 1.0 - 0.05 / len(STARTS))
    return Number("", 100 * row["safe"] / row["episodes"], 100 * low, 100 * high, unit="%")


def _limited(limit: float, episodes: int, seed: int) -> list[Number]:
    """Safety of both conditions in the scalar system with a bound on the input."""
    options = {
        "noise": NOISE,
        "start": [0.0],
        "box": [-limit, limit],
        "dt": STEP,
        "horizon": HORIZON,
    }
    rows = evaluate(
        SCALAR,
        filters=["srcbf", "scbf"],
        options=options,
        episodes=episodes,
        seed=seed,
        bounds=False,
    ).rows
    where = "unbounded" if limit == UNBOUNDED else f"|u| <= {limit:g}"
    return [
        Number.rate(f"{name}, {where}", row["safe"], episodes)
        for name, row in zip(("SRCBF", "SCBF"), rows, strict=True)
    ]


def claims_on_inputs(asked: Mapping[str, np.ndarray]) -> list[Claim]:
    """The printed inequalities, and what becomes of them at the edge.

    Args:
        asked: the largest input that each condition allows at each of `DISTANCES`.
    """
    h, x = DISTANCES, 1.0 - DISTANCES
    printed = {"RCBF": h**3 - x, "SRCBF": h**3 - x - NOISE**2 / h}
    away = {
        name: float(
            np.max(np.abs(asked[name] - printed[name]) / np.maximum(np.abs(printed[name]), 1.0))
        )
        for name in asked
    }
    return [
        Claim(
            "both inequalities on u are right",
            max(away.values()) < ROUNDING,
            f"largest relative difference {max(away.values()):.1e}",
        ),
        _claim_on_edge(
            "without noise the RCBF asks for bounded control at the edge",
            asked["RCBF"],
            bounded=True,
        ),
        _claim_on_edge(
            "under noise the SRCBF asks for unbounded control at the edge",
            asked["SRCBF"],
            bounded=False,
        ),
    ]


def _claim_on_edge(sentence: str, asked: np.ndarray, bounded: bool) -> Claim:
    """By the power of h, to the nearest whole one, that the effort asked for goes with: 0 for a
    bound, less for none."""
    power = float(np.polyfit(np.log(DISTANCES[-20:]), np.log(np.abs(asked[-20:])), 1)[0])
    evidence = (
        f"it allows u = {asked[-1]:.6g} at h = {DISTANCES[-1]:g}; |u| goes like"
        f" h^{round(power, 3) + 0.0:.3f} there"
    )
    return Claim(sentence, (round(power) >= 0) == bounded, evidence)


def _held_note(unbounded: Number) -> str:
    return (
        f"Prop. 4.2.2 promises 100 % with unbounded SRCBF; with an input that is held for {STEP:g}"
        f" s it is {unbounded.ours:.1f} %"
    )


def claim_on_limits(bounded: Number, unbounded: Number) -> Claim:
    """Rates of the SRCBF: the print promises certainty without a bound, and simulates neither."""
    return Claim(
        "with bounded control the SRCBF is less safe",
        _upper(bounded) < _lower(unbounded),
        f"{bounded.ours:.1f} % with {bounded.name.split(', ')[1]}, {unbounded.ours:.1f} % without a"
        " bound",
        printed=False,
    )


def claim_on_bound(attained: Sequence[Number], bounds: Sequence[float]) -> Claim:
    """Whether a rate is below the bound by more than chance; it is of a finite time, so that it may
    be above."""
    below = sum(100 * b > _upper(n) for n, b in zip(attained, bounds, strict=True))
    each = "; ".join(
        f"{_with_interval(n)} against {100 * b:.1f} %"
        for n, b in zip(attained, bounds, strict=True)
    )
    return Claim(
        "Prop. 4.2.8: P(safe for ever) >= h/c",
        below == 0,
        f"up to {HORIZON:g} s: {each}; below it by more than chance at {below} of {len(bounds)}"
        " starts",
    )


def claim_on_attaining(attained: Sequence[Number], closed: Sequence[float]) -> Claim:
    """For ever the closed form is 1 - x_0^2 = h/c; what can be simulated is another value of the
    same form.

    Args:
        attained: rates with 95 % intervals for all of them together.
        closed: the form for the horizon and the instants that are simulated.
    """
    inside = sum(_lower(n) <= 100 * p <= _upper(n) for n, p in zip(attained, closed, strict=True))
    each = "; ".join(
        f"{_with_interval(n)} against {100 * p:.1f} %"
        for n, p in zip(attained, closed, strict=True)
    )
    return Claim(
        "h/c is the worst case: on this system it is attained",
        inside == len(closed),
        f"1 - x_0^2 = h/c is its probability for ever. The same form for {HORIZON:g} s, looked at"
        f" every {STEP:g} s, is inside the interval of the simulation at {inside} of {len(closed)}"
        f" starts, by intervals that hold all of them with 95 %: {each}",
        printed=False,
    )


def _lower(rate: Number) -> float:
    return 0.0 if rate.low is None else rate.low


def _upper(rate: Number) -> float:
    return 100.0 if rate.high is None else rate.high


def _with_interval(rate: Number) -> str:
    return f"{rate.ours:.1f} % [{_lower(rate):.1f}, {_upper(rate):.1f}]"


def draw(figure: Figure, outcome: Outcome) -> None:
    """Left: what the conditions allow towards the edge. Right: safety over time with its 95 % band,
    and the bound that is attained."""
    left, right = figure.subplots(1, 2)
    _draw_inputs(left, outcome.data)
    _draw_bound(right, outcome.data)
    add_legend(
        figure, [*left.get_legend_handles_labels()[0], *right.get_legend_handles_labels()[0]]
    )


def _draw_inputs(axes: Axes, data: dict[str, Any]) -> None:
    h = np.array(data["h"])
    for (name, values), color, what in zip(
        data["asked"].items(), COLORS[:2], ("no noise", rf"$\sigma$ = {NOISE:g}"), strict=True
    ):
        axes.plot(
            h[h < 0.5],
            -np.array(values)[h < 0.5],
            color=color,
            linewidth=2,
            label=f"{name}, {what}",
        )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="h = 1 - x, edge at the left",
        ylabel="least effort -u asked for (1/s)",
        title="(a)",
    )


def _draw_bound(axes: Axes, data: dict[str, Any]) -> None:
    for curve, closed, color in zip(data["curves"], data["closed"], COLORS[2:], strict=False):
        low, rate, high = (100 * np.array(curve[key]) for key in ("ci_low", "rate", "ci_high"))
        time = curve["time"]
        axes.fill_between(time, low, high, color=color, alpha=0.25, linewidth=0)
        axes.plot(time, rate, color=color, label=f"SCBF, $x_0$ = {curve['start']:g}")
        axes.plot(time[1:], 100 * np.array(closed), color="black", linewidth=1, linestyle=":")
        axes.axhline(100 * curve["bound"], color=color, linestyle="--", linewidth=1)
    axes.plot([], [], color="black", linewidth=1, linestyle=":", label="closed form")
    axes.plot([], [], color="black", linewidth=1, linestyle="--", label="h/c of the same colour")
    axes.set(
        xlabel="time (s)", ylabel="safe so far (%)", ylim=(35, 101), xlim=(0, HORIZON), title="(b)"
    )


ARTEFACTS: tuple[Artefact, ...] = (
    Artefact(
        name="example-4.2.2",
        title="What RCBF and SRCBF ask for at the edge, and P >= h/c where it is attained",
        compute=compute,
        setting=setting,
        chosen=CHOSEN,
        corrections=(
            (
                "Prop. 4.2.8 needs c = sup h to be finite: on the half-line of the example h is"
                " unbounded, and h/c promises nothing"
            ),
        ),
        draw=draw,
        size=(7.0, 4.0),
    ),
)
