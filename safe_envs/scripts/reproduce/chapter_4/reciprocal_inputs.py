"""Thesis Sec. 4.2.2: the inputs that reciprocal conditions allow towards the edge."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from safe_envs.agents import make_problem
from safe_envs.scripts.figures.labels import labelled
from safe_envs.scripts.figures.style import COLORS
from safe_envs.scripts.reproduce.framework.artefact import Claim
from safe_envs.scripts.reproduce.framework.thesis_data import chapter
from safe_envs.wrappers import SafetyFilter, parse_conditions

CHAPTER = chapter(4)
SETTINGS = CHAPTER.settings["scalar"]
SCALAR = "safe_envs/Scalar-v0"
GAMMA, NOISE = SETTINGS["gamma"], SETTINGS["noise"]
UNBOUNDED = 1e12  # an input bound so wide that it never counts, 1/s
DISTANCES = np.logspace(0, -6, 61)  # h at which the conditions are asked for the largest input
_ROUNDING = 1e-6  # relative difference up to which two inputs are the same


def largest_inputs(text: str, noise: float) -> np.ndarray:
    """Return the largest u that a condition allows at each of `DISTANCES`.

    It is the filter's answer to a far larger one.

    Args:
        text: of the condition.
        noise: sigma of the scalar system, in 1/sqrt(s).
    """
    problem = make_problem(SCALAR, noise=noise, box=[-UNBOUNDED, UNBOUNDED])
    answer = SafetyFilter.for_problem(problem, parse_conditions(text, problem))
    state = (1.0 - DISTANCES)[:, None]
    return answer.filter(state, np.full_like(state, UNBOUNDED)).action[:, 0]


def claims_on_inputs(allowed: Mapping[str, np.ndarray]) -> list[Claim]:
    """Return the claims of the printed inequalities, and of their limits at the edge.

    Args:
        allowed: the largest input that each condition allows at each of `DISTANCES`.
    """
    h, x = DISTANCES, 1.0 - DISTANCES
    printed = {"RCBF": h**3 - x, "SRCBF": h**3 - x - NOISE**2 / h}
    largest = max(
        float(np.max(np.abs(allowed[name] - law) / np.maximum(np.abs(law), 1.0)))
        for name, law in printed.items()
    )
    return [
        CHAPTER.claim("example-4.2.2", "inputs", largest < _ROUNDING, largest=largest),
        _claim_on_edge("bounded", allowed["RCBF"]),
        _claim_on_edge("unbounded", allowed["SRCBF"]),
    ]


def _claim_on_edge(name: str, allowed: np.ndarray) -> Claim:
    """Return the claim by the power of h, to the nearest integer, with which the effort goes.

    It is 0 where the effort is bounded, and less where it is not.
    """
    near, effort = np.log(DISTANCES[-20:]), np.log(np.abs(allowed[-20:]))
    power = float(np.polyfit(near, effort, 1)[0])
    holds = (round(power) >= 0) == (name == "bounded")
    values = {"allowed": allowed[-1], "h": DISTANCES[-1], "power": round(power, 3) + 0.0}
    return CHAPTER.claim("example-4.2.2", name, holds, **values)


def draw_inputs(axes: Axes, data: dict[str, Any]) -> None:
    """Draw the effort that each condition asks for, over h.

    Args:
        axes: where.
        data: of the outcome.
    """
    near = np.array(data["h"]) < 0.5
    h, what = np.array(data["h"])[near], ("no noise", rf"$\sigma$ = {NOISE:g}")
    for (name, values), color, noise in zip(data["asked"].items(), COLORS[:2], what, strict=True):
        axes.plot(h, -np.array(values)[near], color=color, linewidth=1.5, label=f"{name}, {noise}")
    labels = {"xlabel": "$h = 1 - x$, edge at the left"}
    axes.set_ylabel(labelled("minimum effort $-u$", "1/s"))
    axes.set(xscale="log", yscale="log", title="(a)", **labels)
