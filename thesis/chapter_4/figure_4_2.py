"""Figure 4.2: safety of SCBF and SZCBF against the noise (Sec. 4.3.2)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from matplotlib.figure import Figure

from safe_envs.scripts.figures.style import add_legend, labelled
from thesis.artefact import Claim, Number, Outcome, Sample
from thesis.chapter_4 import dubins
from thesis.chapter_4.dubins import ALPHAS, DUBINS, FILTERS, HORIZON, STARTS, ByFilter
from thesis.drawing import draw_interval

NOISES, MOST = DUBINS.noises, max(DUBINS.noises)
ByNoise = Mapping[float, ByFilter]


def compute(sample: Sample) -> tuple[Outcome, Any]:
    """Compute the safety against noise, from random starts."""
    size = sample.size(DUBINS.episodes), sample.seed
    runs = {
        name: {level: dubins.simulate(FILTERS, level, start, *size) for level in NOISES}
        for start, name in STARTS.items()
    }
    main = runs[STARTS["uniform"]]
    printed = {
        level: {**dubins.simulate(dubins.PRINTED_FORM, level, "uniform", *size), **_scbf(each)}
        for level, each in main.items()
    }
    beyond = {
        level: dubins.simulate({"SCBF": "scbf"}, level, "uniform", *size) for level in DUBINS.beyond
    }
    infeasible = [f"{name} {100 * run.infeasible:.2g} %" for name, run in main[MOST].items()]
    outcome = Outcome(
        numbers=[
            *_rates(main),
            *_rates(beyond),
            *(
                dubins.ahead_of(rival, each, HORIZON, f", sigma = {level:g}")
                for rival in ALPHAS
                for level, each in main.items()
            ),
        ],
        claims=[claim_on_noises(main, HORIZON)],
        alternative_settings=dubins.alternatives_of(runs, printed, claim_on_noises),
        printed_formula=[n for n in _rates(printed) if not n.name.startswith("SCBF")],
        notes=[
            "steps in which no turn rate in its bounds meets the condition, sigma ="
            f" {MOST:g}, {STARTS['uniform']}: {', '.join(infeasible)}"
        ],
    )
    return outcome, partial(_draw, runs, printed, {MOST: main[MOST], **beyond})


def _scbf(each: ByFilter) -> ByFilter:
    return {"SCBF": each["SCBF"]}


def _rates(runs: ByNoise) -> list[Number]:
    return [
        run.rate(f"{name}, sigma = {level:g}")
        for level, each in runs.items()
        for name, run in each.items()
    ]


def claim_on_noises(runs: ByNoise, horizon: float) -> Claim:
    """Return the claim by paired intervals, against all rates of the SZCBF: none is printed."""
    evidence, ahead = [], []
    for rival in ALPHAS:
        gaps = {level: dubins.ahead_of(rival, at, horizon) for level, at in runs.items()}
        # Nothing can be better than a filter that never fails.
        perfect = [
            level
            for level, at in runs.items()
            if all(at[name].safe(horizon).all() for name in ("SCBF", rival))
        ]
        ahead += [gap.is_above() for level, gap in gaps.items() if level not in perfect]
        evidence.append(_against(rival, gaps, len(perfect)))
    return Claim(
        "SCBF has a better safety probability than SZCBF for sigma within"
        f" [{min(NOISES):g}, {MOST:g}]",
        bool(ahead) and all(ahead),
        "; ".join(evidence),
    )


def _against(rival: str, gaps: Mapping[float, Number], perfect: int) -> str:
    """Return the differences, and how many of them are beyond chance, in words."""
    above = sum(gap.is_above() for gap in gaps.values())
    below = sum(gap.is_below() for gap in gaps.values())
    each = ", ".join(f"{gap.text} at {level:g}" for level, gap in gaps.items())
    both = f", both without a failure at {perfect}" if perfect else ""
    return (
        f"ahead of {rival} at {above} of {len(gaps)} noise levels, behind at {below}{both}: {each}"
    )


def _draw(runs: Mapping[str, ByNoise], printed: ByNoise, beyond: ByNoise, figure: Figure) -> None:
    """Draw safety against noise: full lines are of all starts, dashed ones of those inwards."""
    axes = figure.subplots()
    dots: dict[str, Any] = {"marker": "o", "markersize": 3}
    for (kind, by_noise), dashes in zip(runs.items(), ("-", "--"), strict=True):
        for name, color in dubins.COLOR.items():
            label = dubins.LABEL[name] if dashes == "-" else None
            bands = dubins.bands_of([each[name] for each in by_noise.values()])
            draw_interval(axes, list(by_noise), bands, color, 0.15, dashes, label=label, **dots)
        label = kind.replace("A h > 0", r"$\mathcal{A} h > 0$")
        axes.plot([], [], dashes, color="black", label=label)
    bands = dubins.bands_of([each["SCBF"] for each in beyond.values()])
    draw_interval(axes, list(beyond), bands, dubins.COLOR["SCBF"], 0.15, **dots)
    cross: dict[str, Any] = {"marker": "x", "markersize": 4}
    for name in ALPHAS:
        rates = [each[name].rate().ours for each in printed.values()]
        axes.plot(list(printed), rates, ":", color=dubins.COLOR[name], **cross)
    axes.plot([], [], ":", color="black", label="printed $h_2$, all starts", **cross)
    axes.set(ylim=(-3, 103), title=f"$T$ = {HORIZON:g} s", ylabel=labelled("safe", "%"))
    axes.set_xlabel(labelled(r"noise $\sigma_1 = \sigma_2$", "m/sqrt(s)"))
    add_legend(figure, axes.get_legend_handles_labels()[0])


ARTEFACTS = {"figure-4.2": compute}
