"""Thesis Sec. 4.3.2: safety of SCBF and SZCBF from ten random starts (Figure 4.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safe_envs.scripts.reproduce.chapter_4 import dubins_runs as dubins
from safe_envs.scripts.reproduce.chapter_4.dubins_pictures import draw_points
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.episodes import Violations, episode_seed
from safe_envs.scripts.reproduce.framework.paired import is_above, is_below, with_interval
from safe_envs.wrappers import SCBF
from safe_envs.wrappers.verification.bounds import theorem_4_2_10_printed, union_bound
from safe_envs.wrappers.verification.formulas import Formulas

POINTS, NOISE = dubins.SETTINGS["points"], dubins.SETTINGS["noise"]
EPISODES_OF_POINT = dubins.SETTINGS["episodes_of_point"]


def compute_points(sample: Workload) -> Findings:
    """Compute the safety from ten random starts, with many episodes each."""
    episodes = sample.size(EPISODES_OF_POINT)
    seeds = [episode_seed(sample.seed, i) for i in range(POINTS)]
    starts = {
        kind: dubins.random_starts(kind, NOISE, POINTS, sample.seed)
        for kind in dubins.STARTS
        if kind == "uniform" or not sample.quick
    }

    def from_each(kind: str, filters: Mapping[str, Any]) -> list[dict[str, Violations]]:
        return [
            dubins.simulate(filters, NOISE, x.tolist(), episodes, seed)
            for x, seed in zip(starts[kind], seeds, strict=True)
        ]

    runs = {dubins.STARTS[kind]: from_each(kind, dubins.FILTERS) for kind in starts}
    main = runs[dubins.STARTS["uniform"]]
    printed = [
        found | dubins.scbf_of(of_start)
        for found, of_start in zip(from_each("uniform", dubins.PRINTED_FORM), main, strict=True)
    ]
    alternatives = dubins.alternatives_of(runs, printed, claim_on_points)
    together, step = pooled(main), dubins.step_of(dubins.HORIZON)
    return Findings(
        numbers=[
            *(run.rate(f"{name}, all ten starts", step) for name, run in together.items()),
            *(
                dubins.ahead_of(rival, together, dubins.HORIZON, ", all ten starts")
                for rival in dubins.ALPHAS
            ),
            *(
                run.rate(f"{name}, start {i}", step)
                for i, each in enumerate(main, 1)
                for name, run in each.items()
            ),
        ],
        claims=[claim_on_points(main, dubins.HORIZON)],
        alternative_settings=alternatives,
        printed_formula=[
            run.rate(f"{name}, all ten starts", step)
            for name, run in pooled(printed).items()
            if name in dubins.ALPHAS
        ],
        data={
            "starts": starts["uniform"].tolist(),
            "horizons": [dubins.HORIZON, max(dubins.HORIZONS)],
            "rates": {
                n: {
                    f"{t:g}": dubins.bands_of([r[n] for r in main], t)
                    for t in (dubins.HORIZON, max(dubins.HORIZONS))
                }
                for n in dubins.FILTERS
            },
            "product": printed_and_union_bound(starts["uniform"])[0].tolist(),
        },
        notes=[
            dubins.holds_note(alternatives),
            *_over_other_starts(main),
            *(
                bound_note(
                    dubins.STARTS[k],
                    [r["SCBF"] for r in runs[dubins.STARTS[k]]],
                    *printed_and_union_bound(x),
                )
                for k, x in starts.items()
            ),
        ],
    )


def pooled(runs: Sequence[dubins.ByFilter]) -> dict[str, Violations]:
    """Return all episodes of all starts, with the average share of infeasible steps."""
    names = runs[0].keys()
    return {
        n: Violations(
            np.concatenate([r[n].instant for r in runs]),
            float(np.mean([r[n].infeasible for r in runs])),
        )
        for n in names
    }


def claim_on_points(runs: Sequence[dubins.ByFilter], horizon: float) -> Claim:
    """Return the claim over all starts together, against all rates of the SZCBF.

    Args:
        runs: of SCBF and the SZCBFs from each start.
        horizon: in s.
    """
    overall = {rival: dubins.ahead_of(rival, pooled(runs), horizon) for rival in dubins.ALPHAS}
    each = {
        rival: [dubins.ahead_of(rival, run, horizon).ours for run in runs]
        for rival in dubins.ALPHAS
    }
    evidence = [
        f"SCBF - {rival}: {with_interval(gap)} points on average, above 0 from"
        f" {sum(g > 0 for g in each[rival])} of {len(runs)} starts, between {min(each[rival]):.1f}"
        f" and {max(each[rival]):.1f}"
        for rival, gap in overall.items()
    ]
    holds = all(is_above(gap) for gap in overall.values())
    return dubins.CHAPTER.claim("figure-4.3", "better", holds, each="; ".join(evidence))


def _over_other_starts(runs: Sequence[dubins.ByFilter]) -> list[str]:
    """Return what ten starts say of others, in words."""
    notes = []
    for rival in dubins.ALPHAS:
        gap = Number.mean(
            "",
            [dubins.ahead_of(rival, run, dubins.HORIZON).ours for run in runs],
            "points",
            -100.0,
            100.0,
        )
        notes.append(
            dubins.CHAPTER.note("figure-4.3", "others", rival=rival, gap=with_interval(gap))
        )
    return notes


def printed_and_union_bound(starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the product of Thm. 4.2.10 and the union bound at each start, shape (starts,) each.

    Both are 0 where A h <= 0.
    """
    formulas = Formulas(dubins.dubins_problem(NOISE, "uniform"), [SCBF()], "model")
    speed = formulas.system.parameter_values["v"]
    # A h = -2 v (x cos + y sin) - 2 sigma^2 is largest at the edge, straight inwards.
    suprema = [dubins.RADIUS**2, 2 * speed * dubins.RADIUS - 2 * NOISE**2]
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
    last = [run.rate("", dubins.step_of(max(dubins.HORIZONS))) for run in runs]
    below = sum(is_below(last[i], 100 * product[i]) for i in inside)
    share = 100 * np.mean([run.infeasible for run in runs])
    counts = {"inside": len(inside), "count": len(runs), "below": below}
    bounds = {"product": 100 * product.max(), "union": 100 * union.max(), "share": share}
    longest = max(dubins.HORIZONS)
    return dubins.CHAPTER.note(
        "figure-4.3", "bounds", name=name, longest=longest, **counts, **bounds
    )


ARTEFACTS = (
    dubins.CHAPTER.artefact(
        "figure-4.3",
        compute_points,
        lambda sample: {"count": sample.size(EPISODES_OF_POINT)},
        draw_points,
    ),
)
