"""Thesis Sec. 4.3.2: safety of SCBF and SZCBF against the noise (Figure 4.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from safe_envs.agents.evaluation.statistics import rate_band
from safe_envs.scripts.reproduce.chapter_4 import dubins_runs as dubins
from safe_envs.scripts.reproduce.chapter_4.dubins_pictures import draw_noises
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.episodes import Violations
from safe_envs.scripts.reproduce.framework.paired import is_above, is_below, with_interval

NOISES, BEYOND, EPISODES = (dubins.SETTINGS[name] for name in ("noises", "beyond", "episodes"))
BETWEEN = (0.025, 0.075, 0.125, 0.175)  # further noise levels of the curves, in m/sqrt(s)


def compute_noises(sample: Workload) -> Findings:
    """Compute the safety against noise, from random starts."""
    episodes, seed = sample.size(EPISODES), sample.seed
    levels = sorted((*NOISES, *(() if sample.quick else BETWEEN)))
    runs = {
        start: {
            level: dubins.simulate(dubins.FILTERS, level, start, episodes, seed) for level in levels
        }
        for start in dubins.STARTS
    }
    main = runs["uniform"]
    printed = {
        level: dubins.simulate(dubins.PRINTED_FORM, level, "uniform", episodes, seed)
        | dubins.scbf_of(main[level])
        for level in NOISES
    }
    beyond = {
        level: dubins.simulate(dubins.SCBF_ONLY, level, "uniform", episodes, seed)
        for level in BEYOND
    }
    named = {
        name: {level: runs[start][level] for level in NOISES}
        for start, name in dubins.STARTS.items()
    }
    alternatives = dubins.alternatives_of(named, printed, claim_on_noises)
    return Findings(
        numbers=[*_rates(main, NOISES), *_rates(beyond, BEYOND), *_differences(main)],
        claims=[claim_on_noises(named[dubins.STARTS["uniform"]], dubins.HORIZON)],
        alternative_settings=alternatives,
        printed_formula=[
            number for number in _rates(printed, NOISES) if not number.name.startswith("SCBF")
        ],
        data={
            "noises": levels,
            "beyond": [levels[-1], *BEYOND],
            "horizons": list(dubins.HORIZONS),
            "horizon": dubins.HORIZON,
            "rates": {
                dubins.STARTS[s]: {
                    n: dubins.bands_of([runs[s][level][n] for level in levels])
                    for n in dubins.FILTERS
                }
                for s in dubins.STARTS
            },
            "further": dubins.bands_of([r["SCBF"] for r in (main[levels[-1]], *beyond.values())]),
            "printed": {
                n: [r[n].rate("", dubins.step_of(dubins.HORIZON)).ours for r in printed.values()]
                for n in dubins.ALPHAS
            },
            "levels": list(NOISES),
            "curves": {
                dubins.STARTS[s]: {n: _curve(runs[s][max(NOISES)][n]) for n in dubins.FILTERS}
                for s in dubins.STARTS
            },
        },
        notes=[
            dubins.holds_note(alternatives),
            dubins.CHAPTER.note("figure-4.2", "beyond"),
            *_turns(runs),
            _infeasible(main),
        ],
    )


def _rates(runs: Mapping[float, dubins.ByFilter], levels: Sequence[float]) -> list[Number]:
    return [
        run.rate(f"{name}, sigma = {level:g}", dubins.step_of(dubins.HORIZON))
        for level in levels
        for name, run in runs[level].items()
    ]


def _differences(runs: Mapping[float, dubins.ByFilter]) -> list[Number]:
    return [
        dubins.ahead_of(rival, runs[level], dubins.HORIZON, f", sigma = {level:g}")
        for rival in dubins.ALPHAS
        for level in NOISES
    ]


def claim_on_noises(runs: Mapping[float, dubins.ByFilter], horizon: float) -> Claim:
    """Return the claim against all rates of the SZCBF by paired intervals: the thesis names none.

    Args:
        runs: of SCBF and the SZCBFs at each noise level.
        horizon: in s.
    """
    gaps = {
        rival: {level: dubins.ahead_of(rival, at, horizon) for level, at in runs.items()}
        for rival in dubins.ALPHAS
    }
    # Nothing can be better than a filter that never fails.
    perfect = {
        rival: [level for level, at in runs.items() if _never_fail(("SCBF", rival), at, horizon)]
        for rival in dubins.ALPHAS
    }
    ahead = [
        is_above(gap)
        for rival, each in gaps.items()
        for level, gap in each.items()
        if level not in perfect[rival]
    ]
    each = "; ".join(_against(rival, gap, len(perfect[rival])) for rival, gap in gaps.items())
    range_ = {"least": min(NOISES), "most": max(NOISES)}
    return dubins.CHAPTER.claim("figure-4.2", "better", ahead and all(ahead), each=each, **range_)


def _never_fail(names: Sequence[str], runs: dubins.ByFilter, horizon: float) -> bool:
    return all(runs[name].safe(dubins.step_of(horizon)).all() for name in names)


def _against(rival: str, gaps: Mapping[float, Number], perfect: int) -> str:
    """Return the differences, and how many of them are beyond chance, in words."""
    above, below = (sum(map(beyond, gaps.values())) for beyond in (is_above, is_below))
    each = ", ".join(f"{with_interval(gap)} at {level:g}" for level, gap in gaps.items())
    both = f", both without a failure at {perfect}" if perfect else ""
    return (
        f"ahead of {rival} at {above} of {len(gaps)} noise levels, behind at {below}{both}: in"
        f" points {each}"
    )


def _turns(runs: Mapping[str, Mapping[float, dubins.ByFilter]]) -> list[str]:
    """Return from when on SCBF is the safer one, in words."""
    most = max(NOISES)
    return [
        f"sigma = {most:g}, {dubins.STARTS[s]}: more episodes are safe with SCBF than with {rival} "
        f"{_as_text(dubins.turning_time(by_noise[most]['SCBF'], by_noise[most][rival]))}"
        for s, by_noise in runs.items()
        for rival in dubins.ALPHAS
    ]


def _as_text(time: float | None) -> str:
    return f"not up to {max(dubins.HORIZONS):g} s" if time is None else f"from {time:.2f} s on"


def _infeasible(runs: Mapping[float, dubins.ByFilter]) -> str:
    shares = ", ".join(
        f"{name} {100 * run.infeasible:.2g} %" for name, run in runs[max(NOISES)].items()
    )
    where = {"noise": max(NOISES), "where": dubins.STARTS["uniform"]}
    return dubins.CHAPTER.note("figure-4.2", "infeasible", shares=shares, **where)


def _curve(run: Violations) -> dict[str, list[float]]:
    safe, episodes = dubins.counts(run), len(run.instant)
    low, high = rate_band(safe, episodes)
    time = dubins.STEP * np.arange(len(safe))
    return {
        "time": time.tolist(),
        "low": (100 * low).tolist(),
        "rate": (100 * safe / episodes).tolist(),
        "high": (100 * high).tolist(),
    }


ARTEFACTS = (
    dubins.CHAPTER.artefact(
        "figure-4.2", compute_noises, lambda sample: {"count": sample.size(EPISODES)}, draw_noises
    ),
)
