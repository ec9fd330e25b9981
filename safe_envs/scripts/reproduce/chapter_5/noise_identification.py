"""Identifications of what the noise adds to the generator of a barrier, by Algorithm 2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, get_args

import numpy as np

from safe_envs.agents import make_problem
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import gradient
from safe_envs.scripts.reproduce.chapter_5.paired_rates import CHAPTER
from safe_envs.scripts.reproduce.framework.artefact import Workload
from safe_envs.wrappers.learning.data.collection import collect
from safe_envs.wrappers.learning.estimators import Estimator, ito_part, rates
from safe_envs.wrappers.learning.generator import GeneratorModel, learn_generator

POINTS, REPETITIONS = (CHAPTER.settings["learning"][name] for name in ("points", "repetitions"))
VALIDATION = 400  # states at which the errors of an identification are measured


@dataclass(frozen=True)
class NoiseIdentification:
    """What an identification learned.

    Attributes:
        seed: of its data.
        learned: models by estimator.
        x: states of its data, shape (N, n).
        labels: at these, by estimator; none unless they are asked for.
    """

    seed: int
    learned: dict[str, GeneratorModel]
    x: np.ndarray
    labels: dict[str, np.ndarray]


@lru_cache(maxsize=16)
def identification(
    env_id: str, noise: float, points: int, repetitions: int, seed: int, whole: bool
) -> NoiseIdentification:
    """Follow Algorithm 2 at one noise level, by the repaired and by the printed estimator.

    Args:
        env_id: of the system.
        noise: its level.
        points: start states.
        repetitions: one-step transitions from each.
        seed: of the data.
        whole: add the labels of all estimators.

    Returns:
        What was learned, without labels unless they were asked for.
    """
    problem = make_problem(env_id, noise=noise)
    data = collect(problem, points, repetitions, [[0.0]], seed=seed)
    estimators: tuple[Estimator, ...] = ("martingale", "printed")
    learned = {
        name: learn_generator(problem, data=data, estimator=name, seed=seed) for name in estimators
    }
    if not whole:
        return NoiseIdentification(seed, learned, data.x, {})
    h, plant = problem.barriers[0].expression, problem.plant
    value, slopes = (
        compile_function(plant.states, tuple(plant.numeric(e) for e in part), "arrays")
        for part in ([h], gradient(plant, h))
    )
    rate = rates(problem.model, data)
    labels = {
        e: ito_part(data, rate, lambda x: value(*x)[0], lambda x: slopes(*x), e).values
        for e in get_args(Estimator)
    }
    return NoiseIdentification(seed, learned, data.x, labels)


def identifications(sample: Workload) -> int:
    """Return the number of identifications; at least two, since intervals are over them."""
    return 2 if sample.quick else 3


def repeated(env_id: str, noise: float, sample: Workload) -> list[NoiseIdentification]:
    """Return several identifications, the first of them with labels.

    Args:
        env_id: of the system.
        noise: its level.
        sample: how much is learned.
    """
    children = (
        np.random.SeedSequence(sample.seed, spawn_key=(r, 0)).generate_state(1)[0]
        for r in range(1, identifications(sample))
    )
    seeds = [sample.seed, *map(int, children)]
    return [
        identification(env_id, noise, sample.work(POINTS), sample.work(REPETITIONS), seed, r == 0)
        for r, seed in enumerate(seeds)
    ]


def models(
    learned: Sequence[NoiseIdentification], estimator: Estimator = "martingale"
) -> list[GeneratorModel]:
    """Return what was learned by an estimator.

    Args:
        learned: the identifications.
        estimator: its name.
    """
    return [each.learned[estimator] for each in learned]


def learning_values(sample: Workload, region: str, law: str) -> dict[str, Any]:
    """Return what the lines of a setting name.

    Args:
        sample: how much is learned.
        region: from which the states are drawn.
        law: of the noise.
    """
    return {
        "states": sample.work(POINTS),
        "transitions": sample.work(REPETITIONS),
        "identifications": identifications(sample),
        "validation": VALIDATION,
        "region": region,
        "law": law,
    }
