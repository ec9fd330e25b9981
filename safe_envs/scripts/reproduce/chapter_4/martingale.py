"""Thesis Sec. 4.2.2, Prop. 4.2.8: reciprocal conditions under noise, and an attained bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import sympy as sp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import ndtr

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem
from safe_envs.agents import rate_interval
from safe_envs.problem.initial_distribution import Start
from safe_envs.problem.signals import Variable
from safe_envs.scripts.figures.labels import labelled
from safe_envs.scripts.figures.style import COLORS, add_legend
from safe_envs.scripts.reproduce.chapter_4 import reciprocal_inputs as scalar
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.drawing import draw_interval
from safe_envs.scripts.reproduce.framework.episodes import episode_seed
from safe_envs.scripts.reproduce.framework.paired import is_above, is_below, measure
from safe_envs.wrappers.verification.bounds import proposition_4_2_8

LIMITS, STARTS, SCALE = (scalar.SETTINGS[name] for name in ("limits", "starts", "scale"))
STEP, HORIZON, EPISODES = (scalar.SETTINGS[name] for name in ("step", "horizon", "episodes"))
_note = partial(scalar.CHAPTER.note, "example-4.2.2")
_claim = partial(scalar.CHAPTER.claim, "example-4.2.2")
SHIFT = 0.5826
"""By so many standard deviations of a step a boundary watched at the steps seems further away."""


def attaining_problem(start: float) -> SafetyProblem:
    """Return the system dx = u dt + s x dW with h = 1 - x^2, from a start.

    With the nominal input 0, h is a martingale under the SCBF.
    """
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
    """Return P(|x| < 1 up to the horizon) for dx = -s^2 x/2 dt + s x dW.

    log |x| is a Brownian motion with drift -s^2.

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


def compute(sample: Workload) -> Findings:
    """Compute what the conditions ask for, and how safe they are."""
    episodes = sample.size(EPISODES)
    allowed = {
        "RCBF": scalar.largest_inputs(f"rcbf:gamma={scalar.GAMMA}", 0.0),
        "SRCBF": scalar.largest_inputs(f"srcbf:gamma={scalar.GAMMA}", scalar.NOISE),
    }
    limits = (*LIMITS[: 1 if sample.quick else None], scalar.UNBOUNDED)
    limited = [_limited(limit, episodes, sample.seed) for limit in limits]
    calm = {"noise": 0.0, "box": [-LIMITS[0], LIMITS[0]]}
    attained = [
        measure(attaining_problem(start), "scbf", episodes, episode_seed(sample.seed, i))
        for i, start in enumerate(STARTS)
    ]
    rates = [
        each.number(f"SCBF where h/c is attained, x_0 = {s:g}")
        for s, each in zip(STARTS, attained, strict=True)
    ]
    bounds = [float(proposition_4_2_8(1.0 - s**2, 1.0)) for s in STARTS]
    closed = [
        [safe_up_to(s, t, step) for s in STARTS] for t, step in ((math.inf, 0.0), (HORIZON, STEP))
    ]
    curves = [each.row.curve for each in attained]
    calm_rate = measure(scalar.SCALAR, "rcbf", 1, 0, options=calm).rate
    return Findings(
        numbers=[
            *rates,
            *(number for pair in limited for number in pair),
            Number(f"RCBF without noise, |u| <= {LIMITS[0]:g}", calm_rate, unit="%"),
        ],
        claims=[
            *scalar.claims_on_inputs(allowed),
            claim_on_limits(limited[0][0], limited[-1][0]),
            claim_on_bound(rates, bounds),
            claim_on_attaining([_together(each.row) for each in attained], closed[1]),
        ],
        data={
            "h": scalar.DISTANCES.tolist(),
            "asked": {name: values.tolist() for name, values in allowed.items()},
            "curves": [
                {key: getattr(curve, key) for key in ("time", "rate", "ci_low", "ci_high")}
                | {"bound": b, "start": s}
                for s, curve, b in zip(STARTS, curves, bounds, strict=True)
            ],
            "closed": [[safe_up_to(s, t, STEP) for t in curves[0].time[1:]] for s in STARTS],
        },
        notes=[
            *(
                _note(
                    "attained",
                    start=s,
                    bound=100 * b,
                    ever=100 * e,
                    closed=100 * f,
                    rate=r.rate,
                    horizon=HORIZON,
                )
                for s, b, e, f, r in zip(STARTS, bounds, *closed, attained, strict=True)
            ),
            _note("held", rate=limited[-1][0].ours),
        ],
    )


def _together(row: Any) -> Number:
    """Return a rate with an interval that holds it at all of `STARTS` with 95 %."""
    low, high = rate_interval(row.safe, row.episodes, 1.0 - 0.05 / len(STARTS))
    return Number("", 100 * row.safe / row.episodes, 100 * low, 100 * high, unit="%")


def _limited(limit: float, episodes: int, seed: int) -> list[Number]:
    """Return the safety of both conditions in the scalar system with a bound on the input."""
    box = [-limit, limit]
    options = {"noise": scalar.NOISE, "start": [0.0], "box": box, "dt": STEP, "horizon": HORIZON}
    where = "unbounded" if limit == scalar.UNBOUNDED else f"|u| <= {limit:g}"
    return [
        measure(scalar.SCALAR, name.lower(), episodes, seed, options=options).number(
            f"{name}, {where}"
        )
        for name in ("SRCBF", "SCBF")
    ]


def claim_on_limits(bounded: Number, unbounded: Number) -> Claim:
    """Return the claim on the rates of the SRCBF.

    The thesis guarantees certainty without a bound, and simulates neither.

    Args:
        bounded: rate with a bound on the input.
        unbounded: rate without one.
    """
    values = {"bounded": bounded.ours, "unbounded": unbounded.ours}
    holds, limit = is_below(bounded, unbounded.low or 0.0), bounded.name.split(", ")[1]
    return _claim("limits", holds, limit=limit, **values)


def claim_on_bound(attained: Sequence[Number], bounds: Sequence[float]) -> Claim:
    """Return the claim that no rate is below its bound by more than chance.

    The rates are of a finite time, so that they may be above it.

    Args:
        attained: rates from each start, in per cent.
        bounds: h/c at each start, from 0 to 1.
    """
    below = sum(is_below(n, 100 * b) for n, b in zip(attained, bounds, strict=True))
    values = {"below": below, "rates": _against(attained, bounds), "count": len(bounds)}
    return _claim("bound", below == 0, horizon=HORIZON, **values)


def claim_on_attaining(attained: Sequence[Number], closed: Sequence[float]) -> Claim:
    """Return the claim that h/c is attained.

    For ever the closed form is 1 - x_0^2 = h/c; what can be simulated is another value of the same
    form.

    Args:
        attained: rates with 95 % intervals for all of them together.
        closed: the form for the horizon and the instants that are simulated.
    """
    inside = sum(
        not is_above(n, 100 * p) and not is_below(n, 100 * p)
        for n, p in zip(attained, closed, strict=True)
    )
    values = {"inside": inside, "rates": _against(attained, closed), "count": len(closed)}
    return _claim("attained", inside == len(closed), horizon=HORIZON, **values)


def _against(rates: Sequence[Number], others: Sequence[float]) -> str:
    return "; ".join(
        f"{n.ours:.1f} % [{n.low:.1f}, {n.high:.1f}] against {100 * p:.1f} %"
        for n, p in zip(rates, others, strict=True)
    )


def _draw(figure: Figure, outcome: Findings) -> None:
    """Draw what the conditions allow towards the edge, and safety over time with the bound."""
    left, right = figure.subplots(1, 2)
    scalar.draw_inputs(left, outcome.data)
    _draw_bound(right, outcome.data)
    handles = [axes.get_legend_handles_labels()[0] for axes in (left, right)]
    add_legend(figure, [handle for each in handles for handle in each])


def _draw_bound(axes: Axes, data: dict[str, Any]) -> None:
    dotted: dict[str, Any] = {"color": "black", "linewidth": 1, "linestyle": ":"}
    dashed: dict[str, Any] = {"linewidth": 1, "linestyle": "--"}
    for curve, closed, color in zip(data["curves"], data["closed"], COLORS[2:], strict=False):
        time, band = (
            curve["time"],
            [100 * np.array(curve[k]) for k in ("ci_low", "rate", "ci_high")],
        )
        draw_interval(axes, time, band, color, 0.25, label=f"SCBF, $x_0$ = {curve['start']:g}")
        axes.plot(time[1:], 100 * np.array(closed), **dotted)
        axes.axhline(100 * curve["bound"], color=color, **dashed)
    axes.plot([], [], label="closed form", **dotted)
    axes.plot([], [], color="black", label="$h/c$ of the same colour", **dashed)
    limits = {"ylim": (35, 101), "xlim": (0, HORIZON)}
    axes.set(
        xlabel=labelled("time", "s"), ylabel=labelled("safe so far", "%"), title="(b)", **limits
    )


ARTEFACTS = (
    scalar.CHAPTER.artefact(
        "example-4.2.2", compute, lambda sample: {"count": sample.size(EPISODES)}, _draw
    ),
)
