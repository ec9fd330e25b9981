"""The table of an evaluation: its columns, for a terminal, a page, a notebook and a paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from safe_envs.agents.evaluation.best_text import attainable_text, times_column
from safe_envs.agents.evaluation.bound_text import bound_text, continuous_text, held_text
from safe_envs.agents.evaluation.comparison import Comparison
from safe_envs.agents.evaluation.estimation import EstimationSummary
from safe_envs.agents.evaluation.evaluation_data import EvaluationData, FilterTiming
from safe_envs.agents.evaluation.rate_text import percent, percent_in, points_in
from safe_envs.agents.evaluation.rows import EvaluationRow
from safe_envs.outward_text import percent_at_most
from safe_envs.text_lines import visible
from safe_envs.text_tables import Column, FittedTable, arranged, without_empty
from safe_envs.wrappers.estimation.consistency import Consistency

_NONE = "-"
_SAFETY, _BEHAVIOR, _ESTIMATES, _TIMING = range(4)
_SHORT = ("bound, held input", "safe", "violations", "bound, continuous", "intervened")
_SHORT += ("infeasible", "return", "worst ident.", "bound, posterior")
_LEAST_P = 1e-10


@dataclass(frozen=True)
class EvaluationTable:
    """The columns of an evaluation, and what is the same in all its rows.

    Attributes:
        names: of the filters.
        columns: all others; those on safety, those on behavior and those on time are parts.
        facts: lines on columns that would be the same in every row.
    """

    names: Column
    columns: list[Column]
    facts: list[str]

    def arranged(self, width: int) -> list[FittedTable]:
        """Return tables that fit a width."""
        return arranged([self.names], self.columns, width)

    def short(self) -> EvaluationTable:
        """Return the columns that tell how safe each filter is, and how hard it works for it."""
        kept = [c for c in self.columns if c.plain_title.partition(" [")[0] in _SHORT]
        return replace(self, columns=[replace(c, part=i) for i, c in enumerate(kept)])


def evaluation_table(evaluation: EvaluationData, timing: bool = False) -> EvaluationTable:
    """Return the table of an evaluation.

    Args:
        evaluation: to show.
        timing: whether to add what depends on the machine: time of learning, steps per second.
    """
    rows, best = evaluation.rows, evaluation.best
    columns = [
        Column("bound, held\u00a0input", tuple(map(held_text, rows))),
        Column(f"safe [{interval_name(evaluation)}]", tuple(map(_rate, rows))),
        Column("viola\u00adtions", tuple(str(row.violations) for row in rows)),
        Column("bound, contin\u00aduous", tuple(map(continuous_text, rows))),
    ]
    times = times_column(best, rows)
    if times:
        columns.insert(3, Column("times un\u00adavoidable", tuple(times)))
    columns += _of_learning(rows)
    columns, empty = without_empty(columns, _NONE)
    facts = [f"attainable by any policy: {each}" for each in attainable_text(best)]
    why = "none of these has one" if evaluation.spec.bounds else "not computed"
    facts += [f"{title}: {why}" for title in empty]
    columns += _behavior(rows) + _estimates(rows)
    if timing:
        columns += _timing(evaluation.timing.rows)
    # The end of a line in the name of a file is no end of a line of the table.
    names = Column("filter", tuple(visible(row.filter, keep="") for row in rows), "l")
    return EvaluationTable(names, columns, facts)


def interval_name(evaluation: EvaluationData) -> str:
    """Return the name of the intervals of an evaluation, such as "95 % interval"."""
    return f"{100 * evaluation.config['confidence']:.10g} % interval"


def compared(evaluation: EvaluationData) -> list[Comparison]:
    """Return the comparisons of filters with each other; none where nothing is random."""
    if evaluation.is_deterministic:
        return []
    filters = {row.filter for row in evaluation.rows if row.kind == "filter"}
    return [c for c in evaluation.comparisons if filters.issuperset((c.first, c.second))]


def p_text(p: float) -> str:
    """Return a p value with its sign of relation."""
    return f"< {_LEAST_P:g}" if p < _LEAST_P else f"= {p:.2g}"


def describe(comparison: Comparison) -> str:
    """Return a comparison as a line."""
    first, second, p = comparison.first, comparison.second, comparison.mcnemar_p
    difference = points_in(comparison.difference, comparison.ci_low, comparison.ci_high)
    if p is None:
        return f"{first} - {second}: {difference}, over identifications and episodes"
    return (
        f"{first} - {second}: {difference}, McNemar p {p_text(p)} (safe with one only: {first}"
        f" {comparison.only_first}, {second} {comparison.only_second})"
    )


def thousands(number: float) -> str:
    """Return a number of steps per second."""
    return f"{number / 1e6:.2f} M" if number >= 1e6 else f"{number / 1e3:.0f} k"


def _rate(row: EvaluationRow) -> str:
    return percent_in(row.safety_rate, row.ci_low, row.ci_high)


def _of_learning(rows: Sequence[EvaluationRow]) -> list[Column]:
    """Return the columns on the safety of what was learned; none where nothing was."""
    columns = []
    if any(row.learning and row.learning.repeats > 1 for row in rows):
        columns.append(Column("worst ident.", tuple(map(_worst, rows))))
    if any(row.posterior_bound for row in rows):
        columns.append(Column("bound, posterior", tuple(map(_posterior_bound, rows))))
    return columns


def _behavior(rows: Sequence[EvaluationRow]) -> list[Column]:
    def share(row: EvaluationRow, rate: float | None) -> str:
        return percent(rate) if row.kind == "filter" else _NONE

    efforts = (row.effort_mean for row in rows)
    cells = {
        "min\u00a0h median": (f"{row.min_h_median:.3g}" for row in rows),
        "min\u00a0h 5\u00a0%": (f"{row.min_h_p05:.3g}" for row in rows),
        "inter\u00advened": (share(row, row.intervention_rate) for row in rows),
        "infeas\u00adible": (share(row, row.infeasible_rate) for row in rows),
        "effort": (_NONE if effort is None else f"{effort:.3g}" for effort in efforts),
        "return": (f"{row.return_mean:.4g}" for row in rows),
    }
    return [Column(title, tuple(each), part=_BEHAVIOR) for title, each in cells.items()]


def _estimates(rows: Sequence[EvaluationRow]) -> list[Column]:
    """Return the columns on estimates; none where all rows are at the true state."""
    if not any(row.estimation for row in rows):
        return []
    of = [row.estimation for row in rows]
    cells = {
        "NEES (ex­pected)": [_consistency(each and each.nees) for each in of],
        "NIS (ex­pected)": [_consistency(each and each.nis) for each in of],
        "lost": [_NONE if each is None else percent(each.lost_rate) for each in of],
        "h_B < 0 somewhere": [_outside(each) for each in of],
        "unsafe at most": [_unsafe_at_most(each) for each in of],
    }
    columns = [Column(title, tuple(each), part=_ESTIMATES) for title, each in cells.items()]
    return [column for column in columns if set(column.cells) != {_NONE}]


def _consistency(found: Consistency | None) -> str:
    if found is None:
        return _NONE
    return f"{found.mean:.3g} [{found.low:.3g}, {found.high:.3g}] ({found.expected:.3g})"


def _outside(found: EstimationSummary | None) -> str:
    if found is None or found.outside_rate is None:
        return _NONE
    low, high = found.outside_low or 0.0, found.outside_high or 0.0
    return percent_in(found.outside_rate, low, high)


def _unsafe_at_most(found: EstimationSummary | None) -> str:
    if found is None or found.unsafe_at_most is None:
        return _NONE
    return f"{percent_at_most(found.unsafe_at_most)} % {found.bound_word}"


def _timing(rows: Sequence[FilterTiming]) -> list[Column]:
    columns = []
    if any(row.learning_seconds is not None for row in rows):
        seconds = (row.learning_seconds for row in rows)
        cells = tuple(_NONE if each is None else f"{each:.2f} s" for each in seconds)
        columns.append(Column("learned in", cells, part=_TIMING))
    speeds = tuple(thousands(row.steps_per_second) for row in rows)
    return [*columns, Column("steps/s", speeds, part=_TIMING)]


def _worst(row: EvaluationRow) -> str:
    learning = row.learning
    return percent(min(learning.rates)) if learning and learning.repeats > 1 else _NONE


def _posterior_bound(row: EvaluationRow) -> str:
    bound = row.posterior_bound
    return _NONE if bound is None else bound_text(bound.probability, bound.word)
