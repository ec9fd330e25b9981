"""The pictures of concepts and of a control loop, computed when the site is built."""

from __future__ import annotations

import io
from typing import Any

import gymnasium as gym
import matplotlib as mpl
import numpy as np
import sympy as sp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from runs import ROOT

import safe_envs  # noqa: F401  (registers the ids)
from safe_envs import Barrier, ControlAffineSDE, SafetyProblem, plot_log
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.safety_chain import starts_of
from safe_envs.dynamics.codegen import compile_function
from safe_envs.plugins import load_object
from safe_envs.proofs.feasibility import verify
from safe_envs.scripts.figures.style import COLORS, QUIET, UNSAFE
from safe_envs.scripts.figures.style import SCREEN as STYLE
from safe_envs.wrappers import HOCBF, SafetyFilter, parse_conditions

WIDE, NARROW = (1, 2), (2, 1)
"""Parts of a picture from top to bottom and from left to right, on a desktop and on a phone."""

_GRID = 241
_EPISODES = 500
_HORIZON = 10.0
"""In s, of the picture of the bounds: long enough for a bound to decrease to zero."""


def pictures() -> dict[str, bytes]:
    """Return PNG files by path."""
    with mpl.rc_context(STYLE):
        return {
            "assets/chain.png": _written(_chain(WIDE)),
            "assets/chain-narrow.png": _written(_chain(NARROW)),
            "assets/qp.png": _written(_qp(WIDE)),
            "assets/qp-narrow.png": _written(_qp(NARROW)),
            "assets/bounds.png": _written(_bounds()),
            "assets/control-loop.png": _written(_control_loop()),
        }


def _written(figure: Figure) -> bytes:
    written = io.BytesIO()
    figure.savefig(written, format="png", dpi=150, facecolor="white")
    return written.getvalue()


def _problem(env_id: str) -> SafetyProblem:
    env: Any = gym.make(env_id)
    return env.unwrapped.problem


def _sheet(layout: tuple[int, int]) -> Figure:
    return Figure(figsize=(10, 4.5) if layout == WIDE else (5, 9.2))


def _chain(layout: tuple[int, int]) -> Figure:
    """Draw C_0, C_1 and the infeasible states of a Dubins vehicle that heads to the right."""
    problem = _problem("safe_envs/StochasticDubins-v0")
    figure = _sheet(layout)
    for axes, name in zip(figure.subplots(*layout), ("hocbf", "scbf"), strict=True):
        safety_filter = SafetyFilter.for_problem(problem, name)
        x, y = np.meshgrid(*[np.linspace(-3.4, 3.4, _GRID)] * 2)
        states = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
        h, b_1 = _chain_values(safety_filter, problem, states).reshape(2, *x.shape)
        result = safety_filter.filter(states, np.zeros((len(states), 1)))
        infeasible = np.where((h > 0) & (b_1 > 0), ~result.feasible.reshape(x.shape), False)
        axes.contourf(x, y, h, levels=[-np.inf, 0.0], colors=[UNSAFE], alpha=0.35)
        axes.contourf(
            x, y, np.minimum(h, b_1), levels=[0.0, np.inf], colors=[COLORS[4]], alpha=0.45
        )
        axes.contourf(
            x, y, infeasible.astype(float), levels=[0.5, 1.5], colors=[COLORS[3]], alpha=0.8
        )
        axes.contour(x, y, h, levels=[0.0], colors="black", linewidths=1.3)
        axes.contour(x, y, b_1, levels=[0.0], colors=COLORS[0], linewidths=1.3)
        axes.annotate("", (0.6, -2.4), (-0.6, -2.4), arrowprops={"arrowstyle": "->"})
        axes.text(0.0, -2.3, "heading", ha="center", va="bottom", color=QUIET)
        axes.set(
            aspect="equal",
            xlabel="x [m]",
            ylabel="y [m]",
            title=_title(name, infeasible.sum(), ((h > 0) & (b_1 > 0)).sum()),
        )
    figure.legend(
        handles=[
            Line2D([], [], color="black", label="h = 0"),
            Line2D([], [], color=COLORS[0], label="b₁ = 0"),
            Patch(color=UNSAFE, alpha=0.35, label="unsafe"),
            Patch(color=COLORS[4], alpha=0.45, label="C₀ ∩ C₁"),
            Patch(color=COLORS[3], alpha=0.8, label="infeasible within the input bounds"),
        ],
        loc="outside lower center",
        ncols=5 if layout == WIDE else 2,
    )
    return figure


def _title(name: str, infeasible: int, total: int) -> str:
    return f"{name}: infeasible in {100 * infeasible / total:.0f} % of C₀ ∩ C₁"


def _chain_values(
    safety_filter: SafetyFilter, problem: SafetyProblem, states: np.ndarray
) -> np.ndarray:
    """Return b_0..b_(r-1) at states (B, n), shape (r, B)."""
    chain = [problem.model.numeric(b) for b in safety_filter.constraints[0].chain]
    return np.array(compile_function(problem.model.states, chain, "arrays")(*states.T))


def _point() -> tuple[ControlAffineSDE, Barrier]:
    """Return a point mass in the plane, and a round obstacle."""
    x, y, v_x, v_y, a_x, a_y = sp.symbols("x y v_x v_y a_x a_y", real=True)
    gains = [[0, 0], [0, 0], [1, 0], [0, 1]]
    system = ControlAffineSDE(
        (x, y, v_x, v_y),
        (a_x, a_y),
        drift=[v_x, v_y, 0, 0],
        input_matrix=gains,
        diffusion=[0, 0, 0, 0],
    )
    return system, Barrier(x**2 + y**2 - 1)


def _qp(layout: tuple[int, int]) -> Figure:
    """Draw the QP of a filter in the plane of two inputs, at a feasible and an infeasible state."""
    system, barrier = _point()
    safety_filter = SafetyFilter(
        system, [(barrier, HOCBF((2.0, 2.0)))], input_bounds=[(-2.0, 2.0)] * 2
    )
    constraint = safety_filter.constraints[0]
    compiled = compile_function(
        system.states, [*constraint.coefficient, constraint.offset], "floats"
    )
    nominal = np.array([1.5, -0.3])
    figure = _sheet(layout)
    for axes, speed in zip(figure.subplots(*layout), (1.1, 2.2), strict=True):
        state = np.array([-2.0, 0.4, speed, 0.0])
        result = safety_filter.filter(state, nominal)
        _draw_qp(axes, np.array(compiled(*state)), nominal, result)
        verdict = "feasible" if result.feasible else f"infeasible, slack {result.slack[0]:.2f}"
        axes.set_title(f"towards the obstacle at {speed:g} m/s: {verdict}")
    figure.legend(
        handles=figure.axes[0].get_legend_handles_labels()[0],
        loc="outside lower center",
        ncols=3 if layout == WIDE else 2,
    )
    return figure


def _draw_qp(axes: Axes, constraint: np.ndarray, nominal: np.ndarray, result: Any) -> None:
    u, v = np.meshgrid(*[np.linspace(-3.2, 3.2, _GRID)] * 2)
    allowed = constraint[0] * u + constraint[1] * v + constraint[2]
    axes.contourf(u, v, allowed, levels=[-np.inf, 0.0], colors=[UNSAFE], alpha=0.35)
    axes.contour(u, v, allowed, levels=[0.0], colors="black", linewidths=1.3)
    axes.add_patch(
        Rectangle((-2, -2), 4, 4, fill=False, linestyle="--", edgecolor=QUIET, label="input bounds")
    )
    axes.plot(*nominal, "o", color="#D55E00", markersize=8, label="nominal action")
    axes.plot(*result.action, "s", color=COLORS[0], markersize=8, label="executed action")
    axes.annotate(
        "", tuple(result.action), tuple(nominal), arrowprops={"arrowstyle": "->", "color": QUIET}
    )
    axes.text(
        0.98,
        0.02,
        "grey: a u + b < 0",
        transform=axes.transAxes,
        ha="right",
        va="bottom",
        color=QUIET,
    )
    axes.set(aspect="equal", xlabel="$a_x$ [m/s²]", ylabel="$a_y$ [m/s²]")


def _control_loop() -> Figure:
    """Draw the log of the example of a control loop."""
    log, _ = load_object(f"{ROOT / 'examples' / 'control_loop.py'}:run")()
    return plot_log(log)


def _bounds() -> Figure:
    """Draw the measured rate and the bounds over the horizon, for the cubic SDE in a disk."""
    problem = _problem("safe_envs/CubicSDEDisk-v0").configured(horizon=_HORIZON)
    evaluation = evaluate(problem, filters=["none", "scbf"], episodes=_EPISODES, seed=0)
    verification = verify(problem, parse_conditions("scbf", problem))
    starts = starts_of(problem)
    figure = Figure(figsize=(7.5, 4.2))
    axes = figure.subplots()
    for row, color in zip(evaluation.rows, ("#D55E00", COLORS[0]), strict=True):
        curve = row.curve
        axes.fill_between(
            curve.time, curve.ci_low, curve.ci_high, color=color, alpha=0.25, linewidth=0
        )
        axes.plot(
            curve.time,
            curve.rate,
            color=color,
            label=f"{row.filter}: measured, {_EPISODES} episodes, with its 95 % band",
        )
    times = np.linspace(0.0, problem.horizon, 41)
    for bounds in zip(
        *[verification.guarantee.applicable_bounds(starts, t) for t in times.tolist()], strict=True
    ):
        axes.plot(
            times,
            [bound.value or 0.0 for bound in bounds],
            color=COLORS[1],
            linestyle="--",
            label=f"{bounds[-1].name.split(',')[0]}: {bounds[-1].status}",
        )
    axes.set(
        xlim=(0.0, problem.horizon),
        ylim=(0.0, 1.02),
        xlabel="horizon T [s]",
        ylabel="probability of no violation",
    )
    figure.legend(handles=axes.get_legend_handles_labels()[0], loc="outside lower center", ncols=2)
    return figure
