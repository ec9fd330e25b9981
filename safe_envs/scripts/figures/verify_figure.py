"""The picture of a verification: where no action meets the conditions, h, and the boundaries, over
a plane of the state."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from safe_envs.atomic_io import write_atomically
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.figures.evaluation_figure import COLORS, QUIET, STYLE, UNSAFE
from safe_envs.scripts.reports.evaluation_report import describe_system
from safe_envs.wrappers import spec_of
from safe_envs.wrappers.verification.feasibility import Verification
from safe_envs.wrappers.verification.formulas import Formulas
from safe_envs.wrappers.verification.safe_set import sample

_INFEASIBLE = "#D55E00"
_GRID = 300
_COARSE = 90
_OTHERS_LOG2 = 7
_SHOWN_STARTS = 200
_LISTED = 3
_NEAREST = 500
_LEVELS = (0.2, 0.4, 0.6, 0.8)

Evaluate = Callable[[np.ndarray], np.ndarray]


def draw(title: str, found: Verification, starts: np.ndarray, path: Path) -> None:
    """Draw a verification, and write the picture whole or not at all.

    A plane is drawn with the other states as at the worst state and, beside it, with all values of
    the others at once.

    Args:
        title: what the env is called.
        found: what to draw.
        starts: to be marked, shape (B, n).
        path: of the picture; its suffix is the format.
    """
    formulas = found.formulas
    problem = formulas.problem
    worst = (found.invariant_set or found.safe_set).worst
    several = problem.plant.n > 2
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.0, 5.6) if several else (7.4, 5.6))
        panels = figure.subplots(1, 2 if several else 1, squeeze=False)[0]
        if problem.plant.n == 1:
            _draw_line(panels[0], found, worst, starts)
        else:
            _draw_slice(panels[0], found, worst, starts)
        if several:
            _draw_shares(figure, panels[1], found, worst, starts)
        figure.legend(handles=_legend(found), loc="outside lower center", ncols=6 if several else 3)
        figure.suptitle(
            f"{title}, {spec_of(formulas.conditions)}\n{describe_system(problem)}", fontsize=11
        )
        write_atomically(path, lambda part: figure.savefig(part, dpi=150))


def _legend(found: Verification) -> list[Patch | Line2D]:
    formulas, missed = (
        found.formulas,
        (found.safe_set.shortfall or (found.invariant_set or found.safe_set).shortfall) > 0.0,
    )
    degree = max(stage.stop - stage.start for stage in formulas.stages)
    several = formulas.problem.plant.n > 2
    handles: list[Patch | Line2D] = (
        [Patch(color=_INFEASIBLE, alpha=0.6, label="no action meets the condition")]
        if missed
        else []
    )
    handles += [
        Patch(color=UNSAFE, alpha=0.5, label="unsafe"),
        Line2D([], [], color="black", linewidth=1.4, label="h = 0"),
    ]
    handles += [
        Line2D([], [], color=COLORS[j - 1], linestyle="--", label=f"b_{j} = 0")
        for j in range(1, degree)
    ]
    cross = "worst state" if (found.invariant_set or found.safe_set).shortfall else "least to spare"
    handles.append(
        Line2D(
            [],
            [],
            color=_INFEASIBLE,
            marker="X",
            markeredgecolor="black",
            linestyle="",
            markersize=9,
            label=cross,
        )
    )
    label = "starts, projected" if several else "starts"
    handles.append(
        Line2D([], [], color=COLORS[0], marker="o", linestyle="", markersize=4, label=label)
    )
    return handles


def _plane(problem: SafetyProblem) -> tuple[int, int]:
    names = [s.symbol.name for s in problem.states]
    across, up = problem.plane or names[:2]
    return names.index(across), names.index(up)


def _window(
    found: Verification, axes: tuple[int, ...], starts: np.ndarray, worst: np.ndarray
) -> np.ndarray:
    """Limits of the axes, shape (len(axes), 2): C within the workspace with some room, or where it
    has no end what happens in it."""
    region, formulas = found.region, found.formulas
    points = region.draw(14, np.random.default_rng(0))
    inside = points[formulas.barrier_level(points) >= 0.0]
    if not len(inside):
        return np.stack([region.low, region.high], axis=1)[list(axes)]
    shown = (
        inside
        if not found.beyond
        else np.concatenate([starts, worst[None], _near_edges(found, points)])
    )
    low, high = shown.min(axis=0), shown.max(axis=0)
    room = 0.12 * (high - low) + 1e-3 * (region.high - region.low)
    return np.stack(
        [np.maximum(region.low, low - room), np.minimum(region.high, high + room)], axis=1
    )[list(axes)]


def _near_edges(found: Verification, points: np.ndarray) -> np.ndarray:
    """Those of the points that are nearest to the boundary of C, in the middle of the others."""
    h = abs(found.formulas.barrier_level(points))
    return points[np.argsort(h)[: len(points) // _NEAREST]]


def _draw_slice(axes: Axes, found: Verification, worst: np.ndarray, starts: np.ndarray) -> None:
    formulas, problem = found.formulas, found.formulas.problem
    across, up = _plane(problem)
    horizontal, vertical = np.meshgrid(
        *[
            np.linspace(low, high, _GRID)
            for low, high in _window(found, (across, up), starts, worst)
        ]
    )
    x = np.tile(worst, (horizontal.size, 1))
    x[:, across], x[:, up] = horizontal.ravel(), vertical.ravel()
    chain = formulas.chain(x)
    h = chain[:, formulas.barriers].min(axis=1)
    missed = _missed(formulas, x, formulas.barrier_level)

    def shaped(values: np.ndarray) -> np.ndarray:
        return values.reshape(horizontal.shape)

    grid = (horizontal, vertical)
    axes.contourf(
        *grid, shaped(missed), levels=[0.5, 2.0], colors=[_INFEASIBLE], alpha=0.6, zorder=1
    )
    axes.contourf(*grid, shaped(h), levels=[-np.inf, 0.0], colors=[UNSAFE], alpha=0.5, zorder=0)
    axes.contour(*grid, shaped(h), levels=[0.0], colors="black", linewidths=1.4, zorder=3)
    if np.nanmax(h) > 1e-3 * min(b.deepest_h for b in found.barriers) or found.beyond:
        # Quantiles, since even steps of a steep function crowd together at one end.
        inner = np.unique(np.quantile(h[h > 0.0], _LEVELS))
        lines = axes.contour(*grid, shaped(h), levels=inner, colors=QUIET, linewidths=0.5, zorder=2)
        axes.clabel(lines, fontsize=7, fmt="%.3g")
    for stage in formulas.stages:
        for j in range(stage.start + 1, stage.stop):
            style = {"colors": COLORS[j - stage.start - 1], "linestyles": "--", "linewidths": 1.2}
            axes.contour(
                *grid,
                np.where(shaped(h) >= 0.0, shaped(chain[:, j]), np.nan),
                levels=[0.0],
                zorder=3,
                **style,
            )
    _mark(axes, problem, (across, up), worst, starts)
    others = [
        f"{s.symbol} = {worst[i] + 0.0:.3g}"
        for i, s in enumerate(problem.states)
        if i not in (across, up)
    ]
    listing = ", ".join(others) if len(others) < _LISTED else "other states"
    axes.set_title(f"Contours of h; {listing} as at the worst state" if others else "Contours of h")


def _draw_shares(
    figure: Figure, axes: Axes, found: Verification, worst: np.ndarray, starts: np.ndarray
) -> None:
    """For which part of the other states, within the intersection of the C_j, no action meets the
    conditions."""
    formulas, problem = found.formulas, found.formulas.problem
    plane = _plane(problem)
    # Several conditions take a solver: a coarser picture of a tenth of the states.
    coarser = len(formulas.stages) > 1
    ticks = [
        np.linspace(low, high, _COARSE // 2 if coarser else _COARSE)
        for low, high in _window(found, plane, starts, worst)
    ]
    horizontal, vertical = np.meshgrid(*ticks)
    others = _others(found, 2 ** (_OTHERS_LOG2 - 2 * coarser))
    inside, missed = np.zeros(horizontal.size), np.zeros(horizontal.size)
    for values in others:
        x = np.tile(values, (horizontal.size, 1))
        x[:, plane[0]], x[:, plane[1]] = horizontal.ravel(), vertical.ravel()
        inside += formulas.invariant_level(x) >= 0.0
        missed += _missed(formulas, x, formulas.invariant_level) == 1.0
    with np.errstate(invalid="ignore"):
        share = np.where(inside > 0, 100.0 * missed / inside, np.nan).reshape(horizontal.shape)
    top = max(float(np.nanmax(share)) if np.isfinite(share).any() else 0.0, 1.0)
    colors = LinearSegmentedColormap.from_list("infeasible", ["#FFFFFF", _INFEASIBLE])
    image = axes.pcolormesh(
        horizontal, vertical, share, cmap=colors, vmin=0.0, vmax=top, rasterized=True
    )
    axes.set_facecolor(to_rgba(UNSAFE, 0.5))
    where = "C" if formulas.first_order else "the intersection of the C_j"
    rest = [str(s.symbol) for i, s in enumerate(problem.states) if i not in plane]
    figure.colorbar(image, ax=axes, label=f"part of {where} where no action does (%)", shrink=0.9)
    _label(axes, problem, plane)
    axes.set_title(f"Over all {rest[0] if len(rest) == 1 else 'values of the other states'}")


def _others(found: Verification, count: int) -> np.ndarray:
    """States whose coordinates outside the plane are tried: evenly spread ones, or of the set where
    these would rarely be in it."""
    rng = np.random.default_rng(0)
    if found.formulas.problem.plant.n == 3 or found.invariant_set is None:
        return found.region.draw(count.bit_length() - 1, rng)
    points = sample(
        "the intersection of the C_j", found.formulas.invariant_level, found.region, count, rng
    ).points
    return points[rng.choice(len(points), count, replace=False)]


def _missed(formulas: Formulas, x: np.ndarray, level: Evaluate) -> np.ndarray:
    """1 where a condition is missed and 0 where none is, for states (B, n) with level >= 0; NaN
    elsewhere."""
    found, inside = np.full(len(x), np.nan), level(x) >= 0.0
    if inside.any():
        found[inside] = formulas.shortfall(x[inside]) > 0.0
    return found


def _mark(
    axes: Axes,
    problem: SafetyProblem,
    plane: tuple[int, int],
    worst: np.ndarray,
    starts: np.ndarray,
) -> None:
    shown = starts[:_SHOWN_STARTS]
    limits = axes.get_xlim(), axes.get_ylim()
    axes.plot(
        shown[:, plane[0]],
        shown[:, plane[1]],
        "o",
        color=COLORS[0],
        markersize=2.5 if len(shown) > 1 else 6,
        alpha=0.7,
        zorder=4,
    )
    axes.plot(
        worst[plane[0]],
        worst[plane[1]],
        "X",
        color=_INFEASIBLE,
        markeredgecolor="black",
        markersize=10,
        zorder=5,
        clip_on=False,
    )
    axes.set(xlim=limits[0], ylim=limits[1])
    _label(axes, problem, plane)


def _label(axes: Axes, problem: SafetyProblem, plane: tuple[int, int]) -> None:
    across, up = [problem.states[i] for i in plane]
    axes.set(xlabel=_name(across.symbol.name, across.unit), ylabel=_name(up.symbol.name, up.unit))
    if across.unit == up.unit:
        axes.set_aspect("equal")


def _name(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _draw_line(axes: Axes, found: Verification, worst: np.ndarray, starts: np.ndarray) -> None:
    """H and the chain over the only state."""
    formulas, state = found.formulas, found.formulas.problem.states[0]
    (low, high), *_ = _window(found, (0,), starts, worst)
    x = np.linspace(low, high, 1000)[:, None]
    chain = formulas.chain(x)
    axes.plot(x[:, 0], chain[:, 0], color="black", linewidth=1.4)
    for j in range(1, chain.shape[1]):
        axes.plot(x[:, 0], chain[:, j], "--", color=COLORS[j - 1])
    axes.axhline(0.0, color="black", linewidth=0.6)
    transform = axes.get_xaxis_transform()
    axes.fill_between(
        x[:, 0],
        0,
        1,
        where=list(chain[:, 0] < 0.0),
        color=UNSAFE,
        alpha=0.5,
        linewidth=0,
        transform=transform,
    )
    missed = _missed(formulas, x, formulas.barrier_level) == 1.0
    axes.fill_between(
        x[:, 0],
        0,
        1,
        where=list(missed),
        color=_INFEASIBLE,
        alpha=0.6,
        linewidth=0,
        transform=transform,
    )
    shown = starts[:_SHOWN_STARTS]
    axes.plot(
        shown[:, 0], formulas.chain(shown)[:, 0], "o", color=COLORS[0], markersize=2.5, alpha=0.7
    )
    axes.plot(
        worst[0], 0.0, "X", color=_INFEASIBLE, markeredgecolor="black", markersize=10, zorder=5
    )
    axes.set(
        xlim=(low, high),
        xlabel=_name(state.symbol.name, state.unit),
        ylabel="h",
        title="h" + ", and where no action meets the condition" * bool(missed.any()),
    )
