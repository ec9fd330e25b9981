"""The evaluations of an agent during its training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from safe_envs.agents.evaluation.rate_text import rate_of
from safe_envs.scripts.options.console import say
from safe_envs.scripts.reports.tables import print_rows


def print_evaluations(
    console: Console, filter_name: str, rows: Sequence[Mapping[str, Any]]
) -> None:
    """Print the safety and the return of the agent in each evaluation.

    Args:
        console: to print on.
        filter_name: text of the filter in the loop.
        rows: content of `evaluations.json`.
    """
    titles = ("steps", "safe [95 % interval]", "return", "violations in training")
    cells = [
        (
            f"{row['timesteps']:,}",
            rate_of(row),
            f"{row['return_mean']:.4g}",
            f"{row['training']['violations']:.0f}",
        )
        for row in rows
    ]
    say(console, f"Evaluations with the filter {filter_name}:")
    print_rows(console, "r", titles, cells)
    if rows and "constraint" in rows[-1]:
        _print_constraint(console, rows[-1])


def _print_constraint(console: Console, row: Mapping[str, Any]) -> None:
    """Print whether the agent keeps its limit."""
    judgement = row["constraint"]
    of_violations = judgement["kind"] == "violation_limit"
    what = "P(any violation)" if of_violations else "unsafe steps of an episode"

    def number(value: float) -> str:
        return f"{100.0 * value:.3g} %" if of_violations else f"{value:.3g}"

    limit = f"{what} <= {number(judgement['limit'])}"
    measured = "nothing in the training, as not every env has ended an episode"
    if judgement["episodes"]:
        interval = f"[{number(judgement['low'])}, {number(judgement['high'])}]"
        measured = (
            f"{number(judgement['mean'])} {interval} in the last {judgement['episodes']} episodes"
            " of the training, which explore"
        )
    if of_violations:
        low, high = 1.0 - row["ci_high"], 1.0 - row["ci_low"]
        measured += (
            f"; {number(1.0 - row['safety_rate'])} [{number(low)}, {number(high)}] in the"
            f" {row['episodes']} episodes of the last evaluation, which do not explore"
        )
    multiplier = f"The multiplier is {judgement['multiplier']:.3g}"
    multiplier += ", its greatest value." if judgement["saturated"] else "."
    if judgement["met"] is not False:
        say(console, f"Limit: {limit}. Measured: {measured}. {multiplier}")
        return
    if judgement["evaluation_met"]:
        say(
            console,
            f"NOT MET by the policy as it explores: the limit {limit}. Measured: {measured}."
            f" {multiplier} The evaluation does not exclude the limit.",
        )
        return
    say(
        console,
        f"NOT MET: the limit {limit}. Measured: {measured}. {multiplier} Either the limit cannot be"
        " reached, or the training is too short: give a larger limit, more steps, or a filter.",
    )
