"""Table 5.2: safety rates of SCBF, DDSCBF and CBF, cubic system (Sec. 5.4.2)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from thesis.artefact import Claim, Number, Outcome, Sample, settings, texts
from thesis.chapter_5 import noise
from thesis.chapter_5.noise import WITHOUT_RATE, Runs, rates_of
from thesis.rates import safer

CUBIC = settings(5, "cubic")
ENV, LEVELS = CUBIC.env, CUBIC.levels
CBF = f"cbf:alpha={CUBIC.alpha}"
PRINTED = texts()["table-5.2"].printed
_FILTERS = {
    "SCBF": "scbf",
    "DDSCBF": "ddscbf",
    "CBF": CBF,
    "CBF with alpha = 0": WITHOUT_RATE,
    "no filter": "none",
}
Levels = Mapping[float, Runs]
"""By filter at each level."""


def compute(sample: Sample) -> tuple[Outcome, None]:
    """Compute Table 5.2, also from a single start."""
    learned = {k: noise.identifications(ENV, k, sample) for k in LEVELS}
    filters = ["none", CBF, WITHOUT_RATE, "scbf"]
    near, single = (
        {
            k: rates_of(ENV, {"noise": k, **start}, sample, filters, noise.models(learned[k]))
            for k in LEVELS
        }
        for start in ({}, {"start": list(CUBIC.fixed_start)})
    )
    literal = {
        k: rates_of(ENV, {"noise": k}, sample, [], noise.models(learned[k], "printed"))
        for k in LEVELS
    }
    single_start = f"a single start {CUBIC.fixed_start} with h = .25"
    return Outcome(
        numbers_of(near, _FILTERS),
        claims_of(near),
        {single_start: Outcome(numbers_of(single, _FILTERS), claims_of(single))},
        numbers_of(literal, {"DDSCBF": "ddscbf"}),
        notes=[
            *(noise.explain_gap(near[k], CBF, f"at k = {k:g}") for k in LEVELS),
            _falls(sample),
        ],
    ), None


def numbers_of(found: Levels, filters: Mapping[str, str]) -> list[Number]:
    """Return the rates of filters at each level, with the printed ones."""
    return [
        found[k][text].number(f"{name}, k = {k:g}", PRINTED[name][i] if name in PRINTED else None)
        for i, k in enumerate(LEVELS)
        for name, text in filters.items()
    ]


def claims_of(found: Levels) -> list[Claim]:
    """Return checks of ours: the text says nothing of the table, whose numbers have an order."""
    printed = zip(PRINTED["SCBF"], PRINTED["DDSCBF"], strict=True)
    return [
        *(
            noise.close(found[k], *rates, f" at k = {k:g}")
            for k, rates in zip(LEVELS, printed, strict=True)
        ),
        *(
            safer(
                f"DDSCBF is safer than the CBF at k = {k:g}",
                found[k]["ddscbf"],
                found[k][CBF],
                printed=False,
            )
            for k in LEVELS
        ),
    ]


def _falls(sample: Sample) -> str:
    """Return how far the CBF falls between the levels, over rates and horizons, in words."""
    alphas = CUBIC.further_alphas[: 1 if sample.quick else None]
    before, after = (
        100 * np.array([run.row.curve.rate for run in each.values()])
        for each in (
            rates_of(ENV, {"noise": k}, sample, [f"cbf:alpha={a}" for a in alphas]) for k in LEVELS
        )
    )
    return (
        f"the printed rate of the CBF falls by {PRINTED['CBF'][0] - PRINTED['CBF'][1]:.1f} points"
        f" from the lower to the higher noise; here by {(before - after).max():.1f} at most, over"
        f" alpha = {', '.join(f'{a:g}' for a in alphas)} 1/s and every horizon up to 2 s, down to"
        f" {after[:, -1].min():.1f} % at least"
    )


ARTEFACTS = {"table-5.2": compute}
