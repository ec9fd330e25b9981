"""A verification over a plane of two states: a slice, and all values of the other states."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgba
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure

from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.figures.labels import labelled, symbol
from safe_envs.scripts.figures.style import COLORS, DASHES, QUIET, UNSAFE, drawable
from safe_envs.scripts.figures.verify_panel import (
    INFEASIBLE,
    DrawnVerification,
    axis_label,
    infeasible,
    mark_states,
    window,
)
from safe_envs.wrappers.verification.feasibility import Verification
from safe_envs.wrappers.verification.safe_set import sample

_GRID = 300
_COARSE = 90
_OTHERS_LOG2 = 7
_LISTED = 3
_LEVELS = (0.2, 0.4, 0.6, 0.8)


def draw_slice(axes: Axes, answer: DrawnVerification) -> ContourSet | None:
    """Draw h, the chain and where no action meets the conditions, in the plane of the worst state.

    Args:
        axes: to draw on.
        answer: to draw.

    Returns:
        The contours of h inside the safe set, for `write_levels`; None without any.
    """
    lines = None
    found = answer.verification
    problem, worst = found.problem, found.part.worst
    formulas, plane = found.formulas, _plane(problem)
    grid, x = _states_over(answer, plane, worst, _GRID)
    chain = formulas.chain(x)
    h = drawable(np.nan_to_num(chain[:, formulas.barriers].min(axis=1), nan=-np.inf))

    def shaped(values: np.ndarray) -> np.ndarray:
        return values.reshape(grid[0].shape)

    violated = shaped(infeasible(formulas, x, formulas.barrier_level))
    axes.contourf(*grid, violated, levels=[0.5, 2.0], colors=[INFEASIBLE], alpha=0.6, zorder=1)
    axes.contourf(*grid, shaped(h), levels=[-np.inf, 0.0], colors=[UNSAFE], alpha=0.5, zorder=0)
    axes.contour(*grid, shaped(h), levels=[0.0], colors="black", linewidths=1.1, zorder=3)
    if np.nanmax(h) > 1e-3 * min(b.deepest_h for b in found.barriers) or found.beyond:
        # Quantiles, since equal steps of a steep function crowd together at one end.
        inner = np.unique(np.quantile(h[h > 0.0], _LEVELS))
        lines = axes.contour(*grid, shaped(h), levels=inner, colors=QUIET, linewidths=0.5, zorder=2)
    for stage in formulas.stages:
        for j in range(stage.start + 1, stage.stop):
            style = {"colors": COLORS[j - stage.start - 1], "linestyles": [DASHES[j - stage.start]]}
            inside = np.where(shaped(h) >= 0.0, shaped(chain[:, j]), np.nan)
            axes.contour(*grid, inside, levels=[0.0], zorder=3, **style)
    starts = answer.starts[:, plane[0]], answer.starts[:, plane[1]]
    mark_states(axes, starts, (worst[plane[0]], worst[plane[1]]))
    _label(axes, problem, plane)
    others = [
        f"{symbol(s.symbol.name)} = {worst[i] + 0.0:.3g}"
        for i, s in enumerate(problem.states)
        if i not in plane
    ]
    listing = ", ".join(others) if len(others) < _LISTED else "other states"
    title = "Contours of $h$"
    axes.set_title(f"{title}, at the worst state found:\n{listing}" if others else title)
    return lines


def draw_shares(figure: Figure, axes: Axes, answer: DrawnVerification) -> None:
    """Draw for which share of the other states no action meets the conditions.

    Args:
        figure: with the axes, for the colour bar.
        axes: to draw on.
        answer: to draw.
    """
    found = answer.verification
    problem = found.problem
    formulas, plane = found.formulas, _plane(problem)
    # Several conditions take a solver: a coarser picture of a tenth of the states.
    coarser = len(formulas.stages) > 1
    count = _COARSE // 2 if coarser else _COARSE
    grid, states = _states_over(answer, plane, found.part.worst, count)
    inside, violated = np.zeros(len(states)), np.zeros(len(states))
    for values in _others(found, 2 ** (_OTHERS_LOG2 - 2 * coarser)):
        x = np.tile(values, (len(states), 1))
        x[:, plane] = states[:, plane]
        inside += formulas.invariant_level(x) >= 0.0
        violated += infeasible(formulas, x, formulas.invariant_level) == 1.0
    with np.errstate(invalid="ignore"):
        share = np.where(inside > 0, 100.0 * violated / inside, np.nan).reshape(grid[0].shape)
    top = max(float(np.nanmax(share)) if np.isfinite(share).any() else 0.0, 1.0)
    colors = LinearSegmentedColormap.from_list("infeasible", ["#FFFFFF", INFEASIBLE])
    image = axes.pcolormesh(*grid, share, cmap=colors, vmin=0.0, vmax=top, rasterized=True)
    axes.set_facecolor(to_rgba(UNSAFE, 0.5))
    where = "$C$" if formulas.first_order else "the intersection of the $C_j$"
    rest = [str(s.symbol) for i, s in enumerate(problem.states) if i not in plane]
    label = labelled(f"part of {where}", "%")
    figure.colorbar(image, ax=axes, label=label, shrink=0.9)
    _label(axes, problem, plane)
    over = symbol(rest[0]) if len(rest) == 1 else "values of the other states"
    axes.set_title(f"Where no action meets the conditions,\nover all {over}")


def _plane(problem: SafetyProblem) -> tuple[int, int]:
    names = [s.symbol.name for s in problem.states]
    across, up = problem.plane or names[:2]
    return names.index(across), names.index(up)


def _states_over(
    answer: DrawnVerification, plane: tuple[int, int], state: np.ndarray, count: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return a grid over a plane, and its states, with the other coordinates of a state."""
    ticks = [np.linspace(low, high, count) for low, high in window(answer, plane)]
    grid = np.meshgrid(*ticks)
    x = np.tile(state, (grid[0].size, 1))
    x[:, plane[0]], x[:, plane[1]] = grid[0].ravel(), grid[1].ravel()
    return list(grid), x


def _others(found: Verification, count: int) -> np.ndarray:
    """Return states whose coordinates outside the plane are tried.

    They are evenly spread, or in the invariant set where such states would rarely be in it.
    """
    rng = np.random.default_rng(0)
    if found.problem.plant.n == 3 or found.invariant_set is None:
        return found.region.draw(count.bit_length() - 1, rng)
    points = sample(
        "the intersection of the C_j", found.formulas.invariant_level, found.region, count, rng
    ).points
    return points[rng.choice(len(points), count, replace=False)]


def _label(axes: Axes, problem: SafetyProblem, plane: tuple[int, int]) -> None:
    across, up = plane
    axes.set(xlabel=axis_label(problem, across), ylabel=axis_label(problem, up))
    if problem.states[across].unit == problem.states[up].unit:
        axes.set_aspect("equal")
