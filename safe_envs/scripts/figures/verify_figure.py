"""The picture of a verification: where no action meets the conditions, h, and the boundaries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from safe_envs.atomic_io import write_atomically
from safe_envs.scripts.figures.style import COLORS, STYLE, UNSAFE
from safe_envs.scripts.figures.verify_panel import INFEASIBLE, draw_line
from safe_envs.scripts.figures.verify_plane import draw_shares, draw_slice
from safe_envs.scripts.reports.evaluation_report import describe_system
from safe_envs.scripts.reports.verify_answer import VerifyAnswer


def draw(answer: VerifyAnswer, path: Path) -> None:
    """Draw a verification, and write the picture whole or not at all.

    A plane is drawn with the other states as at the worst state, and next to it with all values of
    the others at once.

    Args:
        answer: to draw.
        path: of the picture; its suffix is the format.
    """
    problem = answer.problem
    several = problem.plant.n > 2
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(12.0, 5.6) if several else (7.4, 5.6))
        panels = figure.subplots(1, 2 if several else 1, squeeze=False)[0]
        if problem.plant.n == 1:
            draw_line(panels[0], answer)
        else:
            draw_slice(panels[0], answer)
        if several:
            draw_shares(figure, panels[1], answer)
        columns = 6 if several else 3
        figure.legend(handles=_legend(answer), loc="outside lower center", ncols=columns)
        title = f"{answer.title}, {answer.filter_text}\n{describe_system(problem)}"
        figure.suptitle(title, fontsize=11)
        write_atomically(path, lambda part: figure.savefig(part, dpi=150))


def _legend(answer: VerifyAnswer) -> list[Patch | Line2D]:
    found = answer.verification
    handles: list[Patch | Line2D] = []
    if found.safe_set.shortfall > 0.0 or answer.part.shortfall > 0.0:
        handles.append(Patch(color=INFEASIBLE, alpha=0.6, label="no action meets the condition"))
    handles.append(Patch(color=UNSAFE, alpha=0.5, label="unsafe"))
    handles.append(Line2D([], [], color="black", linewidth=1.4, label="h = 0"))
    degree = max(stage.stop - stage.start for stage in found.formulas.stages)
    handles += [
        Line2D([], [], color=COLORS[j - 1], linestyle="--", label=f"b_{j} = 0")
        for j in range(1, degree)
    ]
    marker: Any = {"linestyle": "", "color": INFEASIBLE, "marker": "X", "markeredgecolor": "black"}
    cross = "worst state" if answer.part.shortfall else "least to spare"
    handles.append(Line2D([], [], **marker, markersize=9, label=cross))
    starts = "starts, projected" if answer.problem.plant.n > 2 else "starts"
    marker = {"linestyle": "", "color": COLORS[0], "marker": "o"}
    handles.append(Line2D([], [], **marker, markersize=4, label=starts))
    return handles
