"""The pendulum under unknown noise (thesis Sec. 5.4.1), and what its artefacts share with those of the cubic system."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, get_args

import numpy as np
from matplotlib.figure import Figure

from agents.comparison import compare_all
from agents.evaluation import evaluate
from agents.problems import load_problem
from agents.repeats import pooled
from agents.statistics import repeated_interval
from agents.verification import starts_of
from safe_envs.calculus import gradient, ito_term
from safe_envs.codegen import compile_function
from safe_envs.problem import SafetyProblem
from scripts.figure import COLORS, QUIET, add_legend
from scripts.reproduce.artefact import Artefact, Claim, Number, Outcome, Sample
from scripts.reproduce.verdict import agrees
from wrappers import DDSCBF, SCBF, SafetyFilter
from wrappers.learning.collect import collect, draw_states
from wrappers.learning.estimators import Estimator, ito_part, rates
from wrappers.learning.generator import GeneratorModel, learn_generator
from wrappers.promise import promise
from wrappers.verify import verify

ENV = "safe_envs/Pendulum-v0"
NOISE = 0.1  # sigma, in 1/sqrt(s)
NEAR = {"start": "near-origin", "horizon": 20.0}  # setting B: from (.1 rad, .1 rad/s); s
ALL = {"start": "uniform", "horizon": 2.0}  # setting A: from all of C
ALPHA_NEAR, ALPHA_ALL = 1.0, 5.0  # class-K rates of the CBF in both, in 1/s
LONG_NEAR, LONG_ALL = 40.0, 5.0  # up to which horizons the printed rates are looked for, in s
UNBOUNDED = [-1e4, 1e4]  # a box that is never met, in N m
EPISODES = 1000
SCBF_PRINTED, DDSCBF_PRINTED, CBF_PRINTED = 92.0, 91.0, 0.0  # of Table 5.1, in %

POINTS, REPETITIONS = 200, 50_000  # of Algorithm 2: start states, and one-step transitions from each
IDENTIFICATIONS = 3
VALIDATION = 400  # states at which errors are measured
NO_RATE = 1e-12  # rate of a CBF without its class-K term, in 1/s: such a function has to increase
CLOSE = 0.1  # largest rms error of a learned term, as part of the term: then it is ten times better than none

_LABELS = "rms error of the training data"
_NETWORK = "rms error of the network"


@dataclass(frozen=True)
class Lesson:
    """What an identification learned: models by estimator, and of a whole lesson the labels at the states x of its data."""

    learned: dict[str, GeneratorModel]
    x: np.ndarray
    labels: dict[str, np.ndarray]


@dataclass(frozen=True)
class Rates:
    """Rows of `evaluate` by filter; differences in points with intervals, of a filter less one that was asked for before it."""

    rows: dict[str, Any]
    differences: dict[tuple[str, str], tuple[float, float, float]]

    def number(self, name: str, filter_name: str, printed: float | None = None) -> Number:
        """The rate of a filter, beside a printed one of 1000 runs."""
        row = self.rows[filter_name]
        rate, low, high = (100 * row[key] for key in ("safety_rate", "ci_low", "ci_high"))
        return Number(name, rate, low, high, printed, None if printed is None else EPISODES, "%")

    def apart(self, first: str, second: str) -> str:
        """A difference in words."""
        difference, low, high = self.differences[first, second]
        return f"{difference:+.1f} points [{low:.1f}, {high:.1f}]"


@lru_cache(maxsize=8)
def lesson(env_id: str, noise: float, points: int, repetitions: int, seed: int, whole: bool) -> Lesson:
    """Follow Algorithm 2 at one noise level; `whole` adds the printed estimator and all labels."""
    problem = load_problem(env_id, {"noise": noise})
    data = collect(problem, points, repetitions, [[0.0]], seed=seed)
    estimators: tuple[Estimator, ...] = ("martingale", "printed") if whole else ("martingale",)
    learned = {name: learn_generator(problem, data=data, estimator=name, seed=seed) for name in estimators}
    if not whole:
        return Lesson(learned, data.x, {})
    h, plant = problem.barriers[0].expression, problem.plant
    value, slopes = (compile_function(plant.states, tuple(plant.numeric(e) for e in part), "arrays") for part in ([h], gradient(plant, h)))
    rate = rates(problem.model, data)
    labels = {e: ito_part(data, rate, lambda x: value(*x)[0], lambda x: slopes(*x), e).values for e in get_args(Estimator)}
    return Lesson(learned, data.x, labels)


def lessons(env_id: str, noise: float, sample: Sample) -> list[Lesson]:
    """Several identifications, the first of them whole."""
    count = 1 if sample.quick else IDENTIFICATIONS
    children = (np.random.SeedSequence(sample.seed, spawn_key=(r, 0)).generate_state(1)[0] for r in range(1, count))
    seeds = [sample.seed, *map(int, children)]
    return [lesson(env_id, noise, sample.work(POINTS), sample.work(REPETITIONS), seed, r == 0) for r, seed in enumerate(seeds)]


def measured(env_id: str, options: dict[str, Any], filters: Sequence[str], models: Sequence[GeneratorModel], sample: Sample) -> Rates:
    """Rates of filters that learn nothing, and then of the learned one with each of several models."""
    how: dict[str, Any] = {"options": options, "episodes": sample.size(EPISODES), "seed": sample.seed, "bounds": False}
    runs = {name: [evaluate(env_id, filters=[name], **how)] for name in filters}
    if models:
        runs["ddscbf"] = [evaluate(env_id, filters=["ddscbf"], learned=[model], **how) for model in models]
    rows = {name: pooled([run.rows[0] for run in each], 0.95) for name, each in runs.items()}
    found = compare_all({name: [flags for run in each for flags in run.flags[name]] for name, each in runs.items()}, 0.95)
    differences = {(c["first"], c["second"]): (100 * c["difference"], 100 * c["ci_low"], 100 * c["ci_high"]) for c in found}
    return Rates(rows, differences)


def resolution(first: float, second: float) -> float:
    """What separate samples of the printed size can tell apart with 95 %, in points, by the two rates in %."""
    return 196 * math.sqrt(sum(p / 100 * (1 - p / 100) for p in (first, second)) / EPISODES)


def printed_gap(first: float, second: float) -> str:
    """What a printed difference of two rates in % is worth."""
    return f"the printed {first:g} and {second:g} % are {first - second:.2g} +- {resolution(first, second):.1f} points apart: not an order"


def close(rates_: Rates, scbf: float, ddscbf: float, where: str = "") -> Claim:
    """Whether learning costs less than the print could have told apart, by the two printed rates in %."""
    limit = resolution(scbf, ddscbf)
    _, low, high = rates_.differences["ddscbf", "scbf"]
    said = f"DDSCBF - SCBF = {rates_.apart('ddscbf', 'scbf')}, over identifications and episodes; limit {limit:.1f} points"
    return Claim(f"DDSCBF is as safe as SCBF{where}", -limit <= low and high <= limit, f"{said}, what two samples of {EPISODES} tell apart")


def curve(row: dict[str, Any]) -> dict[str, list[float]]:
    """Rate in % over time."""
    return {"time": row["curve"]["time"], "rate": [100 * rate for rate in row["curve"]["rate"]]}


def learning_outcome(env_id: str, noise: float, state: int, sample: Sample) -> Outcome:
    """How near the learned Ito term is to the true one, which depends on one state alone."""
    problem, learned = load_problem(env_id, {"noise": noise}), lessons(env_id, noise, sample)
    first = learned[0]
    x = draw_states(problem, VALIDATION, np.random.default_rng(sample.seed))
    pairs = [next(iter(each.learned["martingale"].compare(problem, x).values())) for each in learned]
    truth, by_printed = next(iter(first.learned["printed"].compare(problem, x).values()))
    expression = problem.plant.numeric(ito_term(problem.plant, problem.barriers[0].expression))
    term = compile_function((problem.plant.states[state],), (expression,), "arrays")
    missed = {name: values - term(first.x[:, state])[0] for name, values in first.labels.items()}
    errors, signal = [_rms(estimate - true) for true, estimate in pairs], _rms(truth)
    error = float(np.mean(errors))
    ends = repeated_interval(errors, (error, error), 0.95, (0.0, math.inf)) if len(errors) > 1 else (None, None)
    grid = np.linspace(*problem.exploration.region[state], 200)
    return Outcome(
        numbers=[
            _root_mean_square("rms of the analytic term", truth),
            Number(_NETWORK, error, *ends, unit="1/s"),
            _root_mean_square(_LABELS, missed["martingale"]),
            _root_mean_square(f"{_LABELS}, centred only", missed["centred"]),
        ],
        claims=[
            Claim(
                "the trained network follows the analytic term",
                error < CLOSE * signal,
                f"rms error {error:.2g} 1/s, {error / signal:.1%} of the term's rms; limit {CLOSE:.0%}, ten times nearer than no term",
            )
        ],
        as_printed=[_root_mean_square(_NETWORK, by_printed - truth), _root_mean_square(_LABELS, missed["printed"])],
        data={
            "state": f"{problem.states[state].symbol.name} ({problem.states[state].unit})".removesuffix(" ()"),
            "grid": grid.tolist(),
            "term": term(grid)[0].tolist(),
            "points": first.x[:, state].tolist(),
            "validation": x[:, state].tolist(),
            "repaired": {"labels": first.labels["martingale"].tolist(), "network": pairs[0][1].tolist()},
            "printed": {"labels": first.labels["printed"].tolist(), "network": by_printed.tolist()},
        },
        notes=_why_printed_fails(problem, first, missed["printed"], sample.work(REPETITIONS)),
    )


def _why_printed_fails(problem: SafetyProblem, first: Lesson, missed: np.ndarray, repetitions: int) -> list[str]:
    """The printed estimator's error, its bias in closed form, and its noise."""
    plant, h = problem.plant, problem.barriers[0].expression
    bias = (plant.drift.T * gradient(plant, h).jacobian(plant.states) * plant.drift)[0, 0] / 2 * problem.dt
    read = compile_function(plant.states, (plant.numeric(bias), plant.numeric(h)), "arrays")
    predicted, level = read(*np.ascontiguousarray(first.x.T))
    noise = next(value for name, value in first.learned["printed"].record.errors.items() if "standard error" in name)
    signal, added = _rms(first.labels["martingale"]), _rms(level / (repetitions * problem.dt))
    return [
        f"Eq. (5.17), (5.18) miss by {_rms(missed):.2g} 1/s rms, {_rms(missed) / signal:.1f} times the term itself: of that the bias "
        f"dt/2 f' h_xx f is {_rms(predicted):.2g}, and the noise of {repetitions} transitions {noise:.2g}, "
        f"{noise / signal:.2g} of the term; a smaller dt would lower the one and raise the other",
        f"the sum of Eq. (5.17) from j = 0 would add h/(n dt), {added:.2g} 1/s rms: not in these numbers",
    ]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _root_mean_square(name: str, values: np.ndarray) -> Number:
    """With the normal interval of the mean square over the states."""
    square = np.square(values)
    mean, half = float(square.mean()), 1.96 * float(square.std(ddof=1)) / math.sqrt(len(square))
    return Number(name, math.sqrt(mean), math.sqrt(max(mean - half, 0.0)), math.sqrt(mean + half), unit="1/s")


def draw_learning(figure: Figure, outcome: Outcome) -> None:
    """The learned term over the state that it depends on: by the repaired estimator, and by the printed one."""
    data = outcome.data
    panels = list(figure.subplots(1, 2))
    for axes, key, title in zip(panels, ("repaired", "printed"), ("(a) repaired estimator", "(b) estimator as printed"), strict=True):
        axes.plot(data["grid"], data["term"], color=COLORS[3], linewidth=5.0, alpha=0.7, label="analytic term")
        axes.plot(data["points"], data[key]["labels"], ".", color="black", markersize=5, label="training data")
        axes.plot(data["validation"], data[key]["network"], ".", color=COLORS[0], markersize=2.2, label="network, other states")
        axes.axhline(0.0, color=QUIET, linewidth=0.6, zorder=0)
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 2))
        axes.set(xlabel=data["state"], title=title)
    panels[0].set_ylabel("noise part of the generator of h (1/s)")
    add_legend(figure, panels[0].get_legend_handles_labels()[0])


def _table(sample: Sample) -> Outcome:
    near = {**NEAR, "horizon": sample.work(round(2 * NEAR["horizon"])) / 2}
    learned = lessons(ENV, NOISE, sample)
    models, printed = [each.learned["martingale"] for each in learned], [learned[0].learned["printed"]]
    cbf, without, cbf_all = f"cbf:alpha={ALPHA_NEAR}", f"cbf:alpha={NO_RATE}", f"cbf:alpha={ALPHA_ALL}"
    here = measured(ENV, near, [cbf, without, "scbf"], models, sample)
    there = measured(ENV, ALL, [cbf_all, without, "scbf"], models, sample)
    still = evaluate(ENV, filters=[cbf], options={**near, "noise": 0.0}, episodes=1, bounds=False).rows[0]["safe"] == 1
    literal = measured(ENV, near, [], printed, sample)
    free = measured(ENV, {**ALL, "box": UNBOUNDED}, [], printed, sample)
    unsafe, lowest = here.rows[cbf]["violations"], 100 * here.rows["ddscbf"]["ci_low"]
    return Outcome(
        numbers=_numbers(here, cbf),
        claims=[
            close(here, SCBF_PRINTED, DDSCBF_PRINTED),
            Claim("DDSCBF is safe in more than 90 %", lowest > 90.0, f"its interval begins at {lowest:.1f} %"),
            Claim("every trajectory is unsafe with the CBF", here.rows[cbf]["safe"] == 0, f"{here.rows[cbf]['safe']} safe ones"),
            Claim(
                "it is the noise that makes the CBF unsafe",
                still and unsafe > 0,
                f"without it the trajectory is {'safe' if still else 'unsafe'}; with it {unsafe} are unsafe",
            ),
        ],
        elsewhere={f"setting A: uniform in C, {ALL['horizon']:g} s, CBF with alpha = {ALPHA_ALL:g}": Outcome(_numbers(there, cbf_all))},
        as_printed=[literal.number("DDSCBF", "ddscbf", DDSCBF_PRINTED)],
        data={name: {text: curve(row) for text, row in found.rows.items()} for name, found in (("B", here), ("A", there))},
        notes=[
            f"the gap of SCBF to CBF is the class-K term: SCBF - CBF with alpha = 0 is {here.apart('scbf', without)} in B and "
            f"{there.apart('scbf', without)} in A; CBF with alpha = 0 less CBF is {here.apart(without, cbf)} and "
            f"{there.apart(without, cbf_all)}",
            printed_gap(SCBF_PRINTED, DDSCBF_PRINTED),
            f"by the printed estimator with an unbounded torque (A): {free.number('DDSCBF', 'ddscbf').ours:.1f} % safe; its bias is always "
            "towards more control, which the box of 5 N m keeps in bounds",
            _sampled(cbf_all, sample),
            *(
                []
                if sample.quick
                else [_horizons("B", NEAR["start"], LONG_NEAR, cbf, sample), _horizons("A", ALL["start"], LONG_ALL, cbf_all, sample)]
            ),
            *_bounds(near, learned[0], sample),
        ],
    )


def _numbers(found: Rates, cbf: str) -> list[Number]:
    rows = (("SCBF", "scbf", SCBF_PRINTED), ("DDSCBF", "ddscbf", DDSCBF_PRINTED), ("CBF", cbf, CBF_PRINTED))
    return [*(found.number(*row) for row in rows), found.number("CBF with alpha = 0", f"cbf:alpha={NO_RATE}")]


def _sampled(cbf: str, sample: Sample) -> str:
    """What the CBF of A loses to the control period alone."""
    ahead = f"{cbf}:sampling_margin=first-order"
    quiet, noisy = (measured(ENV, {**ALL, "noise": noise}, [cbf, ahead], [], sample) for noise in (0.0, NOISE))
    rates_ = [f"{100 * found.rows[name]['safety_rate']:.1f}" for found in (quiet, noisy) for name in (cbf, ahead)]
    least = [f"{found.rows[cbf]['min_h_median']:.1g}" for found in (quiet, noisy)]
    return (
        f"a CBF that is held for 10 ms ends slightly below h = 0: in A it is safe in {rates_[0]} % without noise (median of the least h "
        f"{least[0]}; with noise {least[1]}); with a margin for that, in {rates_[1]} % without noise and in {rates_[3]} % with it"
    )


def _horizons(name: str, start: str, horizon: float, cbf: str, sample: Sample) -> str:
    """Up to which horizons the two printed rates come out."""
    found = measured(ENV, {"start": start, "horizon": horizon}, [cbf, "scbf"], [], sample)
    agreeing = []
    for text, printed in (("scbf", SCBF_PRINTED), (cbf, CBF_PRINTED)):
        row = found.rows[text]
        numbers = [Number.rate("", safe, row["episodes"], printed, EPISODES) for safe in row["curve"]["safe"]]
        agreeing.append({t for t, n in zip(row["curve"]["time"], numbers, strict=True) if agrees(n)})
    both = sorted(agreeing[0] & agreeing[1])
    said = f"from {both[0]:.3g} to {both[-1]:.3g} s" if both else f"at none up to {horizon:g} s"
    return f"{name}: horizons at which the printed rates of SCBF and of CBF both come out: {said}"


def _bounds(near: dict[str, Any], first: Lesson, sample: Sample) -> list[str]:
    """What Prop. 4.2.8 proves, and what Prop. 5.2.2 asks for in vain."""
    problem, model = load_problem(ENV, near), first.learned["martingale"]
    margin = next(iter(model.record.errors.values()))
    top = SafetyFilter.for_problem(problem, DDSCBF(model, margin=margin)).filter([0.0, 0.0], [0.0])
    said = f"Prop. 5.2.2 asks for a positive margin on all of C: with {margin:.2g} 1/s, the median error of the network, no torque meets "
    notes = [f"{said}the condition at the origin, where it is missed by {top.slack[0]:.2g}; there its h/sup h is not proved"]
    if sample.quick:
        return notes
    bound = promise(verify(problem, (SCBF(),)), starts_of(problem), problem.duration)[0]
    value = "none" if bound.value is None else f"{100 * bound.value:.1f} %"
    return [*notes, f"SCBF knows the noise and needs no margin: {bound.name} = {value} ({bound.status}); measured: see SCBF"]


ARTEFACTS: tuple[Artefact, ...] = (
    Artefact(
        name="figure-5.1",
        title="Learned noise part of the generator, pendulum",
        compute=partial(learning_outcome, ENV, NOISE, 0),
        setting=(
            f"{POINTS} states uniform in C, {REPETITIONS} Euler steps of 10 ms from each without torque, sigma = {NOISE:g} theta",
            f"network 100-30, 500 epochs at most; errors at {VALIDATION} other states of C, over {IDENTIFICATIONS} identifications",
        ),
        chosen=("tanh, Adam 1e-3, batches of 32, standardised inputs and targets; 70 % of the states train",),
        corrections=(
            "Eq. (5.17), (5.18): the change of h is taken from where the known drift leads, less its linear part in the noise",
            "Eq. (5.17): j = 1..n in place of 0..n",
            "Eq. (5.19): the trace is malformed, its value is right",
        ),
        draw=draw_learning,
        size=(7.0, 3.6),
    ),
    Artefact(
        name="table-5.1",
        title="Safety rates of SCBF, DDSCBF and CBF, pendulum",
        compute=_table,
        setting=(
            f"B: from (.1 rad, .1 rad/s), no violation at any control instant up to {NEAR['horizon']:g} s (quick: 5 s), dt = 10 ms",
            f"1000 episodes, the same for all filters; DDSCBF over {IDENTIFICATIONS} identifications; nominal torque 0",
        ),
        chosen=(
            "mass 1 kg, torque within 5 N m",
            f"start and horizon: B, since in A (uniform in C, {ALL['horizon']:g} s) no horizon has both printed rates",
            f"CBF with alpha(h) = {ALPHA_NEAR:g} h 1/s in B and {ALPHA_ALL:g} h 1/s in A, and with alpha = 0 beside it",
        ),
        corrections=(
            "Eq. (5.17), (5.18): the estimator without its bias and with far less noise, see Figure 5.1",
            "Prop. 5.2.2: no margin, which cannot be met where h is largest",
        ),
        orderings=(("SCBF", "CBF"), ("DDSCBF", "CBF")),
    ),
)
