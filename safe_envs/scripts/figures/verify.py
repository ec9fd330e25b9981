"""The picture of a verification: where no action meets the conditions, h, and the boundaries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgba
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from safe_envs.agents.evaluation.safety_chain import starts_of
from safe_envs.agents.evaluation.table import describe_system
from safe_envs.filters.conditions.text import spec_of
from safe_envs.problem.problem import SafetyProblem
from safe_envs.proofs.feasibility import Verification
from safe_envs.proofs.safe_set import Formulas, sample
from safe_envs.scripts.figures.style import (
    COLORS,
    DASHES,
    QUIET,
    STYLE,
    UNSAFE,
    StyledFigure,
    add_legend,
    add_title,
    drawable,
    finished,
    labelled,
    mathematics,
    plain,
    quantity,
    symbol,
    write_levels,
)
from safe_envs.scripts.options.evaluation_options import DEFAULT_SIZE, width_of

INFEASIBLE = "#D55E00"
_SHOWN_STARTS = 200
_NEAREST = 500


def _window(found: Verification, starts: np.ndarray, indices: Sequence[int]) -> np.ndarray:
    """Return limits along states, shape (n, 2), that show C, or what happens in it if it is cut."""
    region, level = found.region, found.formulas.barrier_level
    points = region.draw(14, np.random.default_rng(0))
    inside = points[level(points) >= 0.0]
    if not len(inside):
        return np.stack([region.low, region.high], axis=1)[list(indices)]
    if found.beyond:
        nearest = points[np.argsort(abs(level(points)))[: len(points) // _NEAREST]]
        inside = np.concatenate([starts, found.part.worst[None], nearest])
    low, high = inside.min(axis=0), inside.max(axis=0)
    room = 0.12 * (high - low) + 1e-3 * (region.high - region.low)
    low, high = np.maximum(region.low, low - room), np.minimum(region.high, high + room)
    return np.stack([low, high], axis=1)[list(indices)]


def _infeasible(
    formulas: Formulas, x: np.ndarray, level: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return 1 where no action meets the conditions, 0 where one does, NaN where `level` is < 0."""
    found, inside = np.full(len(x), np.nan), level(x) >= 0.0
    if inside.any():
        found[inside] = formulas.shortfall(x[inside]) > 0.0
    return found


def _mark_states(axes: Axes, starts: tuple[np.ndarray, np.ndarray], worst: Sequence[float]) -> None:
    """Mark the starts and the worst state, by coordinates along both axes, whose limits stay."""
    limits = {"xlim": axes.get_xlim(), "ylim": axes.get_ylim()}
    shown = [coordinates[:_SHOWN_STARTS] for coordinates in starts]
    size = 1.8 if len(shown[0]) > 1 else 4
    axes.plot(*shown, "o", color=COLORS[0], markersize=size, alpha=0.7, zorder=4)
    cross = {"color": INFEASIBLE, "markeredgecolor": "black", "markersize": 7}
    axes.plot(*worst, "X", **cross, zorder=5, clip_on=False)
    axes.set(**limits)


def _axis_label(problem: SafetyProblem, i: int) -> str:
    return quantity(problem.states[i].symbol.name, problem.states[i].unit)


def _draw_line(axes: Axes, found: Verification, starts: np.ndarray) -> None:
    """Draw h and the chain over the only state of a problem."""
    formulas = found.formulas
    (low, high), *_ = _window(found, starts, [0])
    x = np.linspace(low, high, 1000)[:, None]
    chain = formulas.chain(x)
    axes.plot(x[:, 0], chain[:, 0], color="black", linewidth=1.1)
    for j in range(1, chain.shape[1]):
        axes.plot(x[:, 0], chain[:, j], color=COLORS[j - 1], linestyle=DASHES[j])
    axes.axhline(0.0, color="black", linewidth=0.6)
    violated = _infeasible(formulas, x, formulas.barrier_level) == 1.0
    for where, color, alpha in ((chain[:, 0] < 0.0, UNSAFE, 0.5), (violated, INFEASIBLE, 0.6)):
        axes.fill_between(
            x[:, 0],
            0,
            1,
            where=list(where),
            color=color,
            alpha=alpha,
            linewidth=0,
            transform=axes.get_xaxis_transform(),
        )
    axes.set_xlim(low, high)
    heights = formulas.chain(starts)[:, 0]
    _mark_states(axes, (starts[:, 0], heights), (found.part.worst[0], 0.0))
    title = "$h$" + ", and where no action meets the condition" * bool(violated.any())
    axes.set(xlabel=_axis_label(found.problem, 0), ylabel="$h$", title=title)


_GRID = 300
_COARSE = 90
_OTHERS_LOG2 = 7
_LISTED = 3
_LEVELS = (0.2, 0.4, 0.6, 0.8)


def _draw_slice(axes: Axes, found: Verification, starts: np.ndarray) -> ContourSet | None:
    """Draw h, the chain and where no action meets the conditions, through the worst state."""
    # The contours of h inside the safe set are returned, for `write_levels`.
    lines = None
    problem, worst = found.problem, found.part.worst
    formulas, plane = found.formulas, _plane(problem)
    grid, x = _states_over(found, starts, plane, _GRID)
    chain = formulas.chain(x)
    h = drawable(np.nan_to_num(chain[:, formulas.barriers].min(axis=1), nan=-np.inf))

    def shaped(values: np.ndarray) -> np.ndarray:
        return values.reshape(grid[0].shape)

    violated = shaped(_infeasible(formulas, x, formulas.barrier_level))
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
    _mark_states(
        axes, (starts[:, plane[0]], starts[:, plane[1]]), (worst[plane[0]], worst[plane[1]])
    )
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


def _draw_shares(figure: Figure, axes: Axes, found: Verification, starts: np.ndarray) -> None:
    """Draw for which share of the other states no action meets the conditions."""
    problem = found.problem
    formulas, plane = found.formulas, _plane(problem)
    # Several conditions take a solver: a coarser picture of a tenth of the states.
    coarser = len(formulas.stages) > 1
    count = _COARSE // 2 if coarser else _COARSE
    grid, states = _states_over(found, starts, plane, count)
    inside, violated = np.zeros(len(states)), np.zeros(len(states))
    for values in _others(found, 2 ** (_OTHERS_LOG2 - 2 * coarser)):
        x = np.tile(values, (len(states), 1))
        x[:, plane] = states[:, plane]
        inside += formulas.invariant_level(x) >= 0.0
        violated += _infeasible(formulas, x, formulas.invariant_level) == 1.0
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
    found: Verification, starts: np.ndarray, plane: tuple[int, int], count: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return a grid over a plane, and its states, with the other coordinates of the worst state."""
    ticks = [np.linspace(low, high, count) for low, high in _window(found, starts, plane)]
    grid = np.meshgrid(*ticks)
    x = np.tile(found.part.worst, (grid[0].size, 1))
    x[:, plane[0]], x[:, plane[1]] = grid[0].ravel(), grid[1].ravel()
    return list(grid), x


def _others(found: Verification, count: int) -> np.ndarray:
    """Return states whose coordinates outside the plane are tried."""
    # They are evenly spread, or in the invariant set where such states would rarely be in it.
    rng = np.random.default_rng(0)
    if found.problem.plant.n == 3 or found.invariant_set is None:
        return found.region.draw(count.bit_length() - 1, rng)
    points = sample(
        "the intersection of the C_j", found.formulas.invariant_level, found.region, count, rng
    ).points
    return points[rng.choice(len(points), count, replace=False)]


def _label(axes: Axes, problem: SafetyProblem, plane: tuple[int, int]) -> None:
    across, up = plane
    axes.set(xlabel=_axis_label(problem, across), ylabel=_axis_label(problem, up))
    if problem.states[across].unit == problem.states[up].unit:
        axes.set_aspect("equal")


def plot_verification(
    found: Verification,
    out: Path | str | None = None,
    *,
    starts: np.ndarray | None = None,
    title: str | None = None,
    size: str = DEFAULT_SIZE,
) -> StyledFigure:
    """Draw where no action meets the conditions, h, and the boundaries of the chain.

    A plane is drawn with the other states as at the worst state found, and next to it with all
    values of the others at once.

    Args:
        found: to draw, of `verify`.
        out: file of the picture; its suffix is the format: .png, .pdf or .svg.
        starts: to mark, shape (B, n); by default some of the problem's.
        title: name of the env; by default that of the problem.
        size: "single" or "double", in columns of a paper.

    Returns:
        The figure, which a notebook shows.

    Raises:
        ConfigurationError: The file cannot be written, or there is no such size.
    """
    problem, width = found.problem, width_of(size)
    starts = starts_of(problem) if starts is None else starts
    several = problem.plant.n > 2
    with mpl.rc_context(STYLE):
        aside = several and size == "double"
        # A single panel of two columns would be taller than wide panels need.
        height = 3.9 if aside else 6.8 if several else 4.2 if size == "double" else 3.6
        figure = StyledFigure(figsize=(width, height))
        shape = (1, 2) if aside else (2, 1) if several else (1, 1)
        panels = list(figure.subplots(*shape, squeeze=False).flat)
        lines = None
        if problem.plant.n == 1:
            _draw_line(panels[0], found, starts)
        else:
            lines = _draw_slice(panels[0], found, starts)
        if several:
            _draw_shares(figure, panels[1], found, starts)
        add_legend(figure, _legend(found, lines))
        heading = plain(f"{title or problem.name}, {spec_of(found.formulas.conditions)}", 200)
        add_title(figure, f"{heading}\n{mathematics(describe_system(problem))}")
        if lines is not None:
            write_levels(figure, panels[0], lines)
    return finished(figure, out)


def _legend(found: Verification, lines: ContourSet | None) -> list[Patch | Line2D]:
    handles: list[Patch | Line2D] = []
    if found.safe_set.shortfall > 0.0 or found.part.shortfall > 0.0:
        handles.append(Patch(color=INFEASIBLE, alpha=0.6, label="no action meets the condition"))
    handles.append(Patch(color=UNSAFE, alpha=0.5, label="unsafe"))
    handles.append(Line2D([], [], color="black", linewidth=1.1, label="$h = 0$"))
    if lines is not None:
        levels = ", ".join(f"{level:.3g}" for level in lines.levels)
        handles.append(Line2D([], [], color=QUIET, linewidth=0.5, label=f"$h =$ {levels}"))
    degree = max(stage.stop - stage.start for stage in found.formulas.stages)
    handles += [
        Line2D([], [], color=COLORS[j - 1], linestyle=DASHES[j], label=f"$b_{j} = 0$")
        for j in range(1, degree)
    ]
    marker: Any = {"linestyle": "", "color": INFEASIBLE, "marker": "X", "markeredgecolor": "black"}
    cross = "worst state found" if found.part.shortfall else "least to spare, found"
    handles.append(Line2D([], [], **marker, markersize=6, label=cross))
    starts = "starts, projected" if found.problem.plant.n > 2 else "starts"
    marker = {"linestyle": "", "color": COLORS[0], "marker": "o"}
    handles.append(Line2D([], [], **marker, markersize=3, label=starts))
    return handles
