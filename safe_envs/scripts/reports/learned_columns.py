"""What the table of an evaluation says of learning: its time, the worst identification, bounds over
posteriors, and notes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from safe_envs.agents.evaluation.rollout import Row
from safe_envs.dynamics.lie import lie_derivative_g, vanishes
from safe_envs.problem.problem import SafetyProblem
from safe_envs.scripts.reports.rates import percent

Cell = Callable[[Row, Mapping[str, Any]], str]
"""From a row, and what was timed of it, to a text."""

_NONE = "-"


def learned_columns(rows: Sequence[Row]) -> dict[str, Cell]:
    """The columns that the rows need, by title; none where nothing was learned."""
    columns: dict[str, Cell] = {}
    repeats = _repeats(rows)
    if repeats:
        columns["learned\nin" if repeats == 1 else "learned in,\nmean"] = _seconds
    if repeats > 1:
        columns["worst\nident."] = _worst
    if any(row["posterior_bound"] for row in rows):
        columns["estimated,\nposterior"] = _posterior_bound
    return columns


def learned_notes(rows: Sequence[Row], problem: SafetyProblem) -> list[str]:
    """What has to be known of what was learned of a problem, and of bounds over posteriors."""
    repeats = _repeats(rows)
    if not repeats:
        return []
    untried = not any(row["posterior_bound"] for row in rows) and _may_have_a_bound(problem)
    hint = (
        "; for bayesian-scbf:simultaneous=P one may be estimated over the posterior"
        if untried
        else ""
    )
    notes = [f"no bound for what rests on something learned{hint}."]
    if repeats > 1:
        notes.append(
            f"the intervals take the rates of the {repeats} identifications for nearly normal: bad"
            " ones that are rarer than about 1 in "
            f'{repeats} go unseen, and "worst ident." is the worst of those seen.'
        )
    for row in rows:
        learning, bound = row["learning"], row["posterior_bound"]
        if learning and learning["files"]:
            notes.append(
                f"{row['filter']} was learned before, from {learning['transitions']:,} transitions:"
                f" {', '.join(learning['files'])}"
            )
        elif learning:
            each = " each" if learning["repeats"] > 1 else ""
            notes.append(
                f"{row['filter']} was learned from {learning['transitions']:,} transitions{each}."
            )
        notes += [
            f"{row['filter']}: {warning}"
            for warning in ([*learning["remarks"], *learning["warnings"]] if learning else ())
        ]
        if bound and bound["note"]:
            notes.append(f"bound of {row['filter']} over the posterior: {bound['note']}")
        if bound and "delta" in bound:
            notes.append(
                f"bound of {row['filter']} over the posterior: (1 - delta)(h_0 - (m + e) T)/c,"
                f" estimated, with probability delta = {bound['delta']:.3g} that the identification"
                f" misses the system, shortfall m = {bound['shortfall']:.3g}, bias of the steps e ="
                f" {bound['bias']:.3g}, c = {bound['supremum']:.3g}."
            )
    return notes


def _repeats(rows: Sequence[Row]) -> int:
    """The number of identifications of what was learned; 0 where nothing was."""
    return max((row["learning"]["repeats"] for row in rows if row["learning"]), default=0)


def _may_have_a_bound(problem: SafetyProblem) -> bool:
    """Whether a problem has one barrier, of relative degree 1: for others there is no robust
    condition, on which such a bound rests.
    """
    if len(problem.barriers) != 1:
        return False
    (barrier,) = problem.barriers
    return not all(
        vanishes(problem.plant, entry)
        for entry in lie_derivative_g(problem.plant, barrier.expression)
    )


def _seconds(_: Row, speed: Mapping[str, Any]) -> str:
    seconds = speed["learning_seconds"]
    return _NONE if seconds is None else f"{seconds:.2f} s"


def _worst(row: Row, _: Mapping[str, Any]) -> str:
    learning = row["learning"]
    return percent(min(learning["rates"])) if learning and learning["repeats"] > 1 else _NONE


def _posterior_bound(row: Row, _: Mapping[str, Any]) -> str:
    bound = row["posterior_bound"]
    if bound is None:
        return _NONE
    if bound["probability"] is None:
        return "withheld" if row["withheld"] else "none"
    return percent(bound["probability"])
