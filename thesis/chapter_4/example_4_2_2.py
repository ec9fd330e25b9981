"""Sec. 4.2.2, Prop. 4.2.8: reciprocal conditions under noise, and a bound that is attained."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import sympy as sp
from matplotlib.figure import Figure
from scipy.special import ndtr

from safe_envs import ControlAffineSDE, SafetyFilter, SafetyProblem, define_problem
from safe_envs.agents import make_problem, rate_interval
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.proofs.guarantees import stage_bound
from safe_envs.scripts.figures.style import COLORS, add_legend, labelled
from safe_envs.wrappers import parse_conditions
from thesis.artefact import Claim, Number, Outcome, Sample, settings
from thesis.drawing import draw_interval
from thesis.rates import MeasuredFilter, measure

SCALAR = settings(4, "scalar")
STARTS = SCALAR.starts
DISTANCES = np.logspace(0, -6, 61)  # h at which the conditions are asked for the largest input
SHIFT = 0.5826
"""By so many standard deviations of a step a boundary watched at the steps seems further away."""

_ROUNDING = 1e-6  # relative difference up to which two inputs are the same


def compute(sample: Sample) -> tuple[Outcome, Any]:
    """Compute what the conditions ask for, and how safe they are."""
    episodes = sample.size(SCALAR.episodes)
    allowed = {
        "RCBF": largest_inputs(f"rcbf:gamma={SCALAR.gamma}", 0.0),
        "SRCBF": largest_inputs(f"srcbf:gamma={SCALAR.gamma}", SCALAR.noise),
    }
    limits = (*SCALAR.limits[: 1 if sample.quick else None], SCALAR.unbounded)
    limited = [number for limit in limits for number in _limited(limit, episodes, sample.seed)]
    least = SCALAR.limits[0]
    calm = measure(
        SCALAR.env, "rcbf", 1, 0, options={"noise": 0.0, "input_bounds": [-least, least]}
    )
    attained = [
        measure(attaining_problem(start), "scbf", episodes, episode_seed(sample.seed, i))
        for i, start in enumerate(STARTS)
    ]
    rates = [
        each.number(f"SCBF where h/c is attained, x_0 = {start:g}")
        for start, each in zip(STARTS, attained, strict=True)
    ]
    bounds = [float(stage_bound(1.0 - start**2, 1.0)) for start in STARTS]
    closed = [safe_up_to(start, SCALAR.horizon, SCALAR.step) for start in STARTS]
    outcome = Outcome(
        numbers=[
            *rates,
            *limited,
            Number(f"RCBF without noise, |u| <= {least:g}", calm.rate, unit="%"),
        ],
        claims=[
            *claims_on_inputs(allowed),
            claim_on_limits(limited[0], limited[-2]),
            claim_on_bound(rates, bounds),
            claim_on_attaining([_for_all_starts(each) for each in attained], closed),
        ],
        notes=[
            "Prop. 4.2.2 guarantees 100 % with unbounded SRCBF; with an input that is held for"
            f" {SCALAR.step:g} s it is {limited[-2].ours:.1f} %"
        ],
    )
    return outcome, partial(_draw, allowed, attained, bounds)


def largest_inputs(text: str, noise: float) -> np.ndarray:
    """Return the largest u that a condition allows at each of `DISTANCES`.

    It is the filter's answer to a far larger one.
    """
    bound = SCALAR.unbounded
    problem = make_problem(SCALAR.env, noise=noise, input_bounds=[-bound, bound])
    safety_filter = SafetyFilter.for_problem(problem, parse_conditions(text, problem))
    state = (1.0 - DISTANCES)[:, None]
    return safety_filter.filter(state, np.full_like(state, bound)).action[:, 0]


def attaining_problem(start: float) -> SafetyProblem:
    """Return dx = u dt + s x dW with h = 1 - x^2, which is a martingale under the SCBF."""
    x, u, s = sp.symbols("x u s", real=True)
    system = ControlAffineSDE((x,), (u,), [0], [1], [s * x], {s: SCALAR.scale})
    return define_problem(
        system,
        1 - x**2,
        input_bounds=(-50.0, 50.0),
        start=[start],
        dt=SCALAR.step,
        horizon=SCALAR.horizon,
        name="Martingale",
        filter="scbf",
    )


def safe_up_to(start: float, horizon: float, step: float = 0.0) -> float:
    """Return P(|x| < 1 up to the horizon in s) for dx = -s^2 x/2 dt + s x dW.

    log |x| is a Brownian motion with drift -s^2. x is looked at every step in s; 0 for always.
    """
    a = -math.log(start) + SHIFT * SCALAR.scale * math.sqrt(step)
    drift, deviation = SCALAR.scale**2 * horizon, SCALAR.scale * math.sqrt(horizon)
    first, second = ndtr((-a - drift) / deviation), ndtr((-a + drift) / deviation)
    return 1.0 - float(first + math.exp(-2.0 * a) * second)


def _limited(limit: float, episodes: int, seed: int) -> list[Number]:
    """Return the safety of both conditions in the scalar system with a bound on the input."""
    options = {
        "noise": SCALAR.noise,
        "start": [0.0],
        "input_bounds": [-limit, limit],
        "dt": SCALAR.step,
        "horizon": SCALAR.horizon,
    }
    where = "unbounded" if limit == SCALAR.unbounded else f"|u| <= {limit:g}"
    return [
        measure(SCALAR.env, name.lower(), episodes, seed, options=options).number(
            f"{name}, {where}"
        )
        for name in ("SRCBF", "SCBF")
    ]


def _for_all_starts(found: MeasuredFilter) -> Number:
    """Return a rate with an interval that holds it at all of `STARTS` with 95 %."""
    low, high = rate_interval(found.row.safe, found.episodes, 1.0 - 0.05 / len(STARTS))
    return Number("", found.rate, 100 * low, 100 * high, unit="%")


def claims_on_inputs(allowed: Mapping[str, np.ndarray]) -> list[Claim]:
    """Return the claims of the printed inequalities, and of their limits at the edge.

    The largest inputs are those that each condition allows at each of `DISTANCES`.
    """
    h, x = DISTANCES, 1.0 - DISTANCES
    printed = {"RCBF": h**3 - x, "SRCBF": h**3 - x - SCALAR.noise**2 / h}
    largest = max(
        float(np.max(np.abs(allowed[name] - law) / np.maximum(np.abs(law), 1.0)))
        for name, law in printed.items()
    )
    powers = {name: _power(allowed[name]) for name in printed}
    evidence = {
        name: f"it allows u = {allowed[name][-1]:.6g} at h = {h[-1]:g}; |u| goes like"
        f" h^{round(power, 3) + 0.0:.3f} there"
        for name, power in powers.items()
    }
    return [
        Claim(
            "both inequalities on u are right",
            largest < _ROUNDING,
            f"largest relative difference {largest:.1e}",
        ),
        Claim(
            "without noise the RCBF asks for bounded control at the edge",
            round(powers["RCBF"]) >= 0,
            evidence["RCBF"],
        ),
        Claim(
            "under noise the SRCBF asks for unbounded control at the edge",
            round(powers["SRCBF"]) < 0,
            evidence["SRCBF"],
        ),
    ]


def _power(allowed: np.ndarray) -> float:
    """Return the power of h with which the effort goes: 0 where it is bounded, else less."""
    near, effort = np.log(DISTANCES[-20:]), np.log(np.abs(allowed[-20:]))
    return float(np.polyfit(near, effort, 1)[0])


def claim_on_limits(bounded: Number, unbounded: Number) -> Claim:
    """Return the claim on the rates of the SRCBF with and without a bound on the input.

    The thesis guarantees certainty without a bound, and simulates neither.
    """
    return Claim(
        "with bounded control the SRCBF is less safe",
        bounded.is_below(unbounded.low or 0.0),
        f"{bounded.ours:.1f} % with {bounded.name.split(', ')[1]}, {unbounded.ours:.1f} % without a"
        " bound",
        printed=False,
    )


def claim_on_bound(attained: Sequence[Number], bounds: Sequence[float]) -> Claim:
    """Return the claim that no rate is below its bound h/c by more than chance.

    The rates are of a finite time, so that they may be above it.
    """
    below = sum(n.is_below(100 * b) for n, b in zip(attained, bounds, strict=True))
    return Claim(
        "Prop. 4.2.8: P(safe for ever) >= h/c",
        below == 0,
        f"up to {SCALAR.horizon:g} s: {_against(attained, bounds)}; below it by more than chance at"
        f" {below} of {len(bounds)} starts",
    )


def claim_on_attaining(attained: Sequence[Number], closed: Sequence[float]) -> Claim:
    """Return the claim that h/c is attained, from rates whose intervals hold all of them together.

    For ever the closed form is 1 - x_0^2 = h/c; what can be simulated is another value of the same
    form.
    """
    pairs = list(zip(attained, closed, strict=True))
    inside = sum(not n.is_above(100 * p) and not n.is_below(100 * p) for n, p in pairs)
    return Claim(
        "h/c is the worst case: on this system it is attained",
        inside == len(pairs),
        f"the closed form is inside at {inside} of {len(pairs)} starts, by intervals that hold all"
        f" of them with 95 %: {_against(attained, closed)}",
        printed=False,
    )


def _against(rates: Sequence[Number], others: Sequence[float]) -> str:
    pairs = zip(rates, others, strict=True)
    return "; ".join(f"{rate.text} against {100 * p:.1f} %" for rate, p in pairs)


def _draw(
    allowed: Mapping[str, np.ndarray],
    attained: Sequence[MeasuredFilter],
    bounds: Sequence[float],
    figure: Figure,
) -> None:
    """Draw what the conditions allow towards the edge, and safety over time with the bound."""
    left, right = figure.subplots(1, 2)
    near = DISTANCES < 0.5
    labels = ("RCBF, no noise", rf"SRCBF, $\sigma$ = {SCALAR.noise:g}")
    for inputs, color, label in zip(allowed.values(), COLORS[:2], labels, strict=True):
        left.plot(DISTANCES[near], -inputs[near], color=color, linewidth=1.5, label=label)
    left.set(xscale="log", yscale="log", title="(a)", xlabel="$h = 1 - x$, edge at the left")
    left.set_ylabel(labelled("minimum effort $-u$", "1/s"))
    dotted: dict[str, Any] = {"color": "black", "linewidth": 1, "linestyle": ":"}
    dashed: dict[str, Any] = {"linewidth": 1, "linestyle": "--"}
    for start, found, bound, color in zip(STARTS, attained, bounds, COLORS[2:], strict=False):
        curve = found.row.curve
        band = 100 * np.array([curve.ci_low, curve.rate, curve.ci_high])
        draw_interval(right, curve.time, band, color, 0.25, label=f"SCBF, $x_0$ = {start:g}")
        closed = [100 * safe_up_to(start, time, SCALAR.step) for time in curve.time[1:]]
        right.plot(curve.time[1:], closed, **dotted)
        right.axhline(100 * bound, color=color, **dashed)
    right.plot([], [], label="closed form", **dotted)
    right.plot([], [], color="black", label="$h/c$ of the same colour", **dashed)
    right.set(title="(b)", ylim=(35, 101), xlim=(0, SCALAR.horizon))
    right.set(xlabel=labelled("time", "s"), ylabel=labelled("safe so far", "%"))
    add_legend(figure, [h for axes in (left, right) for h in axes.get_legend_handles_labels()[0]])


ARTEFACTS = {"example-4.2.2": compute}
