"""Figure 5.3: trajectories of the cubic system with a CLF, a CBF and DDSCBF (Sec. 5.4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from safe_envs.agents import evaluate, make_problem
from safe_envs.dynamics.codegen import compile_function
from safe_envs.scripts.figures.style import COLORS, UNSAFE, add_legend, mathematics
from thesis.artefact import Claim, Outcome, Sample, settings
from thesis.chapter_5 import noise
from thesis.chapter_5.noise import LEARNING
from thesis.rates import MeasuredFilter, measure, safer

CUBIC = settings(5, "cubic")
SHOWN, STRIDE = 12, 2  # trajectories in a figure, and which of their instants
_CBF, _LEVEL = f"cbf:alpha={CUBIC.alpha}", CUBIC.levels[0]
_FILTERS = {"a": ("none", 0.0), "b": (_CBF, 0.0), "c": (_CBF, _LEVEL), "d": ("ddscbf", _LEVEL)}
_SAFE = {"a": False, "b": True, "c": False, "d": True}
_TITLES = {
    "a": "CLF alone, no noise",
    "b": "CLF and CBF, no noise",
    "c": f"CLF and CBF, k = {_LEVEL:g}",
    "d": f"CLF and DDSCBF, k = {_LEVEL:g}",
}


@dataclass(frozen=True)
class Paths:
    """Episodes under one filter, the same starts for all.

    Attributes:
        runs: of all episodes.
        states: of the first ones, shape (steps + 1, at most 32, 2), NaN after an end.
        safe: which of these have no violation.
    """

    runs: MeasuredFilter
    states: np.ndarray
    safe: np.ndarray


@lru_cache(maxsize=2)
def paths(sample: Sample) -> dict[str, Paths]:
    """Return the trajectories of all four figures."""
    model = noise.identifications(CUBIC.env, _LEVEL, sample)[0].learned["martingale"]
    found = {}
    for letter, (name, level) in _FILTERS.items():
        run = evaluate(
            CUBIC.env,
            filters=[name],
            options={"noise": level, "horizon": CUBIC.horizon},
            learned=[model] if name == "ddscbf" else [],
            episodes=sample.size(LEARNING.episodes),
            seed=sample.seed,
            bounds=False,
            record=True,
        )
        recorded = run.trajectories[name]
        barrier = recorded.barrier[:, : recorded.states.shape[1]]
        measured = MeasuredFilter(run.rows[0], [each.array for each in run.safe[name]])
        found[letter] = Paths(measured, recorded.states, np.nanmin(barrier, axis=0) > 0.0)
    return found


def alike(found: Mapping[str, Paths]) -> np.ndarray:
    """Return the episodes that end as in the text of the thesis in all figures.

    The CLF alone is to be unsafe, or the CBF changes nothing.
    """
    return np.flatnonzero(np.all([found[k].safe == safe for k, safe in _SAFE.items()], axis=0))


def compute(letter: str, sample: Sample) -> tuple[Outcome, Any]:
    """Compute one of the figures."""
    found = paths(sample)
    path, fitting = found[letter], alike(found)
    shown, recorded = int(fitting[0]) if len(fitting) else 0, path.states.shape[1]
    name = f"safe up to {CUBIC.horizon:g} s, {_TITLES[letter]}"
    others = {}
    if letter == "b":
        options = {"noise": 0.0, "horizon": CUBIC.horizon, "input_bounds": CUBIC.wide}
        size = sample.size(LEARNING.episodes), sample.seed
        runs = measure(CUBIC.env, _CBF, *size, options=options)
        others = {
            f"abs(u) <= {CUBIC.wide[1]:g} 1/s in place of 10 1/s": Outcome(
                [runs.number(name)], [all_safe(runs)]
            )
        }
    outcome = Outcome(
        [path.runs.number(name)],
        [claim_of(letter, found)],
        others,
        notes=[
            f"drawn bold in all four figures is an episode chosen by how it ends: {len(fitting)} of"
            f" the {recorded} recorded ones are unsafe with the CLF alone, safe with the CBF"
            " without noise, unsafe with the CBF under noise, and safe with DDSCBF; it is the first"
            f" of {'these' if len(fitting) else 'all'}, number {shown}"
        ],
    )
    order = [shown, *(i for i in range(recorded) if i != shown)][:SHOWN]
    return outcome, partial(_draw, _TITLES[letter], path.states[::STRIDE, order])


def claim_of(letter: str, found: Mapping[str, Paths]) -> Claim:
    """Return the claim of one of the figures."""
    if letter == "a":
        return towards_origin(found["a"].states)
    if letter == "b":
        return all_safe(found["b"].runs)
    if letter == "c":
        sentence = "the noise makes trajectories unsafe with the CBF that are safe without it"
        return safer(sentence, found["b"].runs, found["c"].runs)
    sentence = (
        "under noise DDSCBF keeps trajectories safe that are unsafe with the CBF, more than the"
        " other way round"
    )
    return safer(sentence, found["d"].runs, found["c"].runs)


def towards_origin(states: np.ndarray) -> Claim:
    """Return the claim that all trajectories end nearer to the origin than they begin.

    The states have the shape (steps + 1, B, 2), and are NaN after an end.
    """
    last = np.isfinite(states).all(axis=2).sum(axis=0) - 1
    ends = states[last, np.arange(states.shape[1])]
    left = np.linalg.norm(ends, axis=1) / np.linalg.norm(states[0], axis=1)
    return Claim(
        "the CLF steers the state towards the origin, without noise",
        (left < 1.0).all(),
        f"up to {CUBIC.horizon:g} s {np.sum(left < 1.0)} of {len(left)} trajectories come nearer;"
        f" {np.median(left):.0%} of the first distance is left in the median, {left.max():.0%} at"
        " most",
    )


def all_safe(runs: MeasuredFilter) -> Claim:
    """Return the claim that a CBF without noise keeps all episodes safe."""
    return Claim(
        "the CBF guarantees safe trajectories without noise",
        runs.row.violations == 0,
        f"{runs.row.safe} of {runs.row.episodes} are safe",
    )


def _draw(title: str, states: np.ndarray, figure: Figure) -> None:
    """Draw trajectories (steps, B, 2) in the plane, the first one bold, with the unsafe region."""
    problem = make_problem(CUBIC.env)
    axes = figure.subplots()
    thin: dict[str, Any] = {"color": COLORS[4], "linewidth": 0.8, "alpha": 0.8}
    for line in reversed(np.swapaxes(states, 0, 1)[1:]):
        axes.plot(*line.T, label="other starts", **thin)
        axes.plot(*line[0], "o", color=COLORS[4], markersize=2.5)
    bold = {"color": COLORS[0], "linewidth": 1.6, "label": "the same start in all figures"}
    axes.plot(*states[:, 0].T, **bold)
    axes.plot(*states[0, 0], "o", color="black", markersize=4, zorder=3)
    axes.plot(0.0, 0.0, "+", color="black", markersize=6, markeredgewidth=1.5)
    low, high = (-3.2, -2.3), (2.2, 2.3)
    grid = np.meshgrid(*[np.linspace(*ends, 300) for ends in zip(low, high, strict=True)])
    expression = problem.barriers[0].expression
    (h,) = compile_function(problem.plant.states, (expression,), "arrays")(*grid)
    axes.contourf(*grid, h, levels=[-np.inf, 0.0], colors=[UNSAFE], alpha=0.35, zorder=0)
    axes.contour(*grid, h, levels=[0.0], colors="black", linewidths=1.2, zorder=1)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel="$x_1$", ylabel="$x_2$", title=mathematics(title))
    handles, labels = axes.get_legend_handles_labels()
    unsafe = Patch(color=UNSAFE, alpha=0.35, label="unsafe: $h < 0$")
    kinds = dict(zip(labels, handles, strict=True)).values()
    add_legend(figure, [*reversed(kinds), unsafe])


ARTEFACTS = {f"figure-5.3{letter}": partial(compute, letter) for letter in _FILTERS}
