"""What the figures of chapter 3 share: learned derivatives, and single trajectories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from safe_envs import SafetyProblem
from safe_envs.agents import evaluate, make_problem
from safe_envs.filters.learning.models.residual import ResidualModel
from safe_envs.filters.learning.residual import learn_residual
from safe_envs.scripts.figures.style import COLORS
from safe_envs.wrappers import Condition
from thesis.artefact import Number, Sample, settings
from thesis.rates import measure

LEARNING = settings(3, "learning")
_QUICK_LEARNINGS = 2
_LEAST_STATES = 400  # with fewer than 127 the held-out errors have no 95 % quantile
_LEAST_EPOCHS = 80  # with fewer the margin is so wide that no input meets the constraint

LEARNED_COLOR, TRUE_COLOR, PRINTED_COLOR, NOMINAL_COLOR = COLORS[:4]


@dataclass(frozen=True)
class Trajectory:
    """States at each control instant, shape (K, n), and the smallest barrier value there, (K,)."""

    states: np.ndarray
    h: np.ndarray

    @property
    def smallest(self) -> float:
        """The smallest h."""
        return float(self.h.min())

    @property
    def steps(self) -> int:
        """The number of control periods."""
        return len(self.h) - 1

    @property
    def lengths(self) -> np.ndarray:
        """Distance covered in each control period in m, shape (K - 1,)."""
        return np.hypot(*np.diff(self.states[:, :2], axis=0).T)


Trajectories = Mapping[str, Sequence[Trajectory]]
"""By what the filter knows: one for each learning, one each without learning."""


def sizes(sample: Sample) -> dict[str, int]:
    """Return how much is learned from, as `learn_residual` takes it."""
    return {
        "states": max(_LEAST_STATES, sample.work(LEARNING.states)),
        "epochs": max(_LEAST_EPOCHS, sample.work(LEARNING.epochs)),
    }


def seeds(sample: Sample) -> list[int]:
    """Return a seed for each repetition of the learning."""
    count = _QUICK_LEARNINGS if sample.quick else LEARNING.repetitions
    return np.random.SeedSequence(sample.seed).generate_state(count).tolist()


@lru_cache(maxsize=8)
def residuals(env_id: str, sample: Sample, **model: float) -> tuple[ResidualModel, ...]:
    """Return what each repetition learns of a problem, with parameters of the model."""
    problem = make_problem(env_id, model=model or None)
    how = {"label_dt": LEARNING.label_step, **sizes(sample)}
    return tuple(learn_residual(problem, seed=seed, **how) for seed in seeds(sample))


def runs(
    problem: SafetyProblem,
    filters: Sequence[str | Condition],
    model: ResidualModel | None = None,
    policy: str = "nominal",
    knowledge: str = "model",
) -> list[Trajectory]:
    """Return the trajectory from a problem's fixed start under each filter."""
    found = evaluate(
        problem,
        policy,
        filters,
        knowledge=knowledge,
        learned=() if model is None else (model,),
        episodes=1,
        num_envs=1,
        bounds=False,
        record=True,
    )
    trajectories = []
    for each in found.trajectories.values():
        present = np.isfinite(each.barrier[:, 0])
        trajectories.append(Trajectory(each.states[present, 0], each.barrier[present, 0]))
    return trajectories


def by_knowledge(
    problem: SafetyProblem, gains: str, models: Sequence[ResidualModel]
) -> Trajectories:
    """Return trajectories with learned, nominal and true derivatives, and without a filter."""
    exact = f"hocbf:alpha={gains}"
    nominal, none = runs(problem, [exact, "none"])
    return {
        "learned": [runs(problem, [f"learned-{exact}"], model)[0] for model in models],
        "nominal": [nominal],
        "true": runs(problem, [exact], knowledge="plant"),
        "none": [none],
    }


def smallest_numbers(found: Trajectories, unit: str = "") -> list[Number]:
    """Return the smallest h of all trajectories."""
    learned = [run.smallest for run in found["learned"]]
    others = ("nominal", "true", "none")
    return [
        Number.mean("smallest h, learned", learned, unit),
        *(Number(f"smallest h, {kind}", found[kind][0].smallest, unit=unit) for kind in others),
    ]


def rates_around(
    problem: SafetyProblem, sample: Sample, models: Sequence[ResidualModel], gains: str
) -> list[Number]:
    """Return safety rates from starts around that of the thesis, over the learnings too."""
    around, exact = problem.configured(start="spread"), f"hocbf:alpha={gains}"
    size = sample.size(LEARNING.episodes), sample.seed
    found = {
        "learned": measure(around, f"learned-{exact}", *size, models),
        "nominal": measure(around, exact, *size),
        "true": measure(around, exact, *size, knowledge="plant"),
    }
    return [each.number(f"safe around the start, {kind}") for kind, each in found.items()]
