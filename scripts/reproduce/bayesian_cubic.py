"""Chapter 6, the cubic system in a disk: the posterior of its noise, and how safe a controller is that rests on an identification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agents.evaluation import Evaluation, evaluate
from agents.problems import load_problem
from safe_envs.problem import SafetyProblem
from scripts.reproduce import cubic_drift
from scripts.reproduce.artefact import Artefact, Claim, Number, Outcome, Sample
from scripts.reproduce.cubic_drift import DATA, ENV, PRIOR
from scripts.reproduce.identifications import (
    DRAWS,
    FIT_ERRATA,
    NOISE_STARTS,
    NOISE_STEPS,
    REPETITIONS,
    SIGMA_ERRATA,
    draw_levels,
    identified,
    noise_levels,
    seeds,
)
from scripts.reproduce.learned_controllers import Learned, close, known, printed_totals, rate
from wrappers import SCBF
from wrappers.bounds import proposition_4_2_8, shortfall_repaired
from wrappers.learning.generator import GeneratorModel, learn_generator
from wrappers.learning.posterior import Posterior
from wrappers.verify import verify

EPISODES, CONTROLLERS, GENERATORS = 1000, 10, 3
"""Of Table 6.2: episodes, identifications of the system, of the generator."""

GENERATOR_POINTS, GENERATOR_REPETITIONS = 200, 50_000
LONG, QUICK_LONG, LONG_EPISODES = 400, 5, 250
"""Horizon in s, that of a quick sample, and episodes, at which the bound for ever is tried."""

FEEBLE = ((0.0,), (0.1,))
"""Inputs in 1/s from which the print identifies g."""

_PRINTED_RATES = {"SCBF": (91, 55), "DDSCBF": (88, 45), "Bayesian SCBF": (90, 43)}
_PRINTED_BOUND = (50, 35)
_PLACES = {"(-.1, .7)": "thesis-1", "(-.1, .8)": "thesis-2"}


def _noise_picture(sample: Sample) -> Outcome:
    return noise_levels(load_problem(ENV), sample, PRIOR, ("1/sqrt(s)", "1/sqrt(s)"))


def printed_generator(problem: SafetyProblem) -> Any:
    """A h as Sec. 6.3.1 prints it, with the numbers of the plant."""
    (x_1, x_2), (u,), values = problem.plant.states, problem.plant.inputs, {p.name: v for p, v in problem.plant.parameters.items()}
    noise = 2 * values["sigma_2"] ** 2
    return 2 * values["a"] * x_1**2 + x_1 * x_2 - 2 * x_1**3 * x_2 - 2 * x_2**2 * u - noise


def _long(sample: Sample) -> int:
    return QUICK_LONG if sample.quick else LONG


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
    def learn(cls, world: SafetyProblem, sample: Sample) -> _Models:
        """Learn all; a quick sample does without what is only shown beside the table."""
        chosen = seeds(sample, CONTROLLERS)
        beside = () if sample.quick else chosen
        sizes: dict[str, Any] = {"points": sample.work(GENERATOR_POINTS), "repetitions": sample.work(GENERATOR_REPETITIONS)}
        return cls(
            [identified(world, REPETITIONS[-1], seed, PRIOR) for seed in chosen],
            [identified(world, REPETITIONS[0], seed, PRIOR) for seed in beside],
            [identified(world, REPETITIONS[-1], seed, PRIOR, inputs=FEEBLE) for seed in beside],
            [learn_generator(world, seed=seed, **sizes) for seed in chosen[:GENERATORS]],
        )


@dataclass(frozen=True)
class _Worst:
    """What bounds the rate from below.

    Attributes:
        supremum: c of h.
        missed: m, by how much A h >= 0 is missed where no input meets it.
    """

    supremum: float
    missed: float


@dataclass(frozen=True)
class _Place:
    """A start of Table 6.2, and its column.

    Attributes:
        name: of the start.
        problem: from there.
        printed: the printed rates and the printed bound, by row.
        scbf: the one that knows the system.
        ddscbf: with each learned generator.
        bayesian: with each identification.
        worst: what holds for every start.
        late: the SCBF's rate at a long horizon.
    """

    name: str
    problem: SafetyProblem
    printed: Mapping[str, float]
    scbf: Evaluation
    ddscbf: Learned
    bayesian: Learned
    worst: _Worst
    late: Number

    @classmethod
    def run(cls, i: int, world: SafetyProblem, models: _Models, worst: _Worst, sample: Sample) -> _Place:
        """Evaluate all controllers from the i-th start."""
        name, start = list(_PLACES.items())[i]
        problem = world.configured(start=start)
        scbf = known(problem, sample.size(EPISODES), sample.seed)
        late = known(replace(problem, horizon=float(_long(sample))), sample.size(LONG_EPISODES), sample.seed)
        return cls(
            name,
            problem,
            {row: rates[i] for row, rates in _PRINTED_RATES.items()} | {"Analytical": _PRINTED_BOUND[i]},
            scbf,
            Learned.run(problem, "ddscbf", models.generators, scbf),
            Learned.run(problem, "bayesian-scbf", models.systems, scbf),
            worst,
            rate("late", late),
        )

    @property
    def bound(self) -> float:
        """The worst case h/c, in per cent."""
        return 100 * float(proposition_4_2_8(_barrier_at_start(self.problem), self.worst.supremum))

    @property
    def lowest(self) -> float:
        """The lowest end of an interval of the measured rates."""
        return min(number.low or 0.0 for number in self.numbers(self.bayesian)[:3])

    def numbers(self, bayesian: Learned) -> list[Number]:
        """The column of the table, with identifications of one kind."""
        h, name = _barrier_at_start(self.problem), {row: f"{row} {self.name}" for row in self.printed}
        repaired = 100 * float(shortfall_repaired(h, self.worst.supremum, self.worst.missed, self.problem.horizon))
        return [
            rate(name["SCBF"], self.scbf, self.printed["SCBF"]),
            self.ddscbf.number(name["DDSCBF"], self.printed["DDSCBF"]),
            bayesian.number(name["Bayesian SCBF"], self.printed["Bayesian SCBF"]),
            Number(name["Analytical"], repaired, printed=self.printed["Analytical"], unit="%"),
        ]

    def as_printed(self, sample: Sample, dull: Learned | None) -> list[Number]:
        """The column by the printed formulas, and from the printed inputs."""
        totals = printed_totals(self.problem, printed_generator(self.problem), sample.size(EPISODES), sample.seed)
        return [
            Number.rate(f"SCBF {self.name}", totals.safe, totals.episodes),
            *([] if dull is None else [dull.number(f"Bayesian SCBF {self.name}")]),
            Number(f"Analytical {self.name}", self.bound, unit="%"),
        ]

    def dull(self, models: Sequence[Posterior], sample: Sample) -> Learned:
        """The SCBF with identifications of which all weights are kept, as in print."""
        how: dict[str, Any] = {"episodes": sample.size(EPISODES), "seed": sample.seed, "bounds": False}
        found = [evaluate(replace(self.problem, model=model.mean_system), filters=["scbf"], **how) for model in models]
        return Learned([e.rows[0]["safety_rate"] for e in found], how["episodes"], (0.0, 0.0, 0.0))


def _rates(sample: Sample) -> Outcome:
    world = load_problem(ENV)
    models, found = _Models.learn(world, sample), verify(world, [SCBF()], seed=sample.seed)
    worst = _Worst(float(found.survey.suprema[0]), float(found.survey.missed[0]))
    places = [_Place.run(i, world, models, worst, sample) for i in range(len(_PLACES))]
    few, wrong, notes = [], [], []
    for place in places:
        if sample.quick:
            wrong += place.as_printed(sample, None)
            continue
        rough = Learned.run(place.problem, "bayesian-scbf", models.rough, place.scbf)
        dull = place.dull(models.feeble, sample)
        few += place.numbers(rough)
        wrong += place.as_printed(sample, dull)
        notes.append(
            f"{place.name}: with K = {REPETITIONS[0]} the Bayesian SCBF differs from the SCBF by {rough.told}; identified under 0 and .1, "
            f"with all weights kept, its rates are {100 * min(dull.rates):.0f} to {100 * max(dull.rates):.0f} %."
        )
    return Outcome(
        numbers=[number for place in places for number in place.numbers(place.bayesian)],
        claims=_claims(places, world.horizon, _long(sample)),
        elsewhere={f"K = {REPETITIONS[0]} in the identification": Outcome(few)} if few else {},
        as_printed=wrong,
        notes=[
            f"The hypothesis fails: no input keeps A h >= 0 near the centre: it is missed by up to {worst.missed:.3f}. What holds is "
            f"(h - {worst.missed:.3f} T)/{worst.supremum:g}, the number of ours in the row 'Analytical', at T = {world.horizon:g} s.",
            _at_one_horizon([place.scbf.rows[0]["curve"] for place in places]),
            *notes,
        ],
    )


def _claims(places: Sequence[_Place], horizon: float, long: int) -> list[Claim]:
    return [
        close("Bayesian SCBF", {place.name: place.bayesian for place in places}),
        close("DDSCBF", {place.name: place.ddscbf for place in places}),
        Claim(
            f"Within {horizon:g} s all measured rates are above the worst case h/c.",
            all(place.lowest > place.bound for place in places),
            "; ".join(f"{place.name}: {place.lowest:.1f} % or more, h/c {place.bound:.0f} %" for place in places),
        ),
        Claim(
            f"h/c is a worst case for ever; here up to {long} s.",
            all((place.late.high or 0.0) >= place.bound for place in places),
            "; ".join(
                f"{place.name}: SCBF {place.late.ours:.1f} % [{place.late.low:.1f}, {place.late.high:.1f}], h/c {place.bound:.0f} %"
                for place in places
            ),
        ),
    ]


def _at_one_horizon(curves: Sequence[dict[str, Any]]) -> str:
    """What the SCBF's rate from the second start is when that from the first one is the printed one."""
    first, second = (100 * np.array(curve["rate"]) for curve in curves)
    wanted = _PRINTED_RATES["SCBF"]
    k = int(abs(first - wanted[0]).argmin())
    return (
        f"The SCBF's rate from the first start is nearest to the printed {wanted[0]} % at T = {curves[0]['time'][k]:.2f} s; from the "
        f"second one it is {second[k]:.1f} % then, not {wanted[1]} %: no horizon gives both."
    )


def _barrier_at_start(problem: SafetyProblem) -> float:
    """H at the start."""
    start = dict(zip(problem.plant.states, problem.starts[problem.start].state, strict=True))
    return float(problem.barriers[0].expression.subs(list(start.items())))


ARTEFACTS: tuple[Artefact, ...] = (
    cubic_drift.FIGURE,
    Artefact(
        name="figure-6.2",
        title="Posterior of the noise levels of the cubic system",
        compute=_noise_picture,
        setting=(f"{NOISE_STARTS} trajectories of {NOISE_STEPS} steps of .01 s, {DRAWS} draws, sigma_1 = sigma_2 = .2",),
        chosen=("input 0 while the residuals are collected",),
        corrections=SIGMA_ERRATA,
        draw=draw_levels,
        size=(7.0, 3.2),
    ),
    cubic_drift.TABLE,
    Artefact(
        name="table-6.2",
        title="Safety in the disk with known, partly known and identified dynamics",
        compute=_rates,
        setting=(
            f"{ENV}, sigma = .2, nominal input 0, abs(u) <= 10, control period .01 s, 1 s, {EPISODES} episodes",
            f"Bayesian: {CONTROLLERS} identifications from {DATA}, K = {REPETITIONS[-1]}, inputs -1 and 1; DDSCBF: {GENERATORS} "
            f"identifications from {GENERATOR_POINTS} states, {GENERATOR_REPETITIONS} steps from each; intervals over both",
        ),
        chosen=("horizon 1 s", "abs(u) <= 10", f"K = {REPETITIONS[-1]} in the identification, and 10 beside it"),
        corrections=(
            "A h of Sec. 6.3.1 has 2 x1 x2, not x1 x2, and sigma_1^2 + sigma_2^2",
            "Sec. 6.3.1: u = .1 does not identify g; inputs of both signs do",
            "Def. 4.2.6 (iii) fails at x2 = 0, abs(x1) < .258, so that h/c does not apply: (h - m T)/c",
            *FIT_ERRATA,
        ),
        orderings=(
            *((f"{name} (-.1, .7)", f"{name} (-.1, .8)") for name in (*_PRINTED_RATES, "Analytical")),
            *((f"SCBF {place}", f"Analytical {place}") for place in _PLACES),
            *(("SCBF (-.1, .8)", f"{name} (-.1, .8)") for name in ("DDSCBF", "Bayesian SCBF")),
        ),
        argument="at no horizon has the SCBF both printed rates (see the notes), nor has it with the printed A h; and with f and g known "
        "DDSCBF is the SCBF but for a fraction of a point, so that the 10 points between them are not its own",
    ),
)
