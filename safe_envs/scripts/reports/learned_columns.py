"""Columns and notes of an evaluation's table on learned models and posterior bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from safe_envs.agents.evaluation.bound_text import bound_text
from safe_envs.agents.evaluation.rate_text import percent
from safe_envs.agents.evaluation.results import FilterTiming
from safe_envs.agents.evaluation.rows import EvaluationRow
from safe_envs.dynamics.lie import lie_derivative_g, vanishes
from safe_envs.problem.problem import SafetyProblem

Cell = Callable[[EvaluationRow, FilterTiming], str]
"""From a row, and what was timed of it, to a text."""

_NONE = "-"


def learned_columns(rows: Sequence[EvaluationRow]) -> dict[str, Cell]:
    """Return the columns that the rows need, by title; none where nothing was learned."""
    columns: dict[str, Cell] = {}
    repeats = _repeats(rows)
    if repeats:
        columns["learned\nin" if repeats == 1 else "learned in,\nmean"] = _seconds
    if repeats > 1:
        columns["worst\nident."] = _worst
    if any(row.posterior_bound for row in rows):
        columns["bound,\nposterior"] = _posterior_bound
    return columns


def learned_notes(rows: Sequence[EvaluationRow], problem: SafetyProblem) -> list[str]:
    """Return notes on what was learned of a problem, and on bounds over posteriors.

    Args:
        rows: of the evaluation.
        problem: that was evaluated.
    """
    repeats = _repeats(rows)
    if not repeats:
        return []
    untried = not any(row.posterior_bound for row in rows) and _may_have_a_bound(problem)
    hint = (
        "; for bayesian-scbf:simultaneous=P there may be one over the posterior" if untried else ""
    )
    notes = [f"no bound for learned filters{hint}."]
    if repeats > 1:
        notes.append(
            f"the intervals take the rates of the {repeats} identifications for nearly normal: bad"
            " ones that are rarer than about 1 in "
            f'{repeats} go unseen, and "worst ident." is the worst of those seen.'
        )
    for row in rows:
        name, learning, bound = row.filter, row.learning, row.posterior_bound
        if learning and learning.files:
            notes.append(
                f"{name} was learned before, from {learning.transitions:,} transitions:"
                f" {', '.join(learning.files)}"
            )
        elif learning:
            each = " each" if learning.repeats > 1 else ""
            notes.append(f"{name} was learned from {learning.transitions:,} transitions{each}.")
        if learning:
            notes += [f"{name}: {warning}" for warning in (*learning.remarks, *learning.warnings)]
        if bound and bound.note:
            notes.append(f"bound of {name} over the posterior: {bound.note}")
        if bound and bound.delta is not None:
            word = "" if bound.probability is None else f" {bound.word} given the posterior,"
            notes.append(
                f"bound of {name} over the posterior: (1 - delta)(h_0 - (m + e) T)/c,{word}"
                f" with probability delta = {bound.delta:.3g} that the identification"
                f" does not contain the system, shortfall m = {bound.shortfall:.3g}, bias of the"
                f" steps e = {bound.bias:.3g}, c = {bound.supremum:.3g}."
            )
    return notes


def _repeats(rows: Sequence[EvaluationRow]) -> int:
    """Return the number of identifications of what was learned; 0 where nothing was."""
    return max((row.learning.repeats for row in rows if row.learning), default=0)


def _may_have_a_bound(problem: SafetyProblem) -> bool:
    """Return whether a problem has one barrier, of relative degree 1.

    Others have no robust condition, which such a bound needs.
    """
    if len(problem.barriers) != 1:
        return False
    (barrier,) = problem.barriers
    return not all(
        vanishes(problem.plant, entry)
        for entry in lie_derivative_g(problem.plant, barrier.expression)
    )


def _seconds(_: EvaluationRow, timing: FilterTiming) -> str:
    seconds = timing.learning_seconds
    return _NONE if seconds is None else f"{seconds:.2f} s"


def _worst(row: EvaluationRow, _: FilterTiming) -> str:
    learning = row.learning
    return percent(min(learning.rates)) if learning and learning.repeats > 1 else _NONE


def _posterior_bound(row: EvaluationRow, _: FilterTiming) -> str:
    bound = row.posterior_bound
    return _NONE if bound is None else bound_text(bound.probability, bound.word)
