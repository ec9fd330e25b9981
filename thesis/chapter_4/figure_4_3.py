"""Figure 4.3: safety of SCBF and SZCBF from ten random starts (Sec. 4.3.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from safe_envs import SafeVectorEnv
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.proofs.guarantees import union_bound
from safe_envs.proofs.safe_set import Formulas
from safe_envs.scripts.figures.style import add_legend, labelled
from safe_envs.wrappers import SCBF
from thesis.artefact import Claim, Outcome, Sample
from thesis.chapter_4 import dubins
from thesis.chapter_4.dubins import ALPHAS, DUBINS, FILTERS, HORIZON, STARTS, ByFilter, Violations

LONGEST = max(DUBINS.horizons)


def compute(sample: Sample) -> tuple[Outcome, Any]:
    """Compute the safety from ten random starts, with many episodes each."""
    episodes = sample.size(DUBINS.episodes_of_point)
    seeds = [episode_seed(sample.seed, i) for i in range(DUBINS.points)]
    kinds = [kind for kind in STARTS if kind == "uniform" or not sample.quick]
    starts = {kind: random_starts(kind, sample.seed) for kind in kinds}

    def from_each(kind: str, filters: Mapping[str, Any]) -> list[dict[str, Violations]]:
        return [
            dubins.simulate(filters, DUBINS.noise, x.tolist(), episodes, seed)
            for x, seed in zip(starts[kind], seeds, strict=True)
        ]

    runs = {STARTS[kind]: from_each(kind, FILTERS) for kind in kinds}
    main = runs[STARTS["uniform"]]
    printed = [
        {**found, "SCBF": of_start["SCBF"]}
        for found, of_start in zip(from_each("uniform", dubins.PRINTED_FORM), main, strict=True)
    ]
    together, where = pooled(main), "all ten starts"
    outcome = Outcome(
        numbers=[
            *(run.rate(f"{name}, {where}") for name, run in together.items()),
            *(dubins.ahead_of(rival, together, HORIZON, f", {where}") for rival in ALPHAS),
            *(
                run.rate(f"{name}, start {i}")
                for i, each in enumerate(main, 1)
                for name, run in each.items()
            ),
        ],
        claims=[claim_on_points(main, HORIZON)],
        alternative_settings=dubins.alternatives_of(runs, printed, claim_on_points),
        printed_formula=[pooled(printed)[name].rate(f"{name}, {where}") for name in ALPHAS],
        notes=[
            f"{STARTS[kind]}: {bound_note([each['SCBF'] for each in runs[STARTS[kind]]], x)}"
            for kind, x in starts.items()
        ],
    )
    return outcome, partial(_draw, starts["uniform"], main)


def random_starts(kind: str, seed: int) -> np.ndarray:
    """Return states from a distribution of starts, shape (points, 3)."""
    env = SafeVectorEnv(dubins.problem_of(DUBINS.noise, kind), DUBINS.points)
    env.reset(seed=[episode_seed(seed, i) for i in range(DUBINS.points)])
    return env.state


def pooled(runs: Sequence[ByFilter]) -> dict[str, Violations]:
    """Return all episodes of all starts, with the average share of infeasible steps."""
    return {
        name: Violations(
            np.concatenate([each[name].instant for each in runs]),
            float(np.mean([each[name].infeasible for each in runs])),
        )
        for name in runs[0]
    }


def claim_on_points(runs: Sequence[ByFilter], horizon: float) -> Claim:
    """Return the claim over all starts together, against all rates of the SZCBF."""
    evidence, holds = [], True
    for rival in ALPHAS:
        gap = dubins.ahead_of(rival, pooled(runs), horizon)
        each = [dubins.ahead_of(rival, run, horizon).ours for run in runs]
        holds &= gap.is_above()
        evidence.append(
            f"SCBF - {rival}: {gap.text} on average, above 0 from {sum(g > 0 for g in each)} of"
            f" {len(runs)} starts, between {min(each):.1f} and {max(each):.1f}"
        )
    sentence = "SCBF has an overall better performance than SZCBF from the random starts"
    return Claim(sentence, holds, "; ".join(evidence))


def bounds_at(starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the product of Thm. 4.2.10 and the union bound at each start; 0 where A h <= 0."""
    formulas = Formulas(dubins.problem_of(DUBINS.noise, "uniform"), [SCBF()], "model")
    speed = formulas.system.parameter_values["v"]
    # A h = -2 v (x cos + y sin) - 2 sigma^2 is largest at the edge, straight inwards.
    suprema = [DUBINS.radius**2, 2 * speed * DUBINS.radius - 2 * DUBINS.noise**2]
    b = formulas.chain(starts)
    inside = (b > 0.0).all(axis=-1)
    product, union = (b / suprema).prod(axis=-1), union_bound(b, suprema)
    return np.where(inside, product, 0.0), np.where(inside, union, 0.0)


def bound_note(runs: Sequence[Violations], starts: np.ndarray) -> str:
    """Return how the bounds at each start compare with the simulation, in words.

    Only a start with A h > 0 has a bound that is positive.
    """
    product, union = bounds_at(starts)
    inside = np.flatnonzero(product > 0.0).tolist()
    below = sum(runs[i].rate("", LONGEST).is_below(100 * product[i]) for i in inside)
    share = 100 * np.mean([run.infeasible for run in runs])
    return (
        f"A h > 0, as Thm. 4.2.10 presumes, holds at {len(inside)} of {len(runs)}. Its product b_0"
        f" b_1/(c_0 c_1) is at most {100 * product.max():.1f} % there, and contradicted at {below}"
        f" by T = {LONGEST:g} s; the union bound is at most {100 * union.max():.1f} %. Both presume"
        f" the condition, which no turn rate meets in {share:.1f} % of the steps"
    )


def _draw(starts: np.ndarray, runs: Sequence[ByFilter], figure: Figure) -> None:
    """Draw the safety from each start, hollow at the long horizon."""
    axes = figure.subplots()
    index = np.arange(1, len(starts) + 1)
    for i, (name, color) in enumerate(dubins.COLOR.items()):
        style: Any = {"fmt": "os^"[i], "color": color, "markersize": 3.5, "linewidth": 1}
        for horizon, face in ((HORIZON, color), (LONGEST, "white")):
            low, rate, high = dubins.bands_of([each[name] for each in runs], horizon)
            label = f"{dubins.LABEL[name]}, $T$ = {horizon:g} s"
            ends, place = (rate - low, high - rate), index + 0.22 * (i - 1)
            axes.errorbar(place, rate, ends, markerfacecolor=face, label=label, **style)
    product = bounds_at(starts)[0]
    style = {"color": "black", "label": "product of Thm. 4.2.10", "markersize": 10}
    axes.plot(index[product > 0], 100 * product[product > 0], "_", **style)
    axes.set(xlabel="start", xticks=index, ylim=(-3, 103), ylabel=labelled("safe", "%"))
    add_legend(figure, axes.get_legend_handles_labels()[0])


ARTEFACTS = {"figure-4.3": compute}
