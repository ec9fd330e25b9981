"""Table 6.3: safety of the car with known, partly known and identified dynamics."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import sympy as sp

from safe_envs import SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.scripts.reproduce.chapter_6.identifications import (
    CHAPTER,
    REPETITIONS,
    identified,
    seeds,
)
from safe_envs.scripts.reproduce.chapter_6.learned_controllers import (
    LearnedController,
    printed_rate,
    similar,
)
from safe_envs.scripts.reproduce.chapter_6.learning_times import (
    ENV,
    PRIOR,
    SETTINGS,
    generator_values,
    generator_work,
    recursion,
)
from safe_envs.scripts.reproduce.framework.artefact import Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.paired import measure
from safe_envs.wrappers.learning.generator import learn_generator

EPISODES = SETTINGS["episodes"]
_CONTROLLERS, _FEW_CONTROLLERS, _GENERATORS = 30, 8, 2
"""Identifications with the largest and with the smallest K, and of the noise."""

_QUICK_HORIZON = 2.0  # of a quick sample, in s
PRINTED = CHAPTER.printed("table-6.3")


def printed_second_generator(problem: SafetyProblem) -> sp.Expr:
    """Return b_2 by the formula of Sec. 6.3.2, with the numbers of the plant."""
    values = problem.plant.parameter_values
    (v, z), (u,), mass = problem.plant.states, problem.plant.inputs, values["M"]
    gap, closing = z - 10, values["v_f"] - v
    drag = values["f_0"] + values["f_1"] * v + values["f_2"] * v**2
    noise = values["sigma_1"] ** 2 + values["sigma_2"] ** 2
    return (
        5 * gap**4 / mass * drag + 20 * gap**3 * closing**2 - gap**4 / mass * u + 120 * gap * noise
    )


def _world(sample: Workload) -> SafetyProblem:
    problem = make_problem(ENV)
    return replace(problem, horizon=_QUICK_HORIZON) if sample.quick else problem


def compute(sample: Workload) -> Findings:
    """Compute Table 6.3."""
    problem, chosen = _world(sample), seeds(sample, _CONTROLLERS)
    size = sample.size(EPISODES), sample.seed
    scbf = measure(problem, "scbf", *size)
    generators = [
        learn_generator(problem, way="direct", seed=seed, **generator_work(sample))
        for seed in chosen[:_GENERATORS]
    ]
    ddscbf = LearnedController.run(problem, "ddscbf", generators, scbf, sample.seed)

    def bayesian(repetitions: int, count: int) -> LearnedController:
        models = [identified(problem, repetitions, seed, PRIOR) for seed in chosen[:count]]
        return LearnedController.run(problem, "bayesian-scbf", models, scbf, sample.seed)

    def table(found: LearnedController) -> list[Number]:
        each = {"SCBF": scbf, "DDSCBF": ddscbf, "Bayesian SCBF": found}
        return [controller.number(name, PRINTED[name]) for name, controller in each.items()]

    found = bayesian(REPETITIONS[-1], _CONTROLLERS)
    # A quick sample does without what is only compared with the table.
    fewer = None if sample.quick else bayesian(REPETITIONS[0], _FEW_CONTROLLERS)
    blind = measure(problem.configured(model={"sigma_1": 0.0, "sigma_2": 0.0}), "scbf", *size)
    by_recursion = measure(problem, "ddscbf", *size, [recursion(sample)])
    return Findings(
        numbers=table(found),
        claims=[similar({"": found})],
        alternative_settings={}
        if fewer is None
        else {
            f"K = {REPETITIONS[0]} in the identification": Findings(
                table(fewer), [similar({"": fewer})]
            )
        },
        printed_formula=[
            printed_rate("SCBF", problem, printed_second_generator(problem), *size),
            by_recursion.number("DDSCBF"),
        ],
        notes=_notes(found, ddscbf, blind.rate, scbf.rate),
    )


def _notes(
    bayesian: LearnedController, ddscbf: LearnedController, blind: float, known: float
) -> list[str]:
    note, rates = partial(CHAPTER.note, "table-6.3"), bayesian.rates
    spread = {"deviation": 100 * np.std(rates, ddof=1), "mean": 100 * np.mean(rates)}
    printed = PRINTED["DDSCBF"] - PRINTED["SCBF"]
    return [
        note("spread", count=len(rates), **spread),
        note("ddscbf", difference=ddscbf.describe(), printed=printed),
        note("noise", blind=blind, known=known),
        note("recursion"),
    ]


def _values(sample: Workload) -> dict[str, Any]:
    systems, short = (
        len(seeds(sample, _CONTROLLERS)),
        ", too short for a car to get near the other one,",
    )
    return {
        **generator_values(sample),
        "duration": f"{_world(sample).horizon:g} s{short if sample.quick else ''}",
        "count": sample.size(EPISODES),
        "systems": systems,
        "generators": min(systems, _GENERATORS),
        "fewer": "" if sample.quick else f" ({_FEW_CONTROLLERS} with K = {REPETITIONS[0]})",
    }


ARTEFACTS = (CHAPTER.artefact("table-6.3", compute, _values),)
