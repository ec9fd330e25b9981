"""What the panels of a verification share; and the panel of a problem with a single state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.figures.labels import quantity
from safe_envs.scripts.figures.style import COLORS, DASHES, UNSAFE
from safe_envs.wrappers.verification.feasibility import Verification
from safe_envs.wrappers.verification.formulas import Formulas

INFEASIBLE = "#D55E00"
_SHOWN_STARTS = 200
_NEAREST = 500


@dataclass(frozen=True, eq=False)
class DrawnVerification:
    """A verification with what is drawn with it.

    Attributes:
        verification: where the conditions can be met.
        starts: to mark, shape (B, n).
        title: name of the env.
    """

    verification: Verification
    starts: np.ndarray
    title: str


def window(answer: DrawnVerification, indices: Sequence[int]) -> np.ndarray:
    """Return limits that show C within the workspace, or what happens in it if it has no end.

    Args:
        answer: to draw.
        indices: of the states along the axes.

    Returns:
        Low and high limits, shape (len(indices), 2).
    """
    found = answer.verification
    region, level = found.region, found.formulas.barrier_level
    points = region.draw(14, np.random.default_rng(0))
    inside = points[level(points) >= 0.0]
    if not len(inside):
        return np.stack([region.low, region.high], axis=1)[list(indices)]
    if found.beyond:
        nearest = points[np.argsort(abs(level(points)))[: len(points) // _NEAREST]]
        inside = np.concatenate([answer.starts, found.part.worst[None], nearest])
    low, high = inside.min(axis=0), inside.max(axis=0)
    room = 0.12 * (high - low) + 1e-3 * (region.high - region.low)
    low, high = np.maximum(region.low, low - room), np.minimum(region.high, high + room)
    return np.stack([low, high], axis=1)[list(indices)]


def infeasible(
    formulas: Formulas, x: np.ndarray, level: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return at which states no action meets the conditions.

    Args:
        formulas: of the conditions.
        x: states, shape (B, n).
        level: >= 0 in the set that is looked at.

    Returns:
        1 where a condition is violated, 0 where none is, NaN outside the set; shape (B,).
    """
    found, inside = np.full(len(x), np.nan), level(x) >= 0.0
    if inside.any():
        found[inside] = formulas.shortfall(x[inside]) > 0.0
    return found


def mark_states(axes: Axes, starts: tuple[np.ndarray, np.ndarray], worst: Sequence[float]) -> None:
    """Mark the starts and the worst state.

    Args:
        axes: to draw on; their limits stay.
        starts: coordinates along both axes, shape (B,) each.
        worst: coordinates along both axes.
    """
    limits = {"xlim": axes.get_xlim(), "ylim": axes.get_ylim()}
    shown = [coordinates[:_SHOWN_STARTS] for coordinates in starts]
    size = 1.8 if len(shown[0]) > 1 else 4
    axes.plot(*shown, "o", color=COLORS[0], markersize=size, alpha=0.7, zorder=4)
    cross = {"color": INFEASIBLE, "markeredgecolor": "black", "markersize": 7}
    axes.plot(*worst, "X", **cross, zorder=5, clip_on=False)
    axes.set(**limits)


def axis_label(problem: SafetyProblem, i: int) -> str:
    """Return the label of an axis along a state.

    Args:
        problem: with the states.
        i: index of the state.

    Returns:
        The name with the unit.
    """
    return quantity(problem.states[i].symbol.name, problem.states[i].unit)


def draw_line(axes: Axes, answer: DrawnVerification) -> None:
    """Draw h and the chain over the only state of a problem.

    Args:
        axes: to draw on.
        answer: to draw.
    """
    formulas, starts = answer.verification.formulas, answer.starts
    (low, high), *_ = window(answer, [0])
    x = np.linspace(low, high, 1000)[:, None]
    chain = formulas.chain(x)
    axes.plot(x[:, 0], chain[:, 0], color="black", linewidth=1.1)
    for j in range(1, chain.shape[1]):
        axes.plot(x[:, 0], chain[:, j], color=COLORS[j - 1], linestyle=DASHES[j])
    axes.axhline(0.0, color="black", linewidth=0.6)
    violated = infeasible(formulas, x, formulas.barrier_level) == 1.0
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
    mark_states(axes, (starts[:, 0], heights), (answer.verification.part.worst[0], 0.0))
    title = "$h$" + ", and where no action meets the condition" * bool(violated.any())
    axes.set(xlabel=axis_label(answer.verification.problem, 0), ylabel="$h$", title=title)
