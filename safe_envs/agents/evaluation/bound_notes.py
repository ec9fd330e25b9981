"""Notes on the bounds of filters in the table of an evaluation.

Lower bound for held input <= measured rate <= attainable upper bound is one claim, of the env's own
steps. The bound for continuous control is another one, and stands by itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from safe_envs.agents.evaluation.held_input import NO_FILTER
from safe_envs.agents.evaluation.promise_notes import computed_notes
from safe_envs.agents.evaluation.rows import BoundSummary, EvaluationRow
from safe_envs.outward_text import number_at_most
from safe_envs.wrappers.conditions.text_parts import name_by_itself, names_promise

CHAIN = "bound, held input <= safe <= attainable is a chain: all three are of the env's own steps."
"""What the numbers of the chain are."""

PROVED = (
    "continuous control, >=: proved at these starts for every policy, if the filter acts at every"
    " instant: the judge proved all hypotheses and numbers of a theorem by interval branch and"
    " bound, rounded outwards, with exact rational parameters; leaving the workspace is an end."
)
"""What a proved bound for continuous control is."""

ESTIMATED = (
    "continuous control, est.: the value of a theorem in which the judge left a hypothesis or a"
    " number undecided, for which a search found no counterexample; not a bound that is proved."
)
"""What an estimated bound for continuous control is."""


def bound_notes(rows: Sequence[EvaluationRow]) -> list[str]:
    """Return what has to be known to read the bounds of an evaluation.

    Args:
        rows: of the evaluation.
    """
    filtered = [row for row in rows if row.kind == "filter"]
    known = [row for row in filtered if row.learning is None]
    none = (row for row in rows if row.held_bound is None)
    # That there is no filter needs no saying, but why its table of a closed loop is missing does.
    notes = _why_none("held input", ((r, r.held_note) for r in none if r.held_note != NO_FILTER))
    without = ((r, r.continuous_note) for r in known if r.continuous_bound is None)
    # What a table of steps has no bound for, its name says.
    notes += _why_none(
        "continuous control", (w for w in without if not name_by_itself(w[0].filter))
    )
    notes += [
        f"continuous control, {row.filter}: {row.continuous_note}"
        for row in filtered
        if row.continuous_word == "estimated" and row.continuous_note
    ]
    notes += held_notes(rows)
    notes += _of_drawn_starts(rows)
    notes += [PROVED] * _any(rows, "proved") + [ESTIMATED] * _any(rows, "estimated")
    return notes


def held_notes(rows: Sequence[EvaluationRow]) -> list[str]:
    """Return what the bounds for held input are.

    Args:
        rows: of an evaluation.
    """
    bounded = [row for row in rows if row.held_bound is not None]
    computed = [row.filter for row in bounded if row.held_word == "computed"]
    others = dict.fromkeys(
        f"held input, {row.filter}: {row.held_word}, {row.held_note}"
        for row in bounded
        if not names_promise(row.filter)
    )
    return [*[CHAIN] * bool(bounded), *others, *computed_notes(computed)]


def _why_none(claim: str, rows: Iterable[tuple[EvaluationRow, str | None]]) -> list[str]:
    """Return why filters have no bound, in a line for each reason."""
    names: dict[str, list[str]] = {}
    for row, note in rows:
        names.setdefault(note or "", []).append(row.filter)
    return [f"no bound, {claim}, for {', '.join(of)}: {note}" for note, of in names.items()]


def _of_drawn_starts(rows: Sequence[EvaluationRow]) -> list[str]:
    """Return how far the bounds at the starts of these episodes may be from those of all starts."""
    error = max((max(row.held_error, row.continuous_error) for row in rows), default=0.0)
    if not error:
        return []
    return [
        "bounds are means over the starts of these episodes, as the rates are; these starts are"
        f" drawn, and over all starts the standard error of such a mean is"
        f" {number_at_most(100 * error, 2)} points at most."
    ]


def _any(rows: Sequence[BoundSummary], word: str) -> bool:
    return any(row.continuous_word == word for row in rows)
