"""Figures 4.2 and 4.3: the safety of a Dubins vehicle with noise in a disk."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from safe_envs.scripts.figures.labels import labelled, quantity, unit_text
from safe_envs.scripts.figures.style import COLORS, HALO, QUIET, SMALL, UNSAFE, add_legend
from safe_envs.scripts.reproduce.chapter_4.dubins_runs import ALPHAS, FILTERS, RADIUS
from safe_envs.scripts.reproduce.framework.artefact import Findings
from safe_envs.scripts.reproduce.framework.drawing import draw_interval

_COLOR = dict(zip(FILTERS, COLORS, strict=False))
_LABEL = {
    "SCBF": "SCBF",
    **{name: rf"SZCBF, $\alpha$ = {a:g}, {b:g}" for name, (a, b) in ALPHAS.items()},
}


def draw_noises(figure: Figure, outcome: Findings) -> None:
    """Draw safety against noise, and over time at the largest noise.

    Full lines are of all starts, dashed ones of those with A h > 0.

    Args:
        figure: empty.
        outcome: of the artefact.
    """
    left, right = figure.subplots(1, 2, sharey=True)
    data, dots = outcome.data, {"marker": "o", "markersize": 3}
    for (kind, rates), dashes in zip(data["rates"].items(), ("-", "--"), strict=True):
        for name, bands in rates.items():
            color, label = _COLOR[name], _LABEL[name] if dashes == "-" else None
            ends = np.array(bands).T
            draw_interval(left, data["noises"], ends, color, 0.15, dashes, label=label, **dots)
            curve = data["curves"][kind][name]
            ends = [curve[key] for key in ("low", "rate", "high")]
            draw_interval(right, curve["time"], ends, color, 0.15, dashes)
        label = kind.replace("A h > 0", r"$\mathcal{A} h > 0$")
        left.plot([], [], dashes, color="black", label=label)
    further = np.array(data["further"]).T
    draw_interval(left, data["beyond"], further, _COLOR["SCBF"], 0.15, **dots)
    cross: dict[str, Any] = {"marker": "x", "markersize": 4}
    for name, rates in data["printed"].items():
        left.plot(data["levels"], rates, ":", color=_COLOR[name], **cross)
    left.plot([], [], ":", color="black", label="printed $h_2$, all starts", **cross)
    for horizon in data["horizons"]:
        right.axvline(horizon, color=UNSAFE, linewidth=0.8, zorder=0)
    left.set(
        xlabel=labelled(r"noise $\sigma_1 = \sigma_2$", "m/sqrt(s)"),
        ylabel=labelled("safe", "%"),
        ylim=(-3, 103),
        title=f"(a) $T$ = {data['horizon']:g} s",
    )
    title = rf"(b) $\sigma$ = {max(data['levels']):g} {unit_text('m/sqrt(s)')}"
    right.set(xlabel=labelled("horizon $T$", "s"), xlim=(0, max(data["horizons"])), title=title)
    add_legend(figure, left.get_legend_handles_labels()[0])


def draw_points(figure: Figure, outcome: Findings) -> None:
    """Draw the starts and the safety from each, hollow at the long horizon.

    Args:
        figure: empty.
        outcome: of the artefact.
    """
    left, right = figure.subplots(1, 2, width_ratios=(1.7, 1))
    data = outcome.data
    index = np.arange(1, len(data["starts"]) + 1)
    short, long = data["horizons"]
    for i, name in enumerate(FILTERS):
        style: Any = {"fmt": "os^"[i], "color": _COLOR[name], "markersize": 3.5, "linewidth": 1}
        for horizon, face, label in ((short, _COLOR[name], _LABEL[name]), (long, "white", None)):
            low, rate, high = np.array(data["rates"][name][f"{horizon:g}"]).T
            left.errorbar(
                index + 0.22 * (i - 1),
                rate,
                (rate - low, high - rate),
                markerfacecolor=face,
                label=label,
                **style,
            )
    product = np.array(data["product"])
    black: dict[str, Any] = {"color": "black", "label": "product of Thm. 4.2.10"}
    left.plot(index[product > 0], 100 * product[product > 0], "_", markersize=10, **black)
    for horizon, face in ((short, "black"), (long, "white")):
        black = {"color": "black", "label": f"$T$ = {horizon:g} s", "markerfacecolor": face}
        left.plot([], [], "o", markersize=4.5, **black)
    left.set(
        xlabel="start", ylabel=labelled("safe", "%"), xticks=index, ylim=(-3, 103), title="(a)"
    )
    _draw_starts(right, np.array(data["starts"]))
    handles, labels = left.get_legend_handles_labels()
    ordered = sorted(labels, key=lambda label: label not in _LABEL.values())
    add_legend(figure, [handles[labels.index(label)] for label in ordered])


def _draw_starts(axes: Axes, starts: np.ndarray) -> None:
    """Draw the disk with the starts and their headings, each number at its arrow."""
    axes.set_facecolor(to_rgba(UNSAFE, 0.35))
    axes.add_patch(Circle((0, 0), RADIUS, facecolor="white", edgecolor="black", linewidth=1.2))
    x, y = starts[:, :2].T
    along, up = np.cos(starts[:, 2]), np.sin(starts[:, 2])
    axes.quiver(x, y, along, up, color=QUIET, scale=9, width=0.009)
    for i, place in enumerate(_places(starts), 1):
        style: Any = {"ha": "center", "va": "center", "fontsize": SMALL, "path_effects": HALO}
        axes.text(place[0], place[1], str(i), **style)
    limits = (-1.12 * RADIUS, 1.12 * RADIUS)
    axes.set(xlim=limits, ylim=limits, aspect="equal", title="(b)")
    axes.set(xlabel=quantity("x", "m"), ylabel=quantity("y", "m"))


def _places(starts: np.ndarray) -> list[np.ndarray]:
    """Return where the numbers of starts are written: behind the arrow, or where there is room.

    Args:
        starts: x, y and heading, shape (k, 3).
    """
    points = starts[:, :2]
    along = np.stack([np.cos(starts[:, 2]), np.sin(starts[:, 2])], axis=1)
    aside = np.stack([-along[:, 1], along[:, 0]], axis=1)
    found: list[np.ndarray] = []
    for i, at in enumerate(points):
        places = [at - 0.28 * along[i], at + 0.28 * aside[i], at - 0.28 * aside[i]]
        taken = np.array([*np.delete(points, i, axis=0), *found])
        room = [float(np.hypot(*(taken - place).T).min(initial=np.inf)) for place in places]
        found.append(places[0] if room[0] > 0.35 else places[int(np.argmax(room))])
    return found
