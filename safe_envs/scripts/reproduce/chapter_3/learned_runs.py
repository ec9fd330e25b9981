"""What the figures of chapter 3 share: models with learned derivatives, and single trajectories."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from safe_envs import SafetyProblem
from safe_envs.agents import evaluate, make_problem
from safe_envs.scripts.figures.style import COLORS
from safe_envs.scripts.reproduce.framework.artefact import Number, Workload
from safe_envs.scripts.reproduce.framework.paired import measure
from safe_envs.scripts.reproduce.framework.thesis_data import chapter
from safe_envs.wrappers import Condition
from safe_envs.wrappers.learning.residual import ResidualModel, learn_residual

CHAPTER = chapter(3)
LEARNING = CHAPTER.settings["learning"]
_QUICK_LEARNINGS = 2
_LEAST_STATES = 400  # with fewer than 127 the held-out errors have no 95 % quantile
_LEAST_EPOCHS = 80  # with fewer the margin is so wide that no input meets the constraint
_MOST_POINTS = 400

LEARNED_COLOR, TRUE_COLOR, PRINTED_COLOR, NOMINAL_COLOR = COLORS[:4]


@dataclass(frozen=True)
class Trajectory:
    """One trajectory.

    Attributes:
        states: at each control instant, shape (K, n).
        h: smallest barrier value there, shape (K,).
    """

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

    def over_time(self, dt: float, **column: np.ndarray) -> dict[str, list[float]]:
        """Return the instants with a column, both thinned.

        Args:
            dt: control period in s.
            column: name and values.
        """
        columns = {"time": dt * np.arange(len(self.h)), **column}
        return {name: thinned(values) for name, values in columns.items()}


Trajectories = Mapping[str, Sequence[Trajectory]]
"""By what the filter knows: one for each learning, one each without learning."""


def learning_sizes(sample: Workload) -> tuple[int, int]:
    """Return the number of states to learn from, and of epochs."""
    return (
        max(_LEAST_STATES, sample.work(LEARNING["states"])),
        max(_LEAST_EPOCHS, sample.work(LEARNING["epochs"])),
    )


def seeds(sample: Workload) -> list[int]:
    """Return a seed for each repetition of the learning."""
    count = _QUICK_LEARNINGS if sample.quick else LEARNING["repetitions"]
    return np.random.SeedSequence(sample.seed).generate_state(count).tolist()


def setting_values(problem: SafetyProblem, sample: Workload) -> dict[str, Any]:
    """Return what the lines of a setting name.

    Args:
        problem: that is simulated.
        sample: how much.
    """
    states, epochs = learning_sizes(sample)
    return {
        "plant": problem.plant.parameter_values,
        "model": problem.model.parameter_values,
        "dt": problem.dt,
        "horizon": problem.horizon,
        "learnings": len(seeds(sample)),
        "states": states,
        "epochs": epochs,
        "episodes": sample.size(LEARNING["episodes"]),
    }


@lru_cache(maxsize=8)
def residuals(env_id: str, sample: Workload, **model: float) -> tuple[ResidualModel, ...]:
    """Return what is learned of a problem, once for each repetition.

    The results are cached, for two figures show the same.

    Args:
        env_id: of the problem.
        sample: how much is learned.
        model: parameters of the model.
    """
    problem = make_problem(env_id, model=model or None)
    states, epochs = learning_sizes(sample)
    label_dt = LEARNING["label_step"]
    return tuple(
        learn_residual(problem, states=states, label_dt=label_dt, epochs=epochs, seed=seed)
        for seed in seeds(sample)
    )


def runs(
    problem: SafetyProblem,
    filters: Sequence[str | Condition],
    model: ResidualModel | None = None,
    policy: str = "nominal",
    knowledge: str = "model",
) -> list[Trajectory]:
    """Return the trajectory from a problem's fixed start under each filter.

    Args:
        problem: with a fixed start.
        filters: conditions or their texts.
        model: of the learned filters, if any.
        policy: name of the policy.
        knowledge: what the filters know, "model" or "plant".
    """
    learned = () if model is None else (model,)
    size = {"episodes": 1, "num_envs": 1, "bounds": False, "record": True}
    found = evaluate(
        problem, policy, filters, knowledge=knowledge, learned=learned, **size
    ).trajectories
    return [cut(each.states[:, 0], each.barrier[:, 0]) for each in found.values()]


def cut(states: np.ndarray, h: np.ndarray) -> Trajectory:
    """Return the part of a recorded trajectory up to its end.

    Args:
        states: shape (K, n).
        h: shape (K,), NaN after the end.
    """
    present = np.isfinite(h)
    return Trajectory(states[present], h[present])


def trajectories(
    problem: SafetyProblem, gains: str, models: Sequence[ResidualModel]
) -> dict[str, list[Trajectory]]:
    """Return trajectories with learned, nominal and true derivatives, and without a filter.

    Args:
        problem: with a fixed start.
        gains: rates of the HOCBF, as text.
        models: learned ones.
    """
    exact = f"hocbf:p={gains}"
    nominal, none = runs(problem, [exact, "none"])
    return {
        "learned": [runs(problem, [f"learned-{exact}"], model)[0] for model in models],
        "nominal": [nominal],
        "true": runs(problem, [exact], knowledge="plant"),
        "none": [none],
    }


def smallest_numbers(found: Trajectories, unit: str = "") -> list[Number]:
    """Return the smallest h of all trajectories.

    Args:
        found: the trajectories.
        unit: of h.
    """
    learned = [run.smallest for run in found["learned"]]
    return [
        Number.mean("smallest h, learned", learned, unit),
        *(
            Number(f"smallest h, {kind}", found[kind][0].smallest, unit=unit)
            for kind in ("nominal", "true", "none")
        ),
    ]


def rates_around(
    problem: SafetyProblem, sample: Workload, models: Sequence[ResidualModel], gains: str
) -> list[Number]:
    """Return safety rates from starts around that of the thesis.

    Args:
        problem: with the starts "spread".
        sample: how much is simulated.
        models: learned ones; the interval of their rate is over them, too.
        gains: rates of the HOCBF, as text.
    """
    world, exact = problem.configured(start="spread"), f"hocbf:p={gains}"
    size = sample.size(LEARNING["episodes"]), sample.seed
    found = {
        "learned": measure(world, f"learned-{exact}", *size, models),
        "nominal": measure(world, exact, *size),
        "true": measure(world, exact, *size, knowledge="plant"),
    }
    return [each.number(f"safe around the start, {kind}") for kind, each in found.items()]


def thinned(values: np.ndarray) -> list[float]:
    """Return at most 400 of the values, evenly spaced."""
    some = np.asarray(values, dtype=float)[:: math.ceil(len(values) / _MOST_POINTS)]
    return some.round(5).tolist()
