"""What chapter 5 shares: identifications of the noise by Algorithm 2, and rates of filters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, get_args

import numpy as np

from safe_envs.agents import make_problem
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import gradient
from safe_envs.filters.learning.collection import collect
from safe_envs.filters.learning.drift_checks import Estimator, ito_part, rates
from safe_envs.filters.learning.generator import learn_generator
from safe_envs.filters.learning.models.generator import GeneratorModel
from thesis.artefact import Claim, Sample, settings
from thesis.rates import PRINTED_EPISODES, MeasuredFilter, difference, measure

LEARNING = settings(5, "learning")
WITHOUT_RATE = f"cbf:alpha={1e-12}"
"""A CBF without its class-K term: the derivative of h must not be negative."""

Runs = Mapping[str, MeasuredFilter]
"""By the text of the filter."""


@dataclass(frozen=True)
class Identification:
    """What is learned from one set of data.

    Attributes:
        seed: of the data.
        learned: models by estimator, "martingale" (the repaired one) and "printed".
        x: states of the data, shape (N, n).
        labels: of what the noise adds to the generator of h there, by estimator.
    """

    seed: int
    learned: dict[str, GeneratorModel]
    x: np.ndarray
    labels: dict[str, np.ndarray]


@lru_cache(maxsize=4)
def identifications(env_id: str, noise: float, sample: Sample) -> list[Identification]:
    """Follow Algorithm 2 at a noise level several times: intervals are over identifications."""
    count = 2 if sample.quick else LEARNING.identifications
    children = (
        np.random.SeedSequence(sample.seed, spawn_key=(r, 0)).generate_state(1)[0]
        for r in range(1, count)
    )
    return [_identified(env_id, noise, sample, s) for s in (sample.seed, *map(int, children))]


def _identified(env_id: str, noise: float, sample: Sample, seed: int) -> Identification:
    problem = make_problem(env_id, noise=noise)
    size = sample.work(LEARNING.points), sample.work(LEARNING.repetitions)
    data = collect(problem, *size, [[0.0]], seed=seed)
    learned = {
        name: learn_generator(problem, data=data, estimator=name, seed=seed)
        for name in ("martingale", "printed")
    }
    h, plant = problem.barriers[0].expression, problem.plant
    value, slopes = (
        compile_function(plant.states, tuple(plant.numeric(e) for e in part), "arrays")
        for part in ([h], gradient(plant, h))
    )
    rate = rates(problem.model, data)
    labels = {
        each: ito_part(data, rate, lambda x: value(*x)[0], lambda x: slopes(*x), each).values
        for each in get_args(Estimator)
    }
    return Identification(seed, learned, data.x, labels)


def models(
    learned: Sequence[Identification], estimator: str = "martingale"
) -> list[GeneratorModel]:
    """Return what was learned by an estimator."""
    return [each.learned[estimator] for each in learned]


def rates_of(
    env_id: str,
    options: dict[str, Any],
    sample: Sample,
    filters: Sequence[str],
    learned: Sequence[GeneratorModel] = (),
) -> dict[str, MeasuredFilter]:
    """Return the rates of filters that learn nothing, and of "ddscbf" with several models."""
    used = {**dict.fromkeys(filters, ()), **({"ddscbf": learned} if learned else {})}
    size = sample.size(LEARNING.episodes), sample.seed
    return {
        text: measure(env_id, text, *size, each, options=options) for text, each in used.items()
    }


def resolution(first: float, second: float) -> float:
    """Return what separate samples of the printed size can tell apart with 95 %, in points.

    The rates are in per cent.
    """
    variances = (p / 100 * (1 - p / 100) for p in (first, second))
    return 196 * math.sqrt(sum(variances) / PRINTED_EPISODES)


def close(runs: Runs, scbf: float, ddscbf: float, where: str = "") -> Claim:
    """Return our claim that learning costs less than the thesis could have told apart.

    The printed rates are in per cent; `where` ends the sentence.
    """
    limit = resolution(scbf, ddscbf)
    gap = difference("", runs["ddscbf"].flags, runs["scbf"].flags)
    low, high = gap.ends
    return Claim(
        f"DDSCBF is as safe as SCBF{where}",
        max(-low, high) <= limit,
        f"DDSCBF - SCBF = {gap.text}, over identifications and episodes; limit {limit:.1f}"
        f" points, what two samples of {PRINTED_EPISODES} tell apart",
        printed=False,
    )


def explain_gap(runs: Runs, cbf: str, where: str) -> str:
    """Return where the gap between SCBF and CBF comes from, in words."""

    def gap(first: str, second: str) -> str:
        return difference("", runs[first].flags, runs[second].flags).text

    return (
        f"{where}, SCBF - CBF is {gap('scbf', cbf)}: the class-K term (CBF with alpha = 0 less CBF)"
        f" makes {gap(WITHOUT_RATE, cbf)} of it, and the noise part (SCBF less CBF with alpha = 0)"
        f" {gap('scbf', WITHOUT_RATE)}"
    )
