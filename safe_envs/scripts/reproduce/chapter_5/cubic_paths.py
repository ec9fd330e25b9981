"""Trajectories of the cubic system with a CLF, a CBF and DDSCBF (thesis Figure 5.3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.dynamics.codegen import compile_function
from safe_envs.registry import make_problem
from safe_envs.scripts.figures.evaluation_figure import COLORS, QUIET, UNSAFE, add_legend
from safe_envs.scripts.reproduce.chapter_5.cubic import ALPHA, CBF, ENV, LEVELS, START, STATES, TASK
from safe_envs.scripts.reproduce.chapter_5.noise_terms import lessons
from safe_envs.scripts.reproduce.chapter_5.paired_rates import EPISODES, Runs, measured, safer
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Claim, Outcome, Sample

HORIZON = 4.0
"""In s."""
WIDE = [-1e3, 1e3]
"""A box that the system without noise never meets, in 1/s."""
SHOWN, STRIDE = 12, 2
"""Trajectories in a picture, and which of their instants."""

_KINDS = {"a": ("none", 0.0), "b": (CBF, 0.0), "c": (CBF, LEVELS[0]), "d": ("ddscbf", LEVELS[0])}
_WANTED = {"a": False, "b": True, "c": False, "d": True}
_SOUGHT = (
    "unsafe with the CLF alone, safe with the CBF without noise, unsafe with the CBF under noise,"
    " and safe with DDSCBF"
)


@dataclass(frozen=True)
class Path:
    """Trajectories under one filter, the same starts for all.

    Attributes:
        runs: of all episodes.
        states: shape (steps + 1, at most 32, 2), NaN after an end.
        barrier: h, shape (steps + 1, the same).
    """

    runs: Runs
    states: np.ndarray
    barrier: np.ndarray

    @property
    def safe(self) -> np.ndarray:
        """Which of these episodes have no violation."""
        return np.nanmin(self.barrier, axis=0) > 0.0


@lru_cache(maxsize=2)
def paths(sample: Sample) -> dict[str, Path]:
    """Trajectories of all four pictures."""
    model = lessons(ENV, LEVELS[0], sample)[0].learned["martingale"]
    found = {}
    for key, (name, noise) in _KINDS.items():
        learned = [model] if name == "ddscbf" else []
        how: dict[str, Any] = {
            "episodes": sample.size(EPISODES),
            "seed": sample.seed,
            "bounds": False,
            "record": True,
        }
        run = evaluate(
            ENV,
            filters=[name],
            options={"noise": noise, "horizon": HORIZON},
            learned=learned,
            **how,
        )
        recorder = run.recorders[name]
        found[key] = Path(
            Runs(run.rows[0], run.flags[name]),
            recorder.states,
            recorder.barrier[:, : recorder.states.shape[1]],
        )
    return found


def alike(found: Mapping[str, Path]) -> np.ndarray:
    """Episodes that end as those of the thesis' text in all pictures; the CLF alone is to be
    unsafe, or the CBF changes nothing."""
    return np.flatnonzero(
        np.all([found[key].safe == safe for key, safe in _WANTED.items()], axis=0)
    )


def _picture(key: str, name: str, sample: Sample) -> Outcome:
    found = paths(sample)
    path, fitting = found[key], alike(found)
    shown, recorded = int(fitting[0]) if len(fitting) else 0, path.states.shape[1]
    order = [shown, *(i for i in range(recorded) if i != shown)][:SHOWN]
    lines = [path.states[::STRIDE, i] for i in order]
    of_these = f"{len(fitting)} of the {recorded} recorded ones are {_SOUGHT}"
    return Outcome(
        numbers=[path.runs.number(_rate_name(name))],
        claims=[_CLAIMS[key](found)],
        elsewhere=(
            {f"abs(u) <= {WIDE[1]:g} 1/s in place of 10 1/s": _unbounded(name, sample)}
            if key == "b"
            else {}
        ),
        data={
            "name": name,
            "paths": [line[np.isfinite(line).all(axis=1)].tolist() for line in lines],
        },
        notes=[
            (
                f"drawn bold in all four pictures is an episode chosen by how it ends: {of_these};"
                f" it is the first of {'these' if len(fitting) else 'all'}, number {shown}"
            ),
            *([short_of_input(path.runs)] if key == "b" else []),
        ],
    )


def _rate_name(name: str) -> str:
    return f"safe up to {HORIZON:g} s, {name}"


def _unbounded(name: str, sample: Sample) -> Outcome:
    """The CBF without noise, with more input than it ever takes."""
    runs = measured(ENV, {"noise": 0.0, "horizon": HORIZON, "box": WIDE}, [CBF], [], sample)[CBF]
    return Outcome([runs.number(_rate_name(name))], [kept(runs)])


def short_of_input(runs: Runs) -> str:
    """How often the box is too small for the CBF."""
    return (
        "no input within 10 1/s meets the condition of the CBF at"
        f" {runs.row['infeasible_rate']:.2%} of the steps up to a first violation"
    )


def towards_origin(states: np.ndarray) -> Claim:
    """Whether all trajectories, shape (steps + 1, B, 2), end nearer to the origin than they begin."""
    last = np.isfinite(states).all(axis=2).sum(axis=0) - 1
    ends = states[last, np.arange(states.shape[1])]
    left = np.linalg.norm(ends, axis=1) / np.linalg.norm(states[0], axis=1)
    evidence = (
        f"up to {HORIZON:g} s {np.sum(left < 1.0)} of {len(left)} trajectories come nearer;"
        f" {np.median(left):.0%} of the first distance is left in the median, {left.max():.0%} at"
        " most"
    )
    return Claim(
        "the CLF steers the state towards the origin, without noise",
        bool((left < 1.0).all()),
        evidence,
    )


def kept(runs: Runs) -> Claim:
    """Whether a CBF without noise keeps all episodes safe."""
    row = runs.row
    return Claim(
        "the CBF guarantees safe trajectories without noise",
        row["violations"] == 0,
        f"{row['safe']} of {row['episodes']} are safe",
    )


def lost(quiet: Runs, noisy: Runs) -> Claim:
    """Whether the CBF is less safe with noise than without."""
    return safer(
        "the noise makes trajectories unsafe with the CBF that are safe without it",
        quiet,
        noisy,
        printed=True,
    )


def recovered(ddscbf: Runs, cbf: Runs) -> Claim:
    """Whether DDSCBF is safer than the CBF under noise."""
    sentence = (
        "under noise DDSCBF keeps trajectories safe that are unsafe with the CBF, more than the"
        " other way round"
    )
    return safer(sentence, ddscbf, cbf, printed=True)


_CLAIMS: dict[str, Callable[[Mapping[str, Path]], Claim]] = {
    "a": lambda found: towards_origin(found["a"].states),
    "b": lambda found: kept(found["b"].runs),
    "c": lambda found: lost(found["b"].runs, found["c"].runs),
    "d": lambda found: recovered(found["d"].runs, found["c"].runs),
}


def draw_paths(figure: Figure, outcome: Outcome) -> None:
    """Trajectories in the plane, one of them bold, with the unsafe region."""
    problem = make_problem(ENV)
    axes = figure.subplots()
    lines = [np.array(line) for line in outcome.data["paths"]]
    for line in reversed(lines[1:]):
        axes.plot(
            line[:, 0], line[:, 1], color=COLORS[4], linewidth=0.8, alpha=0.8, label="other starts"
        )
        axes.plot(*line[0], "o", color=COLORS[4], markersize=2.5)
    axes.plot(
        lines[0][:, 0],
        lines[0][:, 1],
        color=COLORS[0],
        linewidth=2.2,
        label="the same start in all pictures",
    )
    axes.plot(*lines[0][0], "o", color="black", markersize=4, zorder=3)
    axes.plot(0.0, 0.0, "+", color="black", markersize=9, markeredgewidth=1.5)
    low, high = (-3.2, -2.3), (2.2, 2.3)
    grid = np.meshgrid(*[np.linspace(*ends, 300) for ends in zip(low, high, strict=True)])
    h = compile_function(problem.plant.states, (problem.barriers[0].expression,), "arrays")(*grid)[
        0
    ]
    axes.contourf(*grid, h, levels=[-np.inf, 0.0], colors=[UNSAFE], alpha=0.35, zorder=0)
    axes.contour(*grid, h, levels=[0.0], colors="black", linewidths=1.2, zorder=1)
    axes.text(0.98, 0.03, "unsafe", transform=axes.transAxes, ha="right", color=QUIET)
    axes.set(
        xlim=(low[0], high[0]),
        ylim=(low[1], high[1]),
        xlabel="$x_1$",
        ylabel="$x_2$",
        title=outcome.data["name"],
        aspect="equal",
    )
    handles, labels = axes.get_legend_handles_labels()
    kinds = dict(zip(labels, handles, strict=True))
    add_legend(figure, [*reversed(kinds.values()), Patch(color=UNSAFE, alpha=0.35, label="h < 0")])


def _setting(sample: Sample) -> tuple[str, ...]:
    episodes = sample.size(EPISODES)
    return (
        (
            f"{min(SHOWN, episodes)} trajectories up to {HORIZON:g} s; rates over {episodes}"
            " episodes; DDSCBF of one identification"
        ),
        START,
        TASK,
    )


_PICTURES = (
    ("a", "CLF alone, no noise"),
    ("b", "CLF and CBF, no noise"),
    ("c", f"CLF and CBF, k = {LEVELS[0]:g}"),
    ("d", f"CLF and DDSCBF, k = {LEVELS[0]:g}"),
)

ARTEFACTS: tuple[Artefact, ...] = tuple(
    Artefact(
        name=f"figure-5.3{key}",
        title=f"Trajectories of the cubic system: {name}",
        compute=partial(_picture, key, name),
        setting=_setting,
        chosen=(
            "start, horizon, task and box: see the setting",
            f"CBF with alpha(h) = {ALPHA:g} h 1/s",
            "which start is drawn bold: see the notes",
        ),
        corrections=(STATES,),
        draw=draw_paths,
        size=(7.0, 5.2),
    )
    for key, name in _PICTURES
)
