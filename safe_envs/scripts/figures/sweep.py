"""The picture of a sweep: safety rates over a swept setting, with confidence bands."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from safe_envs.agents.evaluation.spec import is_unfiltered
from safe_envs.agents.evaluation.statistics import rate_interval, repeated_interval
from safe_envs.scripts.figures.style import (
    COLORS,
    STYLE,
    UNFILTERED_DASHES,
    WARM,
    add_legend,
    add_title,
    labelled,
    look,
    mark_of,
    plain,
    save,
    scale_violations,
    symbol,
    wrapped,
)
from safe_envs.scripts.options.evaluation_options import DEFAULT_SIZE, width_of

_SEED = "seed"
_PROMISE = "promise:"
_MOST_PANELS = 12
_COLUMNS = {"single": 1, "double": 3}

_SHARE_OF_PANEL = 0.75
"""Of its width, without the labels at its side and some room between values."""

_LONGEST_LABEL = 2.0
"""In inches."""

Row = dict[str, Any]
Rate = tuple[float, float, float]
"""The share of safe episodes, and the ends of its interval."""


@dataclass(frozen=True)
class Layout:
    """The place of each swept setting.

    Attributes:
        x: across; None where nothing but seeds was swept, or violations are across.
        lines: a line for each of its values; None for a single one.
        panels: a panel for each combination of their values.
        returns: draw a point of mean return over violations for each value of `lines`, in place of
            safety rates.
    """

    x: str | None
    lines: str | None
    panels: tuple[str, ...]
    returns: bool = False

    @classmethod
    def of(
        cls,
        rows: Sequence[Row],
        swept: Sequence[str],
        x: str | None = None,
        lines: str | None = None,
    ) -> Layout:
        """Choose the places of settings that are not given.

        Promise filters at several p are swept to choose a p: unless a number was swept too, or a
        place is given, the mean return is drawn over the violations.

        Args:
            rows: of the cells.
            swept: names of the settings.
            x: setting across; by default a number with most values.
            lines: setting with a line for each value; by default the filter, or that with most.

        Returns:
            The layout, with all other settings as panels.
        """
        rest = [
            name
            for name in swept
            if name not in (x, lines) and (name != _SEED or _SEED in (x, lines))
        ]

        if x is lines is None and "filter" in rest:
            promises = {row["filter"] for row in rows if row["filter"].startswith(_PROMISE)}
            others = tuple(name for name in rest if name != "filter")
            if len(promises) > 1 and not any(_is_numeric(rows, name) for name in others):
                return cls(None, "filter", others, returns=True)

        def variety(name: str) -> tuple[bool, int]:
            return _is_numeric(rows, name), len(_values(rows, name))

        if x is None and rest:
            x = max(rest, key=variety)
            rest.remove(x)
        if lines is None and rest:
            lines = "filter" if "filter" in rest else max(rest, key=lambda name: variety(name)[1])
            rest.remove(lines)
        return cls(x, lines, tuple(rest))


def draw(
    rows: Sequence[Row],
    swept: Sequence[str],
    path: Path,
    size: str = DEFAULT_SIZE,
    x: str | None = None,
    lines: str | None = None,
) -> str:
    """Draw cells that are done, and write the picture whole or not at all.

    Args:
        rows: of `safe_envs.agents.sweeps.store.read`.
        swept: names of the settings.
        path: of the picture.
        size: "single" or "double", in columns of a paper.
        x: as for `Layout.of`.
        lines: likewise.

    Returns:
        A sentence that says where the picture is, and what it lacks.

    Raises:
        ConfigurationError: the picture cannot be written, or there is no such size.
    """
    done = [row for row in rows if row["error"] is None]
    if not done:
        return "There is no picture, since no cell is done."
    figure, hidden = figure_of(done, Layout.of(done, swept, x, lines), size)
    save(figure, path)
    return f"The picture: {path}" + (
        f" (without {hidden} of its panels, which are too many; sweep less, or choose --x and"
        " --lines)" * bool(hidden)
    )


def figure_of(rows: Sequence[Row], layout: Layout, size: str = DEFAULT_SIZE) -> tuple[Figure, int]:
    """Return the figure of cells that are done, and the number of panels without room.

    Args:
        rows: of the cells, as for `draw`.
        layout: places of the settings.
        size: as for `draw`.

    Raises:
        ConfigurationError: there is no such size.
    """
    width = width_of(size)
    combinations = list(dict.fromkeys(tuple(row[name] for name in layout.panels) for row in rows))
    shown = combinations[:_MOST_PANELS]
    columns = min(len(shown), _COLUMNS[size])
    count = math.ceil(len(shown) / columns)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, 0.9 + (2.6 if count == 1 else 2.1) * count))
        # Returns of different envs have nothing in common.
        grid = figure.subplots(count, columns, sharey=not layout.returns, squeeze=False)
        draw_panel = _draw_returns if layout.returns else _draw_panel
        what = "mean return" if layout.returns else labelled("safe", "%")
        for k, axes in enumerate(grid.flat):
            if k >= len(shown):
                axes.set_visible(False)
                continue
            chosen = [row for row in rows if tuple(row[name] for name in layout.panels) == shown[k]]
            draw_panel(axes, chosen, layout, rows)
            title = _title(layout.panels, shown[k])
            room = 0.85 * width / columns
            axes.set_title(wrapped(figure, title, mpl.rcParams["axes.titlesize"], room))
            axes.set_ylabel(what if k % columns == 0 else "")
        if layout.x is not None and not _is_numeric(rows, layout.x):
            _turn_labels(figure, grid, width / columns)
        handles, labels = grid.flat[0].get_legend_handles_labels()
        if labels:
            add_legend(figure, handles)
        drawn = (
            "mean return over violations, with their 95 % intervals"
            if layout.returns
            else "safety rate, with its pointwise 95 % band"
        )
        add_title(figure, f"{_common(rows)}{drawn}")
    return figure, len(combinations) - len(shown)


def _common(rows: Sequence[Row]) -> str:
    """Return the env of the cells, if all have the same."""
    titles = {json.loads(row["config"])["title"] for row in rows}
    return f"{plain(titles.pop(), 200)}: " if len(titles) == 1 else ""


def _draw_panel(axes: Axes, rows: Sequence[Row], layout: Layout, everything: Sequence[Row]) -> None:
    """Draw rates over the setting across: with bands if it is a number, otherwise with bars."""
    numeric = layout.x is not None and _is_numeric(everything, layout.x)
    places = [None] if layout.x is None else _values(everything, layout.x)
    position: dict[Any, Any] = {value: value if numeric else k for k, value in enumerate(places)}
    kinds = [None] if layout.lines is None else _values(everything, layout.lines)
    colors = (
        _shades(len(kinds)) if layout.lines and _is_numeric(everything, layout.lines) else COLORS
    )
    for k, kind in enumerate(kinds):
        of_kind = [row for row in rows if layout.lines is None or row[layout.lines] == kind]
        rates = {position[place]: _rate(_at(of_kind, layout.x, place)) for place in places}
        found = {at: rate for at, rate in rates.items() if rate is not None}
        unfiltered = isinstance(kind, str) and is_unfiltered(kind)
        style = {
            "color": WARM if unfiltered else colors[k % len(colors)],
            "linestyle": UNFILTERED_DASHES if unfiltered else look(k)["linestyle"],
            "marker": mark_of(k),
        }
        label = None if layout.lines is None else _text(kind)
        if layout.lines not in (None, "filter"):
            label = f"{symbol(layout.lines)} = {label}"
        # Bars are next to each other, since they would hide each other.
        shift = 0.0 if numeric else 0.12 * (k - (len(kinds) - 1) / 2)
        _draw_rates(axes, [at + shift for at in found], list(found.values()), numeric, style, label)
    axes.set_xlabel("" if layout.x is None else symbol(layout.x))
    if numeric and all(isinstance(place, int) for place in places):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if not numeric:
        axes.set_xticks(
            list(position.values()), ["" if layout.x is None else _text(place) for place in places]
        )
    axes.set_ylim(-3, 103)


def _draw_returns(
    axes: Axes, rows: Sequence[Row], layout: Layout, everything: Sequence[Row]
) -> None:
    """Draw a point of mean return over violations for each filter; cells of seeds are one point."""
    for k, kind in enumerate(_values(everything, str(layout.lines))):
        of_kind = _at(rows, layout.lines, kind)
        # What a panel lacks is in the legend all the same, which is that of the first panel.
        safe, low, high = _rate(of_kind) or (math.nan, math.nan, math.nan)
        returns = np.array([row["return_mean"] for row in of_kind] or [math.nan], dtype=float)
        weights = [row["episodes"] for row in of_kind] or [1]
        axes.errorbar(
            1.0 - safe,
            np.average(returns, weights=weights),
            xerr=[[high - safe], [safe - low]],
            color=WARM if is_unfiltered(kind) else COLORS[k % len(COLORS)],
            marker=mark_of(k),
            markersize=5,
            elinewidth=0.9,
            capsize=2,
            linestyle="none",
            label=_text(kind),
        )
    scale_violations(axes, [1.0 - end for row in rows for end in (row["ci_low"], row["ci_high"])])


def _turn_labels(figure: Figure, grid: np.ndarray, room: float) -> None:
    """Write the values across upwards where they do not fit next to each other."""
    shown = [axes for axes in grid.flat if axes.get_visible()]
    labels = [label for axes in shown for label in axes.get_xticklabels()]
    widest = max(label.get_window_extent().width for label in labels) / figure.dpi
    if widest <= _SHARE_OF_PANEL * room / max(len(axes.get_xticks()) for axes in shown):
        return
    size = mpl.rcParams["xtick.labelsize"]
    for axes in shown:
        texts = [label.get_text() for label in axes.get_xticklabels()]
        texts = [wrapped(figure, text, size, _LONGEST_LABEL) for text in texts]
        axes.set_xticks(axes.get_xticks(), texts, rotation=90)
    figure.set_figheight(figure.get_figheight() + len(grid) * min(widest, _LONGEST_LABEL))


def _shades(count: int) -> list[Any]:
    """Return colours in the order of numbers."""
    return [mpl.colormaps["viridis"](0.9 * k / max(count - 1, 1)) for k in range(count)]


def _draw_rates(
    axes: Axes,
    at: Sequence[float],
    rates: Sequence[Rate],
    band: bool,
    style: dict[str, Any],
    label: str | None,
) -> None:
    """Draw rates with their intervals, as a band or as bars."""
    rate, low, high = 100 * np.array(rates).reshape(-1, 3).T
    if band:
        axes.fill_between(at, low, high, color=style["color"], alpha=0.2, linewidth=0)
        axes.plot(at, rate, **style, markersize=3, label=label)
    else:
        style = {**style, "linestyle": "none", "markersize": 3, "capsize": 2, "elinewidth": 0.9}
        axes.errorbar(at, rate, yerr=[rate - low, high - rate], label=label, **style)


def _at(rows: Iterable[Row], name: str | None, value: Any) -> list[Row]:
    return [row for row in rows if name is None or row[name] == value]


def _rate(rows: Sequence[Row]) -> Rate | None:
    """Return the rate of cells that differ in their seeds only; None without cells."""
    # Their episodes are independent, unless the filter was retrained for each seed: then the
    # interval is over models and episodes.
    if not rows:
        return None
    if len(rows) == 1:
        return rows[0]["safety_rate"], rows[0]["ci_low"], rows[0]["ci_high"]
    safe, episodes = sum(row["safe"] for row in rows), sum(row["episodes"] for row in rows)
    of_episodes = rate_interval(safe, episodes)
    if len({_learned(row) for row in rows}) == 1:
        return safe / episodes, *of_episodes
    return safe / episodes, *repeated_interval(
        [row["safety_rate"] for row in rows], of_episodes, 0.95, (0.0, 1.0)
    )


def _learned(row: Row) -> tuple[str, ...]:
    """Return checksums of the models of a filter; none if it learned nothing."""
    return tuple((json.loads(row["row"])["learning"] or {}).get("sha256", ()))


def _values(rows: Sequence[Row], name: str) -> list[Any]:
    """Return the values of a setting in the order of the cells, numbers by their size."""
    values = list(dict.fromkeys(row[name] for row in rows))
    return sorted(values) if _is_numeric(rows, name) else values


def _is_numeric(rows: Sequence[Row], name: str) -> bool:
    return all(
        isinstance(row[name], int | float) and not isinstance(row[name], bool) for row in rows
    )


def _title(names: Sequence[str], values: Sequence[Any]) -> str:
    return ", ".join(
        f"{symbol(name)} = {_text(value)}" for name, value in zip(names, values, strict=True)
    )


def _text(value: Any) -> str:
    if value is None:
        return "env's own"
    return f"{value:g}" if isinstance(value, float) else plain(str(value))
