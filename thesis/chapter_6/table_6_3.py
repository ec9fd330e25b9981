"""Tables 6.3 and 6.4: safety of the car, and the time to learn it (Sec. 6.3.2)."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import sympy as sp

from safe_envs import SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.filters.learning.generator import learn_generator
from safe_envs.filters.learning.models.generator import GeneratorModel
from thesis.artefact import Claim, Number, Outcome, Sample, settings, texts
from thesis.chapter_6 import bayes
from thesis.chapter_6.bayes import FEWEST, MOST
from thesis.rates import MeasuredFilter, measure

CAR = settings(6, "car")
PRINTED, PRINTED_SECONDS = (texts()[name].printed for name in ("table-6.3", "table-6.4"))
RECURSION, BAYESIAN = PRINTED_SECONDS
START = "(10, 15)"  # m/s, m


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


def _size(sample: Sample) -> dict[str, Any]:
    """Return the amount of data of DDSCBF, as `learn_generator` takes it."""
    return {
        "points": sample.work(CAR.generator_points),
        "repetitions": sample.work(CAR.generator_repetitions),
    }


@cache
def recursion(sample: Sample) -> GeneratorModel:
    """Return DDSCBF's networks by the printed estimate, learned once for both tables."""
    problem, seed = make_problem(CAR.env), bayes.seeds(sample, 1)[0]
    size = _size(sample)
    return learn_generator(problem, way="network", estimator="printed", seed=seed, **size)


def compute_rates(sample: Sample) -> tuple[Outcome, None]:
    """Compute Table 6.3."""
    problem = make_problem(CAR.env)
    problem = replace(problem, horizon=CAR.quick_horizon) if sample.quick else problem
    size, chosen = (sample.size(CAR.episodes), sample.seed), bayes.seeds(sample, CAR.controllers)
    scbf = measure(problem, "scbf", *size)
    generators = [
        learn_generator(problem, way="direct", seed=seed, **_size(sample))
        for seed in chosen[: CAR.generators]
    ]
    ddscbf = measure(problem, "ddscbf", *size, generators)

    def bayesian(repetitions: int, count: int) -> MeasuredFilter:
        models = [bayes.identified(problem, repetitions, s, CAR.prior) for s in chosen[:count]]
        return measure(problem, "bayesian-scbf", *size, models)

    def table(found: MeasuredFilter) -> Outcome:
        learned = {"DDSCBF": ddscbf, "Bayesian SCBF": found}
        rates = [
            bayes.rate_of_one_more(name, each.flags, PRINTED[name])
            for name, each in learned.items()
        ]
        return Outcome(
            [scbf.number("SCBF", PRINTED["SCBF"]), *rates], [bayes.similar({START: (found, scbf)})]
        )

    found, others = bayesian(MOST, CAR.controllers), {}
    if not sample.quick:  # which does without what is only compared with the table
        few = bayesian(FEWEST, CAR.few_controllers)
        others = {f"K = {FEWEST} in the identification": table(few)}
    blind = measure(problem.configured(model={"sigma_1": 0.0, "sigma_2": 0.0}), "scbf", *size)
    return replace(
        table(found),
        alternative_settings=others,
        printed_formula=[
            bayes.printed_rate("SCBF", problem, printed_second_generator(problem), *size),
            measure(problem, "ddscbf", *size, [recursion(sample)]).number("DDSCBF"),
        ],
        notes=[
            f"One identification differs from the next: the rates of {len(found.rates)} have the"
            f" standard deviation {100 * np.std(found.rates, ddof=1):.0f} points, and the mean"
            f" {100 * np.mean(found.rates):.0f} %.",
            f"DDSCBF differs from the SCBF by {bayes.against(ddscbf, scbf)}; in the thesis by"
            f" {PRINTED['DDSCBF'] - PRINTED['SCBF']:+g} points.",
            "The noise is all that DDSCBF learns; an SCBF that assumes none is safe in"
            f" {blind.rate:.1f} %, compared with {scbf.rate:.1f} %.",
        ],
    ), None


def sooner(ratio: float) -> list[Claim]:
    """Return the claims that identifying takes less time than the recursion, by its share.

    Source: thesis Sec. 7.1, which calls that dramatic, and gives no factor.
    """
    printed = PRINTED_SECONDS[RECURSION] / PRINTED_SECONDS[BAYESIAN]
    evidence = f"{ratio:.3g} times; more than {printed:.0f} times in the thesis"
    sentence = "Identifying the system first takes less time than the recursion."
    far = f"It is at least {CAR.far_less:g} times less."
    return [
        Claim(sentence, ratio > 1.0, evidence),
        Claim(far, ratio >= CAR.far_less, evidence, printed=False),
    ]


def compute_times(sample: Sample) -> tuple[Outcome, None]:
    """Compute Table 6.4."""
    problem, seed = make_problem(CAR.env), bayes.seeds(sample, 1)[0]
    recursive = recursion(sample).record.seconds
    direct = learn_generator(problem, way="direct", seed=seed, **_size(sample)).record.seconds
    seconds = []
    for seed in bayes.seeds(sample, CAR.timed):
        begun = time.perf_counter()
        bayes.identified(problem, MOST, seed, CAR.prior)
        seconds.append(time.perf_counter() - begun)
    quick = bayes.predicted(BAYESIAN, seconds, PRINTED_SECONDS[BAYESIAN], "s")
    return Outcome(
        numbers=[
            Number(RECURSION, recursive, printed=PRINTED_SECONDS[RECURSION], unit="s"),
            quick,
            Number("DDSCBF, covariance of the noise learned once", direct, unit="s"),
        ],
        claims=sooner(recursive / quick.ours),
    ), None


ARTEFACTS = {"table-6.3": compute_rates, "table-6.4": compute_times}
