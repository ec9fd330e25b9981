"""Notes under the table of an evaluation: what has to be known to read it.

Lower bound for held input <= measured rate <= attainable upper bound is one claim, of the env's own
steps. The bound for continuous control is another one, and stands by itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from safe_envs.agents.evaluation.bounds import NO_FILTER
from safe_envs.agents.evaluation.brownian_bridge import bridge_notes
from safe_envs.agents.evaluation.results import EvaluationData
from safe_envs.agents.evaluation.rows import BoundSummary, EvaluationRow, PosteriorSummary
from safe_envs.agents.evaluation.table import best_notes
from safe_envs.dynamics.lie import lie_derivative_g, vanishes
from safe_envs.filters.conditions.names import AT_STATE
from safe_envs.filters.conditions.syntax import name_by_itself, names_promise
from safe_envs.problem.problem import SafetyProblem
from safe_envs.text import number_at_least, number_at_most
from safe_envs.values.promise_filter import PromiseSettings


def computed_notes(names: Iterable[str]) -> list[str]:
    """Return what the bounds of promise filters are.

    Args:
        names: of the filters that have a bound.
    """
    found = [name for name in names if names_promise(name)]
    if not found:
        return []
    which = f"the bound of {found[0]} is" if len(found) == 1 else "bounds of promise filters are"
    notes = [
        f"held input, comp.: {which} computed, not proved: the mean of p_0 over the starts, which"
        " the filter keeps for every policy up to the horizon, in the floating-point numbers of its"
        " table."
    ]
    settings = {name: PromiseSettings.of_text(name.removesuffix(AT_STATE)) for name in found}
    tasks = [name for name, each in settings.items() if each.specification]
    if tasks:
        notes.append(
            f"what {' and '.join(tasks)} keeps is the probability of meeting the specification,"
            " at least the mean of min(p, L_0) of the starts: a bound of being safe too, since no"
            " unsafe episode meets it."
        )
    return notes


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
    """Return whether a problem has one barrier, of relative degree 1."""
    if len(problem.barriers) != 1:
        return False
    (barrier,) = problem.barriers
    return not all(
        vanishes(problem.plant, entry)
        for entry in lie_derivative_g(problem.plant, barrier.expression)
    )


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
