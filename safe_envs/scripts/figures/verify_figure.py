"""The picture of a verification: where no action meets the conditions, h, and the boundaries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.contour import ContourSet
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from safe_envs.agents.evaluation.bound_check import starts_of
from safe_envs.agents.evaluation.setting_text import describe_system
from safe_envs.scripts.figures.contour_labels import write_levels
from safe_envs.scripts.figures.labels import mathematics, plain
from safe_envs.scripts.figures.saving import StyledFigure, finished
from safe_envs.scripts.figures.style import (
    COLORS,
    DASHES,
    QUIET,
    STYLE,
    UNSAFE,
    add_legend,
    add_title,
)
from safe_envs.scripts.figures.verify_panel import INFEASIBLE, DrawnVerification, draw_line
from safe_envs.scripts.figures.verify_plane import draw_shares, draw_slice
from safe_envs.scripts.options.figure_options import DEFAULT_SIZE, width_of
from safe_envs.wrappers import spec_of
from safe_envs.wrappers.verification.feasibility import Verification


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
    problem = found.problem
    marked = starts_of(problem) if starts is None else starts
    drawn = DrawnVerification(found, marked, title or problem.name)
    return finished(figure_of(drawn, size), out)


def figure_of(answer: DrawnVerification, size: str = DEFAULT_SIZE) -> StyledFigure:
    """Return the figure of a verification.

    Args:
        answer: to draw.
        size: as for `plot_verification`.

    Raises:
        ConfigurationError: there is no such size.
    """
    problem, width = answer.verification.problem, width_of(size)
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
            draw_line(panels[0], answer)
        else:
            lines = draw_slice(panels[0], answer)
        if several:
            draw_shares(figure, panels[1], answer)
        add_legend(figure, _legend(answer, lines))
        filter_text = spec_of(answer.verification.formulas.conditions)
        title = plain(f"{answer.title}, {filter_text}", 200)
        add_title(figure, f"{title}\n{mathematics(describe_system(problem))}")
        if lines is not None:
            write_levels(figure, panels[0], lines)
    return figure


def _legend(answer: DrawnVerification, lines: ContourSet | None) -> list[Patch | Line2D]:
    found = answer.verification
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
