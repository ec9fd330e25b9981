"""Thesis Sec. 4.3.2: safety of SCBF and SZCBF for a Dubins vehicle against its noise (Figure 4.2),
and that section's artefacts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from safe_envs.agents.evaluation.statistics import rate_band
from safe_envs.scripts.reproduce.chapter_4.dubins_pictures import draw_noises
from safe_envs.scripts.reproduce.chapter_4.dubins_points import FIGURE_POINTS
from safe_envs.scripts.reproduce.chapter_4.dubins_runs import (
    ALPHAS,
    CHOSEN,
    CORRECTIONS,
    FILTERS,
    HORIZON,
    HORIZONS,
    PRINTED_FORM,
    SCBF_ONLY,
    SETTING,
    STARTS,
    STEP,
    Runs,
    ahead_of,
    alternatives_of,
    bands_of,
    counts,
    holds_note,
    scbf_of,
    simulate,
    step_of,
    turning_time,
)
from safe_envs.scripts.reproduce.chapter_4.paired_episodes import (
    Exits,
    is_above,
    is_below,
    with_interval,
)
from safe_envs.scripts.reproduce.framework.artefact import Artefact, Claim, Number, Outcome, Sample

NOISES = (0.0, 0.05, 0.1, 0.15, 0.2)
"""sigma_1 = sigma_2 of the numbers, in m/sqrt(s)."""
BETWEEN = (0.025, 0.075, 0.125, 0.175)
"""Further ones of the curves."""
BEYOND = (0.25, 0.3)
"""Further ones of the SCBF alone."""
EPISODES = 1000


def compute_noises(sample: Sample) -> Outcome:
    """Figure 4.2: safety against noise, from random starts."""
    episodes, seed = sample.size(EPISODES), sample.seed
    levels = sorted((*NOISES, *(() if sample.quick else BETWEEN)))
    runs = {
        start: {level: simulate(FILTERS, level, start, episodes, seed) for level in levels}
        for start in STARTS
    }
    main = runs["uniform"]
    printed = {
        level: simulate(PRINTED_FORM, level, "uniform", episodes, seed) | scbf_of(main[level])
        for level in NOISES
    }
    beyond = {level: simulate(SCBF_ONLY, level, "uniform", episodes, seed) for level in BEYOND}
    named = {STARTS[start]: _at(runs[start], NOISES) for start in STARTS}
    elsewhere = alternatives_of(named, printed, claim_on_noises)
    return Outcome(
        numbers=[*_rates(main, NOISES), *_rates(beyond, BEYOND), *_differences(main)],
        claims=[claim_on_noises(named[STARTS["uniform"]], HORIZON)],
        alternative_settings=elsewhere,
        printed_formula=[
            number for number in _rates(printed, NOISES) if not number.name.startswith("SCBF")
        ],
        data={
            "noises": levels,
            "beyond": [levels[-1], *BEYOND],
            "horizons": list(HORIZONS),
            "horizon": HORIZON,
            "rates": {
                STARTS[s]: {n: bands_of([runs[s][level][n] for level in levels]) for n in FILTERS}
                for s in STARTS
            },
            "further": bands_of([r["SCBF"] for r in (main[levels[-1]], *beyond.values())]),
            "printed": {
                n: [r[n].rate("", step_of(HORIZON)).ours for r in printed.values()] for n in ALPHAS
            },
            "levels": list(NOISES),
            "curves": {
                STARTS[s]: {n: _curve(runs[s][max(NOISES)][n]) for n in FILTERS} for s in STARTS
            },
        },
        notes=[holds_note(elsewhere), _beyond_note(), *_turns(runs), *_infeasible(main)],
    )


def _at(runs: Mapping[float, Runs], levels: Sequence[float]) -> dict[float, Runs]:
    return {level: runs[level] for level in levels}


def _rates(runs: Mapping[float, Runs], levels: Sequence[float]) -> list[Number]:
    return [
        run.rate(f"{name}, sigma = {level:g}", step_of(HORIZON))
        for level in levels
        for name, run in runs[level].items()
    ]


def _differences(runs: Mapping[float, Runs]) -> list[Number]:
    return [
        ahead_of(rival, runs[level], HORIZON, f", sigma = {level:g}")
        for rival in ALPHAS
        for level in NOISES
    ]


def claim_on_noises(runs: Mapping[float, Runs], horizon: float) -> Claim:
    """Against all rates of the SZCBF, since the print names none, by paired intervals.

    Args:
        runs: of SCBF and the SZCBFs at each noise level.
        horizon: in s.
    """
    gaps = {
        rival: {level: ahead_of(rival, at, horizon) for level, at in runs.items()}
        for rival in ALPHAS
    }
    # Nothing can be better than a filter that never fails.
    perfect = {
        rival: [level for level, at in runs.items() if _never_fail(("SCBF", rival), at, horizon)]
        for rival in ALPHAS
    }
    ahead = [
        is_above(gap)
        for rival, each in gaps.items()
        for level, gap in each.items()
        if level not in perfect[rival]
    ]
    return Claim(
        f"SCBF has a better safety probability than SZCBF for sigma within [{min(NOISES):g},"
        f" {max(NOISES):g}]",
        bool(ahead) and all(ahead),
        "; ".join(_against(rival, each, len(perfect[rival])) for rival, each in gaps.items()),
    )


def _never_fail(names: Sequence[str], runs: Runs, horizon: float) -> bool:
    return all(runs[name].safe(step_of(horizon)).all() for name in names)


def _against(rival: str, gaps: Mapping[float, Number], perfect: int) -> str:
    """The differences, and how many of them are beyond chance."""
    above, below = (sum(map(beyond, gaps.values())) for beyond in (is_above, is_below))
    each = ", ".join(f"{with_interval(gap)} at {level:g}" for level, gap in gaps.items())
    both = f", both without a failure at {perfect}" if perfect else ""
    return (
        f"ahead of {rival} at {above} of {len(gaps)} noise levels, behind at {below}{both}: in"
        f" points {each}"
    )


def _beyond_note() -> str:
    return (
        f"Sec. 4.3.2 tests the SCBF alone within [0, {max(BEYOND):g}] as well and shows nothing of"
        " it; ours are in the table and in the picture, from the same random starts"
    )


def _turns(runs: Mapping[str, Mapping[float, Runs]]) -> list[str]:
    """From when on SCBF is the safer one."""
    most = max(NOISES)
    return [
        f"sigma = {most:g}, {STARTS[s]}: more episodes are safe with SCBF than with {rival} "
        f"{_as_text(turning_time(by_noise[most]['SCBF'], by_noise[most][rival]))}"
        for s, by_noise in runs.items()
        for rival in ALPHAS
    ]


def _as_text(time: float | None) -> str:
    return f"not up to {max(HORIZONS):g} s" if time is None else f"from {time:.2f} s on"


def _infeasible(runs: Mapping[float, Runs]) -> list[str]:
    shares = ", ".join(
        f"{name} {100 * run.infeasible:.2g} %" for name, run in runs[max(NOISES)].items()
    )
    return [
        f"steps in which no turn rate in the box meets the condition, sigma = {max(NOISES):g},"
        f" {STARTS['uniform']}: {shares}"
    ]


def _curve(run: Exits) -> dict[str, list[float]]:
    safe, episodes = counts(run), len(run.instant)
    low, high = rate_band(safe, episodes)
    time = STEP * np.arange(len(safe))
    return {
        "time": time.tolist(),
        "low": (100 * low).tolist(),
        "rate": (100 * safe / episodes).tolist(),
        "high": (100 * high).tolist(),
    }


ARTEFACTS: tuple[Artefact, ...] = (
    Artefact(
        name="figure-4.2",
        title="Safety of SCBF and SZCBF against the noise",
        compute=compute_noises,
        setting=lambda sample: (
            *SETTING,
            f"random starts at each noise level, an episode from each: {sample.size(EPISODES)}",
        ),
        assumptions=CHOSEN,
        errata=CORRECTIONS,
        draw=draw_noises,
        size=(7.0, 4.2),
    ),
    FIGURE_POINTS,
)
