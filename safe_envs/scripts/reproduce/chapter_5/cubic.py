"""The cubic system under unknown noise (thesis Sec. 5.4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from safe_envs.agents import make_problem
from safe_envs.dynamics.codegen import compile_function
from safe_envs.scripts.reproduce.chapter_5.noise_identification import (
    identifications,
    learning_values,
    models,
    repeated,
)
from safe_envs.scripts.reproduce.chapter_5.noise_terms import draw_learning, learning_outcome
from safe_envs.scripts.reproduce.chapter_5.paired_rates import (
    CHAPTER,
    EPISODES,
    NO_RATE,
    close,
    explain_gap,
    measured,
)
from safe_envs.scripts.reproduce.framework.artefact import Claim, Findings, Number, Workload
from safe_envs.scripts.reproduce.framework.paired import MeasuredFilter, is_above, is_below, safer
from safe_envs.wrappers import SCBF
from safe_envs.wrappers.verification.feasibility import verify

SETTINGS = CHAPTER.settings["cubic"]
ENV, LEVELS, ALPHA, FIXED = (SETTINGS[name] for name in ("env", "levels", "alpha", "fixed_start"))
PRINTED, note = CHAPTER.printed("table-5.2"), partial(CHAPTER.note, "table-5.2")
CBF, WITHOUT = f"cbf:alpha={ALPHA}", f"cbf:alpha={NO_RATE}"
_ALPHAS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
"""Rates among which the printed fall of the CBF is looked for, in 1/s."""

_FILTERS = {
    "SCBF": "scbf",
    "DDSCBF": "ddscbf",
    "CBF": CBF,
    "CBF with alpha = 0": WITHOUT,
    "no filter": "none",
}
Levels = Mapping[float, Mapping[str, MeasuredFilter]]
"""By filter at each level."""


def compute_table(sample: Workload) -> Findings:
    """Compute Table 5.2, also from a single start."""
    learned = {k: repeated(ENV, k, sample) for k in LEVELS}
    filters = ["none", CBF, WITHOUT, "scbf"]
    near, single = (
        {
            k: measured(ENV, {"noise": k, **start}, filters, models(learned[k]), sample)
            for k in LEVELS
        }
        for start in ({}, {"start": list(FIXED)})
    )
    literal = {
        k: measured(ENV, {"noise": k}, [], models(learned[k], "printed"), sample) for k in LEVELS
    }
    return Findings(
        numbers=numbers(near, _FILTERS),
        claims=claims(near),
        alternative_settings={
            f"a single start {FIXED} with h = .25": Findings(
                numbers(single, _FILTERS), claims(single)
            )
        },
        printed_formula=numbers(literal, {"DDSCBF": "ddscbf"}),
        data={
            f"k = {k:g}": {name: near[k][text].curve for name, text in _FILTERS.items()}
            for k in LEVELS
        },
        notes=[
            *(explain_gap(near[k], CBF, f"at k = {k:g}") for k in LEVELS),
            _falls(sample),
            *compare_with_no_filter(near),
            note("single", cbf=_fall(single, CBF), scbf=_fall(single, "scbf")),
            *_no_bound(sample),
        ],
    )


def numbers(found: Levels, filters: Mapping[str, str]) -> list[Number]:
    """Return the rates of filters at each level, with the printed ones.

    Args:
        found: all rates.
        filters: texts by name.
    """
    return [
        found[k][text].number(f"{name}, k = {k:g}", PRINTED[name][i] if name in PRINTED else None)
        for i, k in enumerate(LEVELS)
        for name, text in filters.items()
    ]


def claims(found: Levels) -> list[Claim]:
    """Return checks of ours.

    The text of the thesis says nothing about the table, and its orders are in the numbers.
    """
    return [
        *(
            close(found[k], PRINTED["SCBF"][i], PRINTED["DDSCBF"][i], f" at k = {k:g}")
            for i, k in enumerate(LEVELS)
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


def _fall(found: Levels, name: str) -> float:
    """Return by how many points a rate falls from the first level to the second."""
    before, after = (found[k][name].rate for k in LEVELS)
    return before - after


def _falls(sample: Workload) -> str:
    """Return how far the CBF falls between the levels, over rates and horizons, in words."""
    tried = _ALPHAS[:1] if sample.quick else _ALPHAS
    swept = [
        measured(ENV, {"noise": k}, [f"cbf:alpha={a}" for a in tried], [], sample) for k in LEVELS
    ]
    levels = [[np.array(runs.curve["rate"]) for runs in each.values()] for each in swept]
    largest = max(float((before - after).max()) for before, after in zip(*levels, strict=True))
    lowest = min(float(rates[-1]) for rates in levels[1])
    fell = PRINTED["CBF"][0] - PRINTED["CBF"][1]
    alphas = ", ".join(f"{a:g}" for a in tried)
    return note("falls", fell=fell, largest=largest, rates=alphas, lowest=lowest)


def compare_with_no_filter(found: Levels) -> list[str]:
    """Return on which side of the unfiltered rate the printed rates of the CBF are, in words."""
    said = []
    for k, printed in zip(LEVELS, PRINTED["CBF"], strict=True):
        free = found[k]["none"].number("")
        side = (
            "below" if is_above(free, printed) else "above" if is_below(free, printed) else "within"
        )
        ends = {"low": free.low, "high": free.high}
        said.append(note("side", k=k, printed=printed, side=side, **ends))
    return said


def _no_bound(sample: Workload) -> list[str]:
    """Return why h/sup h says nothing here, in words."""
    problem = make_problem(ENV)
    condition = SCBF().constraint(problem.model, problem.barriers[0])
    read = compile_function(
        problem.model.states,
        tuple(map(problem.model.numeric, (*condition.coefficient, condition.offset))),
        "floats",
    )
    coefficient, offset = (value + 0.0 for value in read(-1.0, 0.0))  # no -0
    notes = [note("no_bound", coefficient=coefficient, offset=offset)]
    if sample.quick:
        return notes
    found = verify(problem, (SCBF(),), samples=1024)
    reason = found.guarantee.applicable_bounds(np.array([FIXED]), problem.duration)[0].reason
    share = 100 * found.safe_set.infeasible
    return [*notes, note("not_met", reason=reason, share=share)]


def printed_term(x_2: Any) -> Any:
    """Return the last term of the printed A h, -sigma(x_2)^2, at the first level."""
    return -((LEVELS[0] * x_2) ** 2)


def _table_values(sample: Workload) -> dict[str, Any]:
    return {"count": sample.size(EPISODES), "identifications": identifications(sample)}


_SIGMA = f"sigma = {LEVELS[0]:g} x_2"

ARTEFACTS = (
    CHAPTER.artefact(
        "figure-5.2",
        partial(learning_outcome, ENV, LEVELS[0], 1, f"-sigma(x_2)^2 at {_SIGMA}", printed_term),
        partial(learning_values, region="C within [-1, 1]^2", law=_SIGMA),
        draw_learning,
    ),
    CHAPTER.artefact("table-5.2", compute_table, _table_values),
)
