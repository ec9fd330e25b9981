"""Notes on estimates in the table of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence

from safe_envs.agents.evaluation.rows import EvaluationRow

_OF_ROWS = (
    "rows with @state know the true state; the others decide at the estimate, on the same noise of"
    " the plant. All are judged on the true state"
)
_PROVED = (
    "unsafe at most, proved: P(unsafe) <= P(h_B < 0 somewhere) + delta, with the upper end of the"
    " interval of the first term"
)
_OF_NEES = (
    "NEES and NIS are means over all control instants of the episodes, those after a violation"
    " included, with intervals over episodes; an honest estimator has the expected ones"
)


def estimation_notes(rows: Sequence[EvaluationRow]) -> list[str]:
    """Return what has to be known to read the estimates of an evaluation.

    Args:
        rows: of the evaluation.
    """
    estimated = [(row.filter, row.estimation) for row in rows if row.estimation is not None]
    if not estimated:
        return []
    notes = [_OF_ROWS, _OF_NEES]
    certain = [
        name for name, each in estimated if each.nees and each.nees.low > 1.5 * each.nees.expected
    ]
    if certain:
        notes.append(
            f"the estimator is too certain with {', '.join(certain)}: its errors are larger than it"
            " believes, by a mismatch, a bias or a nonlinearity; give it process_noise, as in"
            " ekf:process_noise=.1, or take ukf"
        )
    bounded = [(name, each) for name, each in estimated if each.delta is not None]
    notes += [_PROVED] * any(each.bound_word == "proved" for _, each in bounded)
    reasons: dict[str, list[str]] = {}
    for name, each in bounded:
        if each.bound_note:
            reasons.setdefault(each.bound_note, []).append(name)
    notes += [
        f"unsafe at most, designed, for {', '.join(names)}: not proved, since {note}; what counts"
        " is the measured rate"
        for note, names in reasons.items()
    ]
    return notes
