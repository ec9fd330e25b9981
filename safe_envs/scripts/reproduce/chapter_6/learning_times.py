"""Table 6.4: the time to learn the car by DDSCBF's recursion, and by Bayesian identification."""

from __future__ import annotations

import time
from functools import cache, partial
from typing import Any

from safe_envs.agents import make_problem
from safe_envs.scripts.reproduce.chapter_6.identifications import (
    CHAPTER,
    REPETITIONS,
    identified,
    predicted,
    seeds,
)
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.wrappers.learning.generator import GeneratorModel, learn_generator

SETTINGS = CHAPTER.settings["car"]
ENV, PRIOR, POINTS, GENERATOR_REPETITIONS = (
    SETTINGS[name] for name in ("env", "prior", "generator_points", "generator_repetitions")
)
_TIMED = 5
_ONE_BY_ONE = 2000  # evaluations of a network that are timed one by one
_PRINTED_SECONDS = CHAPTER.printed("table-6.4")
_RECURSION, _BAYESIAN = _PRINTED_SECONDS
_FAR_LESS = 10.0


def generator_work(sample: Workload) -> dict[str, Any]:
    """Return the amount of data of DDSCBF, as `learn_generator` takes it."""
    return {"points": sample.work(POINTS), "repetitions": sample.work(GENERATOR_REPETITIONS)}


def generator_values(sample: Workload) -> dict[str, int]:
    """Return the same as the lines of a setting name it."""
    return {f"{name}_used": value for name, value in generator_work(sample).items()}


@cache
def recursion(sample: Workload) -> GeneratorModel:
    """Return DDSCBF's networks by the printed estimate, learned once for both tables."""
    how: dict[str, Any] = {"way": "network", "estimator": "printed", "seed": seeds(sample, 1)[0]}
    return learn_generator(make_problem(ENV), **generator_work(sample), **how)


def sooner(ratio: float) -> list[Claim]:
    """Return the claims that identifying takes less time than the recursion, by its share.

    Source: thesis Sec. 7.1, which calls that dramatic, and gives no factor.
    """
    printed = _PRINTED_SECONDS[_RECURSION] / _PRINTED_SECONDS[_BAYESIAN]
    claim = partial(CHAPTER.claim, "table-6.4", ratio=ratio, printed=printed, least=_FAR_LESS)
    return [claim("sooner", ratio > 1.0), claim("far_sooner", ratio >= _FAR_LESS)]


def compute(sample: Workload) -> Findings:
    """Compute Table 6.4."""
    problem, networks = make_problem(ENV), recursion(sample)
    how: dict[str, Any] = {"way": "direct", "seed": seeds(sample, 1)[0]}
    direct = learn_generator(problem, **generator_work(sample), **how).record.seconds
    seconds = []
    for seed in seeds(sample, _TIMED):
        begun = time.perf_counter()
        identified(problem, REPETITIONS[-1], seed, PRIOR)
        seconds.append(time.perf_counter() - begun)
    single, evaluations = _one_by_one(networks), POINTS * GENERATOR_REPETITIONS
    printed = _PRINTED_SECONDS[_RECURSION]
    slow = Number(_RECURSION, networks.record.seconds, printed=printed, unit="s")
    each = {
        "each": 1e6 * single,
        "together": single * evaluations,
        "printed": printed / evaluations * 1e3,
    }
    quick = predicted(_BAYESIAN, seconds, _PRINTED_SECONDS[_BAYESIAN], "s")
    return Findings(
        numbers=[
            slow,
            quick,
            Number("DDSCBF, covariance of the noise learned once", direct, unit="s"),
        ],
        claims=sooner(slow.ours / quick.ours),
        notes=[
            CHAPTER.note("table-6.4", "one_by_one", evaluations=evaluations, **each),
            CHAPTER.note("table-6.4", "direct", direct=direct, recursion=slow.ours),
        ],
    )


def _one_by_one(networks: GeneratorModel) -> float:
    """Return the seconds for one value of the first network."""
    network, state = networks.generators[0].networks[0], [15.0, 20.0]
    begun = time.perf_counter()
    for _ in range(_ONE_BY_ONE):
        network.floats(state)
    return (time.perf_counter() - begun) / _ONE_BY_ONE


def _values(sample: Workload) -> dict[str, int]:
    return {**generator_values(sample), "timed": len(seeds(sample, _TIMED))}


ARTEFACTS = (CHAPTER.artefact("table-6.4", compute, _values),)
