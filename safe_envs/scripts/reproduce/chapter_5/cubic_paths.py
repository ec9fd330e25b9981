"""Trajectories of the cubic system with a CLF, a CBF and DDSCBF (thesis Figure 5.3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from safe_envs.agents import evaluate, make_problem
from safe_envs.dynamics.codegen import compile_function
from safe_envs.scripts.figures.labels import mathematics
from safe_envs.scripts.figures.style import COLORS, UNSAFE, add_legend
from safe_envs.scripts.reproduce.chapter_5.cubic import CBF, ENV, LEVELS, SETTINGS
from safe_envs.scripts.reproduce.chapter_5.noise_identification import repeated
from safe_envs.scripts.reproduce.chapter_5.paired_rates import CHAPTER, EPISODES, measured
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Workload
from safe_envs.scripts.reproduce.framework.paired import MeasuredFilter, safer

HORIZON, WIDE = SETTINGS["horizon"], SETTINGS["wide"]
_note = partial(CHAPTER.note, "figure-5.3a")
_claim = partial(CHAPTER.claim, "figure-5.3a")
SHOWN, STRIDE = 12, 2  # trajectories in a figure, and which of their instants

_KINDS = {"a": ("none", 0.0), "b": (CBF, 0.0), "c": (CBF, LEVELS[0]), "d": ("ddscbf", LEVELS[0])}
_WANTED = {"a": False, "b": True, "c": False, "d": True}


@dataclass(frozen=True)
class PlaneTrajectories:
    """Trajectories under one filter, the same starts for all.

    Attributes:
        runs: of all episodes.
        states: shape (steps + 1, at most 32, 2), NaN after an end.
        barrier: h, shape (steps + 1, the same).
    """

    runs: MeasuredFilter
    states: np.ndarray
    barrier: np.ndarray

    @property
    def safe(self) -> np.ndarray:
        """Return which of these episodes have no violation, shape (at most 32,)."""
        return np.nanmin(self.barrier, axis=0) > 0.0


@lru_cache(maxsize=2)
def paths(sample: Workload) -> dict[str, PlaneTrajectories]:
    """Return the trajectories of all four figures."""
    model = repeated(ENV, LEVELS[0], sample)[0].learned["martingale"]
    found = {}
    for key, (name, noise) in _KINDS.items():
        options = {"noise": noise, "horizon": HORIZON}
        run = evaluate(
            ENV,
            filters=[name],
            options=options,
            learned=[model] if name == "ddscbf" else [],
            episodes=sample.size(EPISODES),
            seed=sample.seed,
            bounds=False,
            record=True,
        )
        recorded, row = run.trajectories[name], run.rows[0]
        found[key] = PlaneTrajectories(
            MeasuredFilter(
                row, [row.safety_rate], [each.array for each in run.safe[name]], row.episodes
            ),
            recorded.states,
            recorded.barrier[:, : recorded.states.shape[1]],
        )
    return found


def alike(found: Mapping[str, PlaneTrajectories]) -> np.ndarray:
    """Return the episodes that end as in the text of the thesis in all figures.

    The CLF alone is to be unsafe, or the CBF changes nothing.
    """
    return np.flatnonzero(
        np.all([found[key].safe == safe for key, safe in _WANTED.items()], axis=0)
    )


def compute(key: str, name: str, sample: Workload) -> Findings:
    """Compute one of the figures.

    Args:
        key: its letter.
        name: what it shows.
        sample: how much is simulated.

    Returns:
        Numbers, claims and notes of the figure, with the trajectories that it shows.
    """
    found = paths(sample)
    path, fitting = found[key], alike(found)
    shown, recorded = int(fitting[0]) if len(fitting) else 0, path.states.shape[1]
    order = [shown, *(i for i in range(recorded) if i != shown)][:SHOWN]
    lines = [path.states[::STRIDE, i] for i in order]
    counts = {"fitting": len(fitting), "recorded": recorded, "shown": shown}
    return Findings(
        numbers=[path.runs.number(_rate_name(name))],
        claims=[_CLAIMS[key](found)],
        alternative_settings=(
            {f"abs(u) <= {WIDE[1]:g} 1/s in place of 10 1/s": _unbounded(name, sample)}
            if key == "b"
            else {}
        ),
        data={
            "name": name,
            "paths": [line[np.isfinite(line).all(axis=1)].tolist() for line in lines],
        },
        notes=[
            _note("bold", which="these" if len(fitting) else "all", **counts),
            *([short_of_input(path.runs)] if key == "b" else []),
        ],
    )


def _rate_name(name: str) -> str:
    return f"safe up to {HORIZON:g} s, {name}"


def _unbounded(name: str, sample: Workload) -> Findings:
    """Return the outcome of the CBF without noise, with more input than it ever takes."""
    runs = measured(ENV, {"noise": 0.0, "horizon": HORIZON, "box": WIDE}, [CBF], [], sample)[CBF]
    return Findings([runs.number(_rate_name(name))], [all_safe(runs)])


def short_of_input(runs: MeasuredFilter) -> str:
    """Return how often the input bounds are too narrow for the CBF, in words."""
    return _note("short", share=runs.row.infeasible_rate)


def towards_origin(states: np.ndarray) -> Claim:
    """Return the claim that all trajectories end nearer to the origin than they begin.

    Args:
        states: shape (steps + 1, B, 2), NaN after an end.
    """
    last = np.isfinite(states).all(axis=2).sum(axis=0) - 1
    ends = states[last, np.arange(states.shape[1])]
    left = np.linalg.norm(ends, axis=1) / np.linalg.norm(states[0], axis=1)
    values = {"nearer": np.sum(left < 1.0), "median": np.median(left), "most": left.max()}
    return _claim("towards", (left < 1.0).all(), count=len(left), **values)


def all_safe(runs: MeasuredFilter) -> Claim:
    """Return the claim that a CBF without noise keeps all episodes safe."""
    return _claim("safe", runs.row.violations == 0, row=runs.row)


def lost(quiet: MeasuredFilter, noisy: MeasuredFilter) -> Claim:
    """Return the claim that the CBF is less safe with noise than without.

    Args:
        quiet: without noise.
        noisy: with it.
    """
    sentence = "the noise makes trajectories unsafe with the CBF that are safe without it"
    return safer(sentence, quiet, noisy)


def recovered(ddscbf: MeasuredFilter, cbf: MeasuredFilter) -> Claim:
    """Return the claim that DDSCBF is safer than the CBF under noise.

    Args:
        ddscbf: under noise.
        cbf: on the same episodes.
    """
    sentence = (
        "under noise DDSCBF keeps trajectories safe that are unsafe with the CBF, more than the"
        " other way round"
    )
    return safer(sentence, ddscbf, cbf)


_CLAIMS: dict[str, Callable[[Mapping[str, PlaneTrajectories]], Claim]] = {
    "a": lambda found: towards_origin(found["a"].states),
    "b": lambda found: all_safe(found["b"].runs),
    "c": lambda found: lost(found["b"].runs, found["c"].runs),
    "d": lambda found: recovered(found["d"].runs, found["c"].runs),
}


def _draw_paths(figure: Figure, outcome: Findings) -> None:
    """Draw trajectories in the plane, one of them bold, with the unsafe region."""
    problem = make_problem(ENV)
    axes = figure.subplots()
    lines = [np.array(line) for line in outcome.data["paths"]]
    thin: dict[str, Any] = {"color": COLORS[4], "linewidth": 0.8, "alpha": 0.8}
    for line in reversed(lines[1:]):
        axes.plot(*line.T, label="other starts", **thin)
        axes.plot(*line[0], "o", color=COLORS[4], markersize=2.5)
    label = "the same start in all figures"
    axes.plot(*lines[0].T, color=COLORS[0], linewidth=1.6, label=label)
    axes.plot(*lines[0][0], "o", color="black", markersize=4, zorder=3)
    axes.plot(0.0, 0.0, "+", color="black", markersize=6, markeredgewidth=1.5)
    low, high = (-3.2, -2.3), (2.2, 2.3)
    grid = np.meshgrid(*[np.linspace(*ends, 300) for ends in zip(low, high, strict=True)])
    h = compile_function(problem.plant.states, (problem.barriers[0].expression,), "arrays")(*grid)[
        0
    ]
    axes.contourf(*grid, h, levels=[-np.inf, 0.0], colors=[UNSAFE], alpha=0.35, zorder=0)
    axes.contour(*grid, h, levels=[0.0], colors="black", linewidths=1.2, zorder=1)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel="$x_1$", ylabel="$x_2$", title=mathematics(outcome.data["name"]))
    handles, labels = axes.get_legend_handles_labels()
    kinds = dict(zip(labels, handles, strict=True))
    add_legend(
        figure,
        [*reversed(kinds.values()), Patch(color=UNSAFE, alpha=0.35, label="unsafe: $h < 0$")],
    )


def _values(sample: Workload) -> dict[str, Any]:
    episodes = sample.size(EPISODES)
    return {"shown": min(SHOWN, episodes), "count": episodes}


_PICTURES = (
    ("a", "CLF alone, no noise"),
    ("b", "CLF and CBF, no noise"),
    ("c", f"CLF and CBF, k = {LEVELS[0]:g}"),
    ("d", f"CLF and DDSCBF, k = {LEVELS[0]:g}"),
)

ARTEFACTS = tuple(
    CHAPTER.artefact(f"figure-5.3{key}", partial(compute, key, name), _values, _draw_paths)
    for key, name in _PICTURES
)
