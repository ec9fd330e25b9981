"""Notes under the table of an evaluation on learned models and posterior bounds."""

from __future__ import annotations

from collections.abc import Sequence

from safe_envs.agents.evaluation.rows import EvaluationRow, PosteriorSummary
from safe_envs.dynamics.lie import lie_derivative_g, vanishes
from safe_envs.outward_text import number_at_least, number_at_most
from safe_envs.problem.problem import SafetyProblem


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
            numbers = (bound.delta, bound.bias or 0.0)
            delta, e = (number_at_most(value, 3) for value in numbers)
            m, c = (_size(bound, each) for each in ("shortfall", "supremum"))
            notes.append(
                f"bound of {name} over the posterior: (1 - delta)(h_0 - (m + e) T)/c,{word}"
                f" with probability delta = {delta} that the identification does not contain the"
                f" system, shortfall m {m}, bias of the steps e = {e} at sampled states, c {c}."
            )
    return notes


def _size(bound: PosteriorSummary, name: str) -> str:
    """Return a number of a bound with its relation: a search's is below the true one."""
    value = getattr(bound, name) or 0.0
    if name in (bound.searched or ()):
        return f">= {number_at_least(value, 3)} (found by search)"
    return f"= {number_at_most(value, 3)}"


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
