"""Thesis Sec. 4.3.2: safety of SCBF and SZCBF from ten random starts (Figure 4.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safe_envs.scripts.reproduce.chapter_4.dubins_pictures import draw_points
from safe_envs.scripts.reproduce.chapter_4.dubins_runs import (
    ALPHAS,
    CHAPTER,
    FILTERS,
    HORIZON,
    HORIZONS,
    PRINTED_FORM,
    RADIUS,
    SETTINGS,
    STARTS,
    ByFilter,
    ahead_of,
    alternatives_of,
    bands_of,
    dubins_problem,
    holds_note,
    random_starts,
    scbf_of,
    simulate,
    step_of,
)
from safe_envs.scripts.reproduce.framework.artefact import (
    Artefact,
    Claim,
    Number,
    Outcome,
    Sample,
)
from safe_envs.scripts.reproduce.framework.episodes import Violations, episode_seed
from safe_envs.scripts.reproduce.framework.paired import (
    is_above,
    is_below,
    with_interval,
)
from safe_envs.wrappers import SCBF
from safe_envs.wrappers.verification.bounds import theorem_4_2_10_printed, union_bound
from safe_envs.wrappers.verification.formulas import Formulas

POINTS, NOISE = SETTINGS["points"], SETTINGS["noise"]
EPISODES_OF_POINT = SETTINGS["episodes_of_point"]


def compute_points(sample: Sample) -> Outcome:
    """Compute the safety from ten random starts, with many episodes each."""
    episodes = sample.size(EPISODES_OF_POINT)
    seeds = [episode_seed(sample.seed, i) for i in range(POINTS)]
    starts = {
        kind: random_starts(kind, NOISE, POINTS, sample.seed)
        for kind in STARTS
        if kind == "uniform" or not sample.quick
    }

    def from_each(kind: str, filters: Mapping[str, Any]) -> list[dict[str, Violations]]:
        return [
            simulate(filters, NOISE, x.tolist(), episodes, seed)
            for x, seed in zip(starts[kind], seeds, strict=True)
        ]

    runs = {STARTS[kind]: from_each(kind, FILTERS) for kind in starts}
    main = runs[STARTS["uniform"]]
    printed = [
        found | scbf_of(of_start)
        for found, of_start in zip(from_each("uniform", PRINTED_FORM), main, strict=True)
    ]
    alternatives = alternatives_of(runs, printed, claim_on_points)
    together, step = pooled(main), step_of(HORIZON)
    return Outcome(
        numbers=[
            *(run.rate(f"{name}, all ten starts", step) for name, run in together.items()),
            *(ahead_of(rival, together, HORIZON, ", all ten starts") for rival in ALPHAS),
            *(
                run.rate(f"{name}, start {i}", step)
                for i, each in enumerate(main, 1)
                for name, run in each.items()
            ),
        ],
        claims=[claim_on_points(main, HORIZON)],
        alternative_settings=alternatives,
        printed_formula=[
            run.rate(f"{name}, all ten starts", step)
            for name, run in pooled(printed).items()
            if name in ALPHAS
        ],
        data={
            "starts": starts["uniform"].tolist(),
            "horizons": [HORIZON, max(HORIZONS)],
            "rates": {
                n: {f"{t:g}": bands_of([r[n] for r in main], t) for t in (HORIZON, max(HORIZONS))}
                for n in FILTERS
            },
            "product": printed_and_union_bound(starts["uniform"])[0].tolist(),
        },
        notes=[
            holds_note(alternatives),
            *_over_other_starts(main),
            *(
                bound_note(
                    STARTS[k], [r["SCBF"] for r in runs[STARTS[k]]], *printed_and_union_bound(x)
                )
                for k, x in starts.items()
            ),
        ],
    )


def pooled(runs: Sequence[ByFilter]) -> dict[str, Violations]:
    """Return all episodes of all starts, with the average share of infeasible steps."""
    names = runs[0].keys()
    return {
        n: Violations(
            np.concatenate([r[n].instant for r in runs]),
            float(np.mean([r[n].infeasible for r in runs])),
        )
        for n in names
    }


def claim_on_points(runs: Sequence[ByFilter], horizon: float) -> Claim:
    """Return the claim over all starts together, against all rates of the SZCBF.

    Args:
        runs: of SCBF and the SZCBFs from each start.
        horizon: in s.
    """
    overall = {rival: ahead_of(rival, pooled(runs), horizon) for rival in ALPHAS}
    each = {rival: [ahead_of(rival, run, horizon).ours for run in runs] for rival in ALPHAS}
    evidence = [
        f"SCBF - {rival}: {with_interval(gap)} points on average, above 0 from"
        f" {sum(g > 0 for g in each[rival])} of {len(runs)} starts, between {min(each[rival]):.1f}"
        f" and {max(each[rival]):.1f}"
        for rival, gap in overall.items()
    ]
    holds = all(is_above(gap) for gap in overall.values())
    return Claim(
        "SCBF has an overall better performance than SZCBF from the random starts",
        holds,
        "; ".join(evidence),
    )


def _over_other_starts(runs: Sequence[ByFilter]) -> list[str]:
    """Return what ten starts say of others, in words."""
    notes = []
    for rival in ALPHAS:
        gap = Number.mean(
            "", [ahead_of(rival, run, HORIZON).ours for run in runs], "points", -100.0, 100.0
        )
        notes.append(CHAPTER.note("figure-4.3", "others", rival=rival, gap=with_interval(gap)))
    return notes


def printed_and_union_bound(starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the product of Thm. 4.2.10 and the union bound at each start, shape (starts,) each.

    Both are 0 where A h <= 0.
    """
    formulas = Formulas(dubins_problem(NOISE, "uniform"), [SCBF()], "model")
    speed = next(
        value for symbol, value in formulas.system.parameters.items() if symbol.name == "v"
    )
    # A h = -2 v (x cos + y sin) - 2 sigma^2 is largest at the edge, straight inwards.
    suprema = [RADIUS**2, 2 * speed * RADIUS - 2 * NOISE**2]
    b = formulas.chain(starts)
    inside = (b > 0.0).all(axis=-1)
    return np.where(inside, theorem_4_2_10_printed(b, suprema), 0.0), np.where(
        inside, union_bound(b, suprema), 0.0
    )


def bound_note(
    name: str, runs: Sequence[Violations], product: np.ndarray, union: np.ndarray
) -> str:
    """Return how the bounds compare with the simulation, in words.

    Only a start with A h > 0 has one that is positive.

    Args:
        name: of the starts.
        runs: of the SCBF from each of them.
        product: of Thm. 4.2.10 at each start.
        union: bound at each start.
    """
    inside = np.flatnonzero(product > 0.0)
    last = [run.rate("", step_of(max(HORIZONS))) for run in runs]
    below = sum(is_below(last[i], 100 * product[i]) for i in inside)
    share = 100 * np.mean([run.infeasible for run in runs])
    return CHAPTER.note(
        "figure-4.3",
        "bounds",
        name=name,
        inside=len(inside),
        count=len(runs),
        below=below,
        longest=max(HORIZONS),
        product=100 * product.max(),
        union=100 * union.max(),
        share=share,
    )


ARTEFACTS: tuple[Artefact, ...] = (
    CHAPTER.artefact(
        "figure-4.3",
        compute_points,
        lambda sample: {"count": sample.size(EPISODES_OF_POINT)},
        draw_points,
        (7.0, 4.0),
    ),
)
