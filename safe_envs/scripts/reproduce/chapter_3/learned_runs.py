"""What the figures of chapter 3 share: models whose derivatives are learned some times, and single
trajectories under filters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.evaluation.repeats import pooled
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.problem import SafetyProblem
from safe_envs.registry import make_problem
from safe_envs.scripts.figures.evaluation_figure import COLORS
from safe_envs.scripts.reproduce.framework.artefact import Number, Sample
from safe_envs.wrappers.learning.models.residual import ResidualModel
from safe_envs.wrappers.learning.residual import learn_residual

LEARNINGS, QUICK_LEARNINGS = 3, 2  # repetitions of the learning, from other seeds
STATES, LEAST_STATES = (
    2000,
    400,
)  # to learn from; with fewer than 127 the held-out errors have no 95 % quantile
EPOCHS, LEAST_EPOCHS = 500, 80  # with fewer the margin is so wide that no input meets the row
LABEL_STEP = 1e-3  # of the differences that are learned from, s
EPISODES = 1000  # from starts around the printed one

CORRECTED = (
    (
        "Eq. (3.28), Alg. 1: the central second difference over control periods gives half of the"
        f" input's gain; here forward differences over steps of {LABEL_STEP:g} s under one held"
        " input"
    ),
    (
        "Sec. 3.4.1, Alg. 1: states along trajectories; here drawn uniformly where it is safe,"
        " which covers the region evenly"
    ),
    (
        "Eq. (3.26) forgets the margin of Eq. (3.20), and the box of the input; both are here, the"
        " margin with an error of its own for each residual, and |u| in place of its largest value"
    ),
    (
        "Sec. 3.4.2: the loss lacks its square, and the update has the wrong sign; here Adam,"
        " stopped by the loss at states kept apart"
    ),
)

LEARNED_COLOR, TRUE_COLOR, PRINTED_COLOR, NOMINAL_COLOR = COLORS[:4]
_MOST_POINTS = 400


@dataclass(frozen=True)
class Run:
    """One trajectory.

    Attributes:
        states: (K, n), one for each control instant.
        h: smallest barrier value there, (K,).
    """

    states: np.ndarray
    h: np.ndarray

    @property
    def smallest(self) -> float:
        """The smallest h."""
        return float(self.h.min())

    @property
    def steps(self) -> int:
        """Control periods."""
        return len(self.h) - 1

    @property
    def lengths(self) -> np.ndarray:
        """Distance covered in each control period, in m."""
        return np.hypot(*np.diff(self.states[:, :2], axis=0).T)


def settings(sample: Sample) -> tuple[int, int]:
    """States to learn from, and epochs."""
    return max(LEAST_STATES, sample.work(STATES)), max(LEAST_EPOCHS, sample.work(EPOCHS))


def seeds(sample: Sample) -> list[int]:
    """One for each repetition of the learning."""
    return (
        np.random.SeedSequence(sample.seed)
        .generate_state(QUICK_LEARNINGS if sample.quick else LEARNINGS)
        .tolist()
    )


def learning(sample: Sample) -> str:
    """How it is learned."""
    states, epochs = settings(sample)
    return (
        f"{len(seeds(sample))} learnings from {states} states each, network 100-30 ReLU, Adam, up"
        f" to {epochs} epochs, margin of the held-out errors at the 95 % level"
    )


def parameters(system: ControlAffineSDE) -> dict[str, float]:
    """Parameters of a system by their names."""
    return {symbol.name: value for symbol, value in system.parameters.items()}


@lru_cache(maxsize=8)
def residuals(env_id: str, sample: Sample, **model: float) -> tuple[ResidualModel, ...]:
    """What is learned of a problem, anew for each repetition; remembered, for two figures show the
    same."""
    problem = make_problem(env_id, model=model or None)
    states, epochs = settings(sample)
    return tuple(
        learn_residual(problem, states=states, label_dt=LABEL_STEP, epochs=epochs, seed=seed)
        for seed in seeds(sample)
    )


def runs(
    problem: SafetyProblem,
    filters: Sequence[str],
    model: ResidualModel | None = None,
    policy: str = "nominal",
    knowledge: str = "model",
) -> list[Run]:
    """The trajectory from a problem's fixed start under each filter."""
    learned = () if model is None else (model,)
    found = evaluate(
        problem,
        policy,
        filters,
        episodes=1,
        num_envs=1,
        knowledge=knowledge,
        bounds=False,
        learned=learned,
        record=True,
    ).recorders
    return [cut(found[name].states[:, 0], found[name].barrier[:, 0]) for name in filters]


def cut(states: np.ndarray, h: np.ndarray) -> Run:
    """The part of a recorded trajectory up to its end."""
    present = np.isfinite(h)
    return Run(states[present], h[present])


def rates_around(
    problem: SafetyProblem, sample: Sample, models: Sequence[ResidualModel], gains: str
) -> list[Number]:
    """Safety rates from starts around the printed one, the learned one's interval over learnings
    too."""
    world, size = problem.configured(start="spread"), sample.size(EPISODES)

    def row(name: str, **rest: Any) -> dict[str, Any]:
        return evaluate(
            world, "nominal", [name], episodes=size, seed=sample.seed, bounds=False, **rest
        ).rows[0]

    nominal, true = row(f"hocbf:p={gains}"), row(f"hocbf:p={gains}", knowledge="plant")
    learned = pooled([row(f"learned-hocbf:p={gains}", learned=(model,)) for model in models], 0.95)
    rate, low, high = (100 * learned[key] for key in ("safety_rate", "ci_low", "ci_high"))
    return [
        Number("safe around the start, learned", rate, low, high, unit="%"),
        Number.rate("safe around the start, nominal", nominal["safe"], nominal["episodes"]),
        Number.rate("safe around the start, true", true["safe"], true["episodes"]),
    ]


def thinned(values: np.ndarray) -> list[float]:
    """At most 400 of the values, evenly spaced."""
    return (
        np.asarray(values, dtype=float)[:: math.ceil(len(values) / _MOST_POINTS)].round(5).tolist()
    )
