"""Table 6.2: safety in the disk with known, partly known and identified dynamics (Sec. 6.3.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import sympy as sp

from safe_envs import SafetyProblem
from safe_envs.agents import make_problem
from safe_envs.agents.evaluation.bounds import by_rate
from safe_envs.filters.learning.generator import learn_generator
from safe_envs.filters.learning.models.posterior import Posterior
from safe_envs.proofs.feasibility import verify
from safe_envs.proofs.guarantees import stage_bound
from safe_envs.wrappers import SCBF
from thesis.artefact import Claim, Number, Outcome, Sample, settings, texts
from thesis.chapter_6 import bayes
from thesis.chapter_6.bayes import FEWEST, MOST
from thesis.rates import MeasuredFilter, measure
from thesis.verdict import disagreement

CUBIC = settings(6, "cubic")
PRINTED = texts()["table-6.2"].printed
FEEBLE = tuple((u,) for u in CUBIC.feeble_inputs)


def printed_generator(problem: SafetyProblem) -> sp.Expr:
    """Return A h by the formula of Sec. 6.3.1, with the numbers of the plant."""
    values = problem.plant.parameter_values
    (x_1, x_2), (u,) = problem.plant.states, problem.plant.inputs
    noise = 2 * values["sigma_2"] ** 2
    return 2 * values["a"] * x_1**2 + x_1 * x_2 - 2 * x_1**3 * x_2 - 2 * x_2**2 * u - noise


@dataclass(frozen=True)
class Column:
    """A start of the table, and its column.

    Attributes:
        place: name of the start.
        problem: from there.
        printed: rates and the bound, by row, in per cent.
        scbf: that knows the system.
        ddscbf: with each learned generator.
        bayesian: with each identification of the system.
        bound: the worst case h/c, in per cent.
        repaired: (h - m T)/c, in per cent.
    """

    place: str
    problem: SafetyProblem
    printed: Mapping[str, float]
    scbf: MeasuredFilter
    ddscbf: MeasuredFilter
    bayesian: MeasuredFilter
    bound: float
    repaired: float

    @property
    def withheld(self) -> str:
        """What the rate of the SCBF says against the repaired bound; empty if nothing."""
        return by_rate(self.repaired / 100, self.scbf.row.ci_high)

    def rates(self, bayesian: MeasuredFilter) -> list[Number]:
        """Return the measured rates, with identifications of one kind."""
        learned = {"DDSCBF": self.ddscbf, "Bayesian SCBF": bayesian}
        return [
            self.scbf.number(f"SCBF {self.place}", self.printed["SCBF"]),
            *(
                bayes.rate_of_one_more(f"{row} {self.place}", each.flags, self.printed[row])
                for row, each in learned.items()
            ),
        ]

    def numbers(self, bayesian: MeasuredFilter) -> list[Number]:
        """Return the column, with the repaired bound unless the episodes contradict it."""
        bound = Number(f"Analytical {self.place}", self.repaired, unit="%")
        return [*self.rates(bayesian), *([] if self.withheld else [bound])]


def compute(sample: Sample) -> tuple[Outcome, None]:
    """Compute Table 6.2; a quick sample does without what is only compared with it."""
    world, size = make_problem(CUBIC.env), (sample.size(CUBIC.episodes), sample.seed)
    chosen = bayes.seeds(sample, CUBIC.controllers)
    compared = () if sample.quick else chosen
    amount: dict[str, Any] = {
        "points": sample.work(CUBIC.generator_points),
        "repetitions": sample.work(CUBIC.generator_repetitions),
    }
    systems = [bayes.identified(world, MOST, seed, CUBIC.prior) for seed in chosen]
    rough = [bayes.identified(world, FEWEST, seed, CUBIC.prior) for seed in compared]
    feeble = [bayes.identified(world, MOST, s, CUBIC.prior, inputs=FEEBLE) for s in compared]
    generators = [learn_generator(world, seed=s, **amount) for s in chosen[: CUBIC.generators]]
    analysis = verify(world, [SCBF()], seed=sample.seed).analysis
    supremum, shortfall = float(analysis.suprema[0]), float(analysis.max_shortfall[0])
    columns = []
    for i, (place, start) in enumerate(CUBIC.places.items()):
        problem = world.configured(start=start)
        state = zip(problem.plant.states, problem.starts[start].state, strict=True)
        h = float(problem.barriers[0].expression.subs(list(state)))
        columns.append(
            Column(
                place,
                problem,
                {row: values[i] for row, values in PRINTED.items()},
                measure(problem, "scbf", *size),
                measure(problem, "ddscbf", *size, generators),
                measure(problem, "bayesian-scbf", *size, systems),
                100 * float(stage_bound(h, supremum)),
                100 * float(stage_bound(h, supremum, problem.horizon, shortfall=shortfall)),
            )
        )
    others = {}
    if rough:
        few = [(c, measure(c.problem, "bayesian-scbf", *size, rough)) for c in columns]
        others[f"K = {FEWEST} in the identification"] = Outcome(
            [number for c, found in few for number in c.numbers(found)],
            [bayes.similar({c.place: (found, c.scbf) for c, found in few})],
        )
    late_size = sample.size(CUBIC.long_episodes), sample.seed
    long = CUBIC.quick_long_horizon if sample.quick else CUBIC.long_horizon
    late = [measure(replace(c.problem, horizon=float(long)), "scbf", *late_size) for c in columns]
    return Outcome(
        [number for c in columns for number in c.numbers(c.bayesian)],
        [
            bayes.similar({c.place: (c.bayesian, c.scbf) for c in columns}),
            above_worst(world.horizon, {c.place: (c.rates(c.bayesian), c.bound) for c in columns}),
            worst_for_ever(
                long,
                {c.place: (r.number(""), c.bound) for c, r in zip(columns, late, strict=True)},
            ),
        ],
        others,
        [number for c in columns for number in _by_printed_formulas(c, size, feeble)],
        notes=[
            "No input keeps A h >= 0 near the centre, as h/c presumes: it is violated by up to"
            f" {shortfall:.3f}. The row 'Analytical' of ours is the repaired bound (h -"
            f" {shortfall:.3f} T)/{supremum:g} at T = {world.horizon:g} s, estimated with the m and"
            " c found; h/c is in that row by the printed formula.",
            *(
                f"{c.place}: the repaired bound is withheld: {c.withheld}"
                for c in columns
                if c.withheld
            ),
            at_one_horizon(columns[0].scbf, columns[1].scbf, PRINTED["SCBF"]),
            *(
                f"{c.place}: with f and g known DDSCBF differs from the SCBF by"
                f" {bayes.against(c.ddscbf, c.scbf)}; in the thesis by"
                f" {c.printed['DDSCBF'] - c.printed['SCBF']:+g} points."
                for c in columns
            ),
        ],
    ), None


def _by_printed_formulas(
    column: Column, size: tuple[int, int], feeble: Sequence[Posterior]
) -> list[Number]:
    """Return the column by the printed formulas, and with rates from the printed inputs.

    All weights of these identifications are kept, as in the thesis.
    """
    place, problem = column.place, column.problem
    systems = [replace(problem, model=model.mean_system) for model in feeble]
    flags = [measure(system, "scbf", *size).flags[0] for system in systems]
    bound = Number(
        f"Analytical {place}", column.bound, printed=column.printed["Analytical"], unit="%"
    )
    return [
        bayes.printed_rate(f"SCBF {place}", problem, printed_generator(problem), *size),
        *([bayes.rate_of_one_more(f"Bayesian SCBF {place}", flags)] if flags else []),
        bound,
    ]


def above_worst(horizon: float, each: Mapping[str, tuple[Sequence[Number], float]]) -> Claim:
    """Return the claim that measured rates are above the worst case, by their lower ends.

    `each` holds the rates up to a horizon in s and h/c, in per cent, by the start.
    """
    lowest = {
        place: (min(number.low or 0.0 for number in rates), bound)
        for place, (rates, bound) in each.items()
    }
    return Claim(
        f"Within {horizon:g} s all measured rates are above the worst case h/c.",
        all(low > bound for low, bound in lowest.values()),
        "; ".join(
            f"{place}: lower ends from {low:.1f} %, h/c {bound:.0f} %"
            for place, (low, bound) in lowest.items()
        ),
    )


def worst_for_ever(seconds: float, each: Mapping[str, tuple[Number, float]]) -> Claim:
    """Return the claim that no rate falls below the worst case in a long time.

    `each` holds the rate after that and h/c, in per cent, by the start.
    """
    return Claim(
        f"h/c is a worst case for ever; here up to {seconds:g} s.",
        all(rate.ends[1] >= bound for rate, bound in each.values()),
        "; ".join(
            f"{place}: SCBF {rate.text}, h/c {bound:.0f} %" for place, (rate, bound) in each.items()
        ),
    )


def at_one_horizon(first: MeasuredFilter, second: MeasuredFilter, printed: Sequence[float]) -> str:
    """Return whether the rates from two starts are the printed ones at one horizon, in words."""
    times = first.row.curve.time
    curves = [each.at_each_horizon(p) for each, p in zip((first, second), printed, strict=True)]
    both = [
        time for time, *pair in zip(times, *curves, strict=True) if not any(map(disagreement, pair))
    ]
    if both:
        return (
            f"The SCBF has both printed rates at the same horizon at {len(both)} of {len(times)}"
            f" instants, first at T = {both[0]:.2f} s."
        )
    k = min(range(len(times)), key=lambda k: abs(curves[0][k].ours - printed[0]))
    return (
        f"At none of {len(times)} instants up to T = {times[-1]:g} s has the SCBF both printed"
        f" rates: from the first start it is nearest to {printed[0]:g} % at T = {times[k]:.2f} s,"
        f" with {curves[0][k].ours:.1f} %, and has {curves[1][k].ours:.1f} % from the second one"
        f" then, {printed[1]:g} % in the thesis."
    )


ARTEFACTS = {"table-6.2": compute}
