"""Table 6.2: safety in the disk with known, partly known and identified dynamics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import sympy as sp

from safe_envs import SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.agents.evaluation.contradiction import by_rate
from safe_envs.scripts.reproduce.chapter_6.cubic_drift import ENV, PRIOR
from safe_envs.scripts.reproduce.chapter_6.identifications import (
    CHAPTER,
    REPETITIONS,
    identified,
    seeds,
)
from safe_envs.scripts.reproduce.chapter_6.learned_controllers import (
    LearnedController,
    printed_rate,
    rate_of_one_more,
    similar,
)
from safe_envs.scripts.reproduce.chapter_6.worst_case import (
    above_worst,
    at_one_horizon,
    worst_for_ever,
)
from safe_envs.scripts.reproduce.framework.artefact import Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.paired import MeasuredFilter, measure
from safe_envs.wrappers import SCBF
from safe_envs.wrappers.learning.generator import GeneratorModel, learn_generator
from safe_envs.wrappers.learning.models.posterior import Posterior
from safe_envs.wrappers.verification.bounds import proposition_4_2_8, shortfall_repaired
from safe_envs.wrappers.verification.feasibility import verify

_SETTINGS = CHAPTER.settings["cubic"]
EPISODES, PLACES = _SETTINGS["episodes"], _SETTINGS["places"]
FEEBLE = tuple((u,) for u in _SETTINGS["feeble_inputs"])
CONTROLLERS, GENERATORS = 10, 3  # identifications of the system, and of the generator
LONG, QUICK_LONG, LONG_EPISODES = 400, 5, 250
"""Horizon in s, that of a quick sample, and episodes, at which the bound for ever is tried."""

_ANALYTICAL = "Analytical"
PRINTED = CHAPTER.printed("table-6.2")


def printed_generator(problem: SafetyProblem) -> sp.Expr:
    """Return A h by the formula of Sec. 6.3.1, with the numbers of the plant."""
    values = problem.plant.parameter_values
    (x_1, x_2), (u,) = problem.plant.states, problem.plant.inputs
    noise = 2 * values["sigma_2"] ** 2
    return 2 * values["a"] * x_1**2 + x_1 * x_2 - 2 * x_1**3 * x_2 - 2 * x_2**2 * u - noise


@dataclass(frozen=True)
class _Models:
    """What is learned for Table 6.2.

    Attributes:
        systems: identifications with the largest K.
        rough: with the smallest K.
        feeble: under the printed inputs.
        generators: of DDSCBF.
    """

    systems: list[Posterior]
    rough: list[Posterior]
    feeble: list[Posterior]
    generators: list[GeneratorModel]

    @classmethod
    def learn(cls, world: SafetyProblem, sample: Workload) -> _Models:
        """Learn all; a quick sample does without what is only compared with the table."""
        chosen = seeds(sample, CONTROLLERS)
        compared = () if sample.quick else chosen
        work = _generator_work(sample)
        most, least = REPETITIONS[-1], REPETITIONS[0]
        return cls(
            [identified(world, most, seed, PRIOR) for seed in chosen],
            [identified(world, least, seed, PRIOR) for seed in compared],
            [identified(world, most, seed, PRIOR, inputs=FEEBLE) for seed in compared],
            [learn_generator(world, seed=seed, **work) for seed in chosen[:GENERATORS]],
        )


def _generator_work(sample: Workload) -> dict[str, Any]:
    return {name: sample.work(_SETTINGS[f"generator_{name}"]) for name in ("points", "repetitions")}


@dataclass(frozen=True)
class _Column:
    """A start of Table 6.2, and its column.

    Attributes:
        name: of the start.
        problem: from there.
        printed: the printed rates and the printed bound, by row.
        models: what is learned.
        supremum: c of h.
        shortfall: m, by how much A h >= 0 is violated where no input meets it.
        sample: how much is simulated.
    """

    name: str
    problem: SafetyProblem
    printed: Mapping[str, float]
    models: _Models
    supremum: float
    shortfall: float
    sample: Workload

    @cached_property
    def scbf(self) -> MeasuredFilter:
        """Return the SCBF that knows the system."""
        return measure(self.problem, "scbf", self.sample.size(EPISODES), self.sample.seed)

    @cached_property
    def ddscbf(self) -> LearnedController:
        """Return DDSCBF with each learned generator."""
        return self.learned("ddscbf", self.models.generators)

    @cached_property
    def bayesian(self) -> LearnedController:
        """Return the Bayesian SCBF with each identification."""
        return self.learned("bayesian-scbf", self.models.systems)

    def learned(self, text: str, models: Sequence[Any]) -> LearnedController:
        """Return a learned filter with each model."""
        return LearnedController.run(self.problem, text, models, self.scbf, self.sample.seed)

    @property
    def barrier(self) -> float:
        """Return h at the start."""
        state = self.problem.starts[self.problem.start].state
        values = zip(self.problem.plant.states, state, strict=True)
        return float(self.problem.barriers[0].expression.subs(list(values)))

    @property
    def bound(self) -> float:
        """Return the worst case h/c, in per cent."""
        return 100 * float(proposition_4_2_8(self.barrier, self.supremum))

    @property
    def repaired(self) -> float:
        """Return the estimated bound (h - m T)/c."""
        horizon = self.problem.horizon
        return float(shortfall_repaired(self.barrier, self.supremum, self.shortfall, horizon))

    @property
    def withheld(self) -> str:
        """Return what the rate of the SCBF says against that; empty if nothing."""
        return by_rate(self.repaired, self.scbf.row.ci_high)

    def late(self) -> Number:
        """Return the rate of the SCBF at a long horizon."""
        problem = replace(self.problem, horizon=float(_long(self.sample)))
        return measure(problem, "scbf", self.sample.size(LONG_EPISODES), self.sample.seed).number(
            "late"
        )

    def numbers(self, bayesian: LearnedController) -> list[Number]:
        """Return the column of the table, with identifications of one kind."""
        rows = {"SCBF": self.scbf, "DDSCBF": self.ddscbf, "Bayesian SCBF": bayesian}
        found = [each.number(f"{row} {self.name}", self.printed[row]) for row, each in rows.items()]
        name = f"{_ANALYTICAL} {self.name}"
        return found if self.withheld else [*found, Number(name, 100 * self.repaired, unit="%")]

    def by_printed_formulas(self, dull: Sequence[float]) -> list[Number]:
        """Return the column by the printed formulas, and with rates from the printed inputs."""
        size, printed = (self.scbf.episodes, self.sample.seed), self.printed[_ANALYTICAL]
        name = f"Bayesian SCBF {self.name}"
        return [
            printed_rate(f"SCBF {self.name}", self.problem, printed_generator(self.problem), *size),
            *([rate_of_one_more(name, dull, self.scbf.episodes)] if dull else []),
            Number(f"{_ANALYTICAL} {self.name}", self.bound, printed=printed, unit="%"),
        ]

    def dull(self, models: Sequence[Posterior]) -> list[float]:
        """Return the rates with identifications of which all weights are kept, as in the thesis."""
        size = self.scbf.episodes, self.sample.seed
        systems = (replace(self.problem, model=model.mean_system) for model in models)
        return [measure(problem, "scbf", *size).rates[0] for problem in systems]


def compute(sample: Workload) -> Findings:
    """Compute Table 6.2."""
    world = make_problem(ENV)
    models, found = _Models.learn(world, sample), verify(world, [SCBF()], seed=sample.seed)
    worst = float(found.analysis.suprema[0]), float(found.analysis.max_shortfall[0])
    columns = [
        _Column(
            name,
            world.configured(start=start),
            {row: values[i] for row, values in PRINTED.items()},
            models,
            *worst,
            sample,
        )
        for i, (name, start) in enumerate(PLACES.items())
    ]
    # A quick sample learns nothing of what is only compared with the table.
    rough = {c.name: c.learned("bayesian-scbf", models.rough) for c in columns if models.rough}
    dull = {each.name: each.dull(models.feeble) for each in columns}
    few = [number for each in columns if rough for number in each.numbers(rough[each.name])]
    setting = f"K = {REPETITIONS[0]} in the identification"
    measured = {each.name: (each.numbers(each.bayesian)[:3], each.bound) for each in columns}
    return Findings(
        numbers=[number for each in columns for number in each.numbers(each.bayesian)],
        claims=[
            similar({each.name: each.bayesian for each in columns}),
            above_worst(world.horizon, measured),
            worst_for_ever(
                _long(sample), {each.name: (each.late(), each.bound) for each in columns}
            ),
        ],
        alternative_settings={setting: Findings(few, [similar(rough)])} if few else {},
        printed_formula=[
            number for each in columns for number in each.by_printed_formulas(dull[each.name])
        ],
        notes=_notes(columns, dull),
    )


def _notes(columns: Sequence[_Column], dull: Mapping[str, Sequence[float]]) -> list[str]:
    first, second = columns
    note = partial(CHAPTER.note, "table-6.2")
    found = {"shortfall": first.shortfall, "supremum": first.supremum}
    differences = {
        each.name: (each.ddscbf.describe(), each.printed["DDSCBF"] - each.printed["SCBF"])
        for each in columns
    }
    return [
        note("hypothesis", horizon=first.problem.horizon, **found),
        *(note("withheld", name=c.name, withheld=c.withheld) for c in columns if c.withheld),
        at_one_horizon(first.scbf, second.scbf, PRINTED["SCBF"]),
        *(
            note("ddscbf", name=name, difference=gap, printed=printed)
            for name, (gap, printed) in differences.items()
        ),
        *(
            note("dull", name=name, low=100 * min(rates), high=100 * max(rates))
            for name, rates in dull.items()
            if rates
        ),
    ]


def _long(sample: Workload) -> int:
    return QUICK_LONG if sample.quick else LONG


def _values(sample: Workload) -> dict[str, Any]:
    systems = len(seeds(sample, CONTROLLERS))
    return {
        **{f"{name}_used": value for name, value in _generator_work(sample).items()},
        "count": sample.size(EPISODES),
        "systems": systems,
        "generators": min(systems, GENERATORS),
        "long": _long(sample),
        "long_count": sample.size(LONG_EPISODES),
    }


ARTEFACTS = (CHAPTER.artefact("table-6.2", compute, _values),)
