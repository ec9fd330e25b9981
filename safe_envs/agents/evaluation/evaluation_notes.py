"""Notes under the table of an evaluation: what has to be known to read it."""

from __future__ import annotations

from safe_envs.agents.evaluation.best_text import best_notes
from safe_envs.agents.evaluation.bound_notes import bound_notes
from safe_envs.agents.evaluation.brownian_bridge import bridge_notes
from safe_envs.agents.evaluation.estimation_notes import estimation_notes
from safe_envs.agents.evaluation.evaluation_data import EvaluationData
from safe_envs.agents.evaluation.learned_notes import learned_notes
from safe_envs.agents.evaluation.rows import EvaluationRow


def evaluation_notes(evaluation: EvaluationData) -> list[str]:
    """Return what has to be known to read the table of an evaluation, besides its setting.

    Args:
        evaluation: to read.
    """
    steps = evaluation.problem.steps
    notes = [note for row in evaluation.rows for note in (*_of_starts(row), *_of_violations(row))]
    notes += estimation_notes(evaluation.rows)
    notes += bound_notes(evaluation.rows)
    notes += best_notes(evaluation.best)
    notes += learned_notes(evaluation.rows, evaluation.problem)
    for row, speed in zip(evaluation.rows, evaluation.timing.rows, strict=True):
        length = speed.steps / row.episodes  # With repeats both are of all identifications.
        if length < 0.99 * steps:
            notes.append(early_end(row.filter, "mean episode", length, steps))
    if evaluation.config["monitoring"] == "continuous":
        notes += bridge_notes(evaluation.problem)
    return notes


def _of_starts(row: EvaluationRow) -> list[str]:
    """Return from which of its starts a row has no bound for continuous control."""
    if not row.outside_rate:
        return []
    return [
        f"{100 * row.outside_rate:.3g} % of the starts lie outside the sets C_j = {{b_j >="
        f" 0}}, j >= 1, that {row.filter} keeps: no bound holds from there"
    ]


def _of_violations(row: EvaluationRow) -> list[str]:
    """Return how many violations are no more than rounding."""
    touching, below, violations = row.touching, row.below_rounding, row.violations
    if not (touching or below):
        return []
    count = max(touching, below)
    some = "all violations" if count == violations else f"{count} of the {violations} violations"
    if below > touching:
        return [
            f"{some} of {row.filter} are below rounding, worst violation"
            f" {row.worst_below_rounding:.2g}: they settle on the edge h = 0, and safe is h > 0"
        ]
    return [
        f"{some} of {row.filter} come no lower than h = 0 to rounding: they touch the edge, and"
        " safe is h > 0"
    ]


def early_end(name: str, which: str, length: float, steps: int) -> str:
    """Return a note on episodes that do not last as long as they might.

    Args:
        name: of the filter.
        which: episodes they are.
        length: their mean length in control periods.
        steps: of a whole episode.
    """
    return (
        f"with {name} the {which} ends after {length:.1f} of {steps} steps, at the goal or outside"
        " the workspace; its safety is that of the instants until then."
    )
