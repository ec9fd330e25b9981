"""The picture of an identification: learned functions against the truth, and posterior noise."""

from __future__ import annotations

import math
import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from safe_envs.filters.learning.models.distributions import Diffusion, sigma_samples
from safe_envs.filters.learning.models.posterior import Posterior
from safe_envs.scripts.figures.style import (
    COLORS,
    STYLE,
    WARM,
    StyledFigure,
    add_legend,
    add_title,
    finished,
    labelled,
    mathematics,
    plain,
    symbol,
    unit_text,
    wrapped,
)
from safe_envs.scripts.options.evaluation_options import DEFAULT_SIZE, width_of
from safe_envs.scripts.reports.identify import Function, IdentifyAnswer
from safe_envs.scripts.reports.tables import relative_text

_TRUTH = WARM
_MOST = 12
_MOST_LEVELS = 4
_ACROSS = {"single": 2, "double": 4}
_SAMPLES = 20_000
_CONSTANT = 1e-9
_AROUND = 0.1
_HIGHEST = 3.0
"""In inches, of a panel."""

_TITLE = 0.2
"""In inches, of a line of a title."""

_TINY, _HUGE = 0.02, 2e4

_OF = re.compile(r"(\w+)([\[(])([\w, ]+)[\])]")

_ESTIMATE_HANDLE = Line2D(
    [], [], color=COLORS[0], marker="o", linestyle="", markersize=3, label="estimate at a state"
)
_COUNTS_HANDLE = Patch(color=COLORS[0], alpha=0.6, label="estimates at all states")
_SAMPLES_HANDLE = Patch(color=COLORS[1], alpha=0.6, label="samples of the posterior")
_TRUTH_HANDLE = Line2D([], [], color=_TRUTH, linewidth=1.1, label="truth")


def plot_identification(
    found: IdentifyAnswer, out: Path | str | None = None, *, size: str = DEFAULT_SIZE
) -> StyledFigure:
    """Draw an identification.

    Args:
        found: what to draw; of many functions those of the largest truth are shown.
        out: file of the picture; its suffix is the format: .png, .pdf or .svg.
        size: "single" or "double", in columns of a paper.

    Returns:
        The figure, which a notebook shows.

    Raises:
        ConfigurationError: The file cannot be written, or there is no such size.
    """
    width = width_of(size)
    levels = _levels(found)
    rest = [f for f in found.compared if not f.vanishes and f.name not in levels]
    shown = sorted(rest, key=lambda function: (-function.size, -function.error))[
        : _MOST - len(levels)
    ]
    count = len(shown) + len(levels)
    down = max(math.ceil(count / _ACROSS[size]), 1)
    across = max(math.ceil(count / down), 1)
    with mpl.rc_context(STYLE):
        side = min(width / across, _HIGHEST)
        figure = StyledFigure(figsize=(width, 1.0 + side * down))
        axes = list(figure.subplots(down, across, squeeze=False).flat)
        tallest = 0
        handles: dict[Line2D | Patch, None] = {}
        for panel, function in zip(axes, shown, strict=False):
            handles |= dict.fromkeys([_draw_function(panel, function), _TRUTH_HANDLE])
            # In as many lines as it takes.
            title = wrapped(figure, panel.get_title(), mpl.rcParams["axes.titlesize"], side - 0.1)
            panel.set_title(title)
            tallest = max(tallest, title.count("\n") - 1)
        for panel, (index, function) in zip(axes[len(shown) :], levels.values(), strict=False):
            _draw_level(panel, found, index, function)
            handles |= dict.fromkeys([_SAMPLES_HANDLE, _TRUTH_HANDLE])
        for panel in axes[count:]:
            panel.axis("off")
        if not count:
            axes[0].text(0.5, 0.5, "There is nothing to compare.", ha="center", va="center")
        figure.set_figheight(1.0 + (side + _TITLE * tallest) * down)
        if handles:
            add_legend(figure, list(handles))
        left = (
            f", the largest {len(shown)} of {len(rest)} functions" if len(shown) < len(rest) else ""
        )
        title = plain(f"{found.title}, {found.learned.method}{left}", 200)
        add_title(figure, f"{title}\n{mathematics(found.setup)}")
    return finished(figure, out)


def _levels(found: IdentifyAnswer) -> dict[str, tuple[int, Function]]:
    """Return the constant variances to show as posteriors of sigma, by name, with their state."""
    diffusion = _constant_noise(found)
    named = {function.name: function for function in found.compared}
    if diffusion is None or not named:
        return {}
    names = [f"covariance[{s}, {s}]" for s in found.problem.plant.states]
    noisy = [
        (i, named[name])
        for i, name in enumerate(names)
        if diffusion.squares[i] > 0 and _constant(named[name].truth)
    ]
    return {function.name: (i, function) for i, function in noisy[:_MOST_LEVELS]}


def _constant_noise(found: IdentifyAnswer) -> Diffusion | None:
    """Return the learned noise if it is constant."""
    learned = found.learned
    return (
        learned.diffusion
        if isinstance(learned, Posterior) and learned.diffusion.features is None
        else None
    )


def _draw_function(axes: Axes, function: Function) -> Line2D | Patch:
    """Draw estimates against a truth that varies, or a histogram for one that does not."""
    off = "truth 0" if function.relative is None else f"error {relative_text(function.relative)}"
    lines = [function_symbol(function.name), off]
    power = _power(np.concatenate([function.truth, function.estimate]))
    truth, estimate = function.truth / 10.0**power, function.estimate / 10.0**power
    alone = _constant(truth) and _constant(estimate)
    if _constant(truth):
        lines += [_range("truth", function.truth), _range("estimate", function.estimate)]
    axes.set_title("\n".join(lines))
    if _constant(truth) and not alone:
        axes.hist(estimate, bins=30, color=COLORS[0], alpha=0.6)
        axes.axvline(truth[0], color=_TRUTH, linewidth=1.1)
        axes.set(
            xlabel=_label("estimate", function.unit, power),
            ylabel="states",
        )
        _tidy(axes)
        return _COUNTS_HANDLE
    both = np.concatenate([truth, estimate])
    # Around a single point the scale is that of the value itself, or of a larger error.
    room = max(np.ptp(both), _AROUND * abs(both).max()) if alone else 0.05 * np.ptp(both)
    limits = (both.min() - room, both.max() + room)
    axes.plot(limits, limits, color=_TRUTH, linewidth=1.0)
    mark, opacity = (4.0, 1.0) if alone else (1.8, 0.45)
    axes.plot(
        truth,
        estimate,
        "o",
        color=COLORS[0],
        markersize=mark,
        markeredgewidth=0,
        alpha=opacity,
        rasterized=True,
    )
    axes.set(
        xlim=limits,
        ylim=limits,
        xlabel=_label("truth", function.unit, power),
        ylabel=_label("estimate", function.unit, power),
    )
    _tidy(axes)
    return _ESTIMATE_HANDLE


def _draw_level(axes: Axes, found: IdentifyAnswer, index: int, function: Function) -> None:
    """Draw the posterior of the noise of a state, as in Fig. 6.2 of the thesis."""
    noise, state = _constant_noise(found), found.problem.states[index]
    assert noise is not None
    samples = sigma_samples(
        noise.squares[index],
        noise.count,
        noise.alpha,
        noise.beta,
        _SAMPLES,
        np.random.default_rng(found.seed),
    )
    power = _power(samples)
    axes.hist(samples / 10.0**power, bins=40, density=True, color=COLORS[1], alpha=0.6)
    axes.axvline(float(np.sqrt(function.truth[0])) / 10.0**power, color=_TRUTH, linewidth=1.1)
    axes.set(
        title=f"$\\sigma$ of {symbol(state.symbol.name)}\nposterior",
        xlabel=_label("$\\sigma$", f"{state.unit or 1}/√s", power),
        ylabel="density",
    )
    _tidy(axes)


def _tidy(axes: Axes) -> None:
    """Make a panel square, with few ticks, so that long numbers do not overlap."""
    axes.set_box_aspect(1)
    axes.xaxis.set_major_locator(MaxNLocator(2))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.ticklabel_format(style="plain", useOffset=False)


def _power(values: np.ndarray) -> int:
    """Return the power of ten to factor out of tiny or huge values; 0 for others."""
    largest = abs(values).max()
    return 0 if not largest or _TINY <= largest < _HUGE else math.floor(math.log10(largest))


def _label(name: str, unit: str, power: int) -> str:
    if not power:
        return labelled(name, unit)
    raised = f" {unit_text(unit)}" if unit else ""
    return f"{name} [$10^{{{power}}}${raised}]"


def function_symbol(name: str) -> str:
    """Return the name of a learned function as mathematics.

    Args:
        name: such as "f[x_1]" "covariance[x_1, x_2]" or "C(x, y)", or a text.

    Returns:
        Such as "$f$ of $x_{1}$".
    """
    match = _OF.fullmatch(name)
    if match is None:
        return " ".join(symbol(word) for word in name.split())
    name, bracket, inside = match.groups()
    of = ", ".join(symbol(each) for each in inside.split(", "))
    return f"{symbol(name)} of {of}" if bracket == "[" else f"{symbol(name)}({of})"


def _range(name: str, values: np.ndarray) -> str:
    """Describe values: the number where they are constant, else their range."""
    return (
        f"{name} {values[0]:.4g}"
        if _constant(values)
        else f"{name} {values.min():.3g} to {values.max():.3g}"
    )


def _constant(values: np.ndarray) -> bool:
    return bool(np.ptp(values) <= _CONSTANT * abs(values).max())
