"""The table of an evaluation: its columns, for a terminal, a page, a notebook and a paper.

Only what is proved, or certified, stands after ">=". Bounds are rounded down.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from safe_envs.agents.evaluation.attainable import (
    AttainableSafety,
    TimesUnavoidable,
    times_unavoidable,
)
from safe_envs.agents.evaluation.results import EvaluationData, FilterTiming
from safe_envs.agents.evaluation.rows import BoundSummary, EstimationSummary, EvaluationRow
from safe_envs.agents.evaluation.statistics import Comparison, percent, percent_in, points_in
from safe_envs.filters.estimation.consistency import Consistency
from safe_envs.problem.problem import SafetyProblem
from safe_envs.text import (
    Column,
    FittedTable,
    arranged,
    percent_at_least,
    percent_at_most,
    percents_between,
    rounded,
    visible,
    without_empty,
)

NO_BOUND = "-"

_FORMS: Mapping[str, str] = {
    "proved": ">= {} %",
    "certified": ">= {} %",
    "computed": "{} % comp.",
    "estimated": "{} % est.",
}


def bound_text(bound: float | None, word: str) -> str:
    """Return a bound as text: after ">=" only if its word allows it.

    Args:
        bound: in [0, 1]; None where there is none.
        word: what it is worth, a `HeldWord` or a `ContinuousWord`.

    Raises:
        KeyError: There is a bound, but the word is not of one.
    """
    if bound is None:
        return "withheld" if word == "withheld" else NO_BOUND
    if not bound:
        return f"{percent_at_least(bound)} %"
    return _FORMS[word].format(percent_at_least(bound))


def held_text(row: BoundSummary) -> str:
    """Return the bound of a row for the env's own steps, as text."""
    return bound_text(row.held_bound, row.held_word)


def continuous_text(row: BoundSummary) -> str:
    """Return the bound of a row for continuous control, as text."""
    return bound_text(row.continuous_bound, row.continuous_word)


def bound_cells(row: Mapping[str, Any]) -> tuple[str, str]:
    """Return the bounds of a row that is JSON-able data: for held input and continuous control."""
    pairs = (("held_bound", "held_word"), ("continuous_bound", "continuous_word"))
    first, second = (bound_text(row.get(bound), row.get(word) or "none") for bound, word in pairs)
    return first, second


COMPUTED = (
    "computed in floating point by dynamic programming of the env's own step, with the error of the"
    " grid in both ends"
)
"""What the ends of the best attainable safety are."""


def best_text(best: AttainableSafety | None) -> str:
    """Return the ends of the best attainable safety, in per cent; "-" where there are none."""
    return "-" if best is None else ends_text(best.lower, best.upper)


def ends_text(lower: float | None, upper: float | None) -> str:
    """Return two ends in per cent; "-" where there are none.

    Args:
        lower: the lower one.
        upper: the upper one.
    """
    if lower is None or upper is None:
        return "-"
    low, high = percents_between(lower, upper)
    return f"{low} %" if low == high else f"{low}..{high} %"


def times_text(times: TimesUnavoidable | None) -> str:
    """Return how many times the unavoidable violations, rounded outwards."""
    if times is None:
        return "-"
    low = _rounded(times.low, up=False)
    if times.high is None:
        return f">= {low}"
    high = _rounded(times.high, up=True)
    return low if low == high else f"{low}..{high}"


def times_column(best: AttainableSafety | None, rows: Sequence[EvaluationRow]) -> list[str]:
    """Return the cells of a column with `times_text`; none at all where nothing is known.

    Args:
        best: attainable safety, if it is known.
        rows: of an evaluation.
    """
    if best is None or best.lower is None:
        return []
    return [times_text(times_unavoidable(best, row.ci_low, row.ci_high)) for row in rows]


def best_line(best: AttainableSafety | None) -> str:
    """Return a line with the best attainable safety and how leaving counts; "" without it."""
    if best is None:
        return ""
    if best.lower is None:
        return "best attainable safety: withheld"
    return f"best attainable safety: {best_text(best)}"


def attainable_text(best: AttainableSafety | None) -> list[str]:
    """Return the upper end of the attainable safety, rounded up; none where it is not known.

    Args:
        best: attainable safety, if it is known; only a certified end stands after a sign.
    """
    if best is None or best.lower is None or best.upper is None:
        return []
    return [f"{'<= ' * is_certified(best)}{percents_between(best.lower, best.upper)[1]} %"]


def is_certified(best: AttainableSafety) -> bool:
    """Return whether the upper end of the attainable safety is of a table that was checked."""
    return best.check is not None and best.check.upper is not None


def best_notes(best: AttainableSafety | None) -> list[str]:
    """Return what has to be known to read the best attainable safety and the times."""
    if best is None:
        return []
    if best.contradiction:
        return [f"the best attainable safety is withheld: {best.contradiction}"]
    counted = (
        "It counts leaving the workspace as the rates do, as the end of a safe episode, which may"
        " be all that it takes; `safe-envs best` counts that as a violation."
        if best.leaving == "safe"
        else "Nothing outside the workspace is safe, so that leaving it counts as a violation."
    )
    return [
        "no policy is safer than the upper end of the best attainable safety, and some policy is as"
        f" safe as its lower end: {COMPUTED}, but not proved. {counted}",
        "times unavoidable: violations of a filter for each one that no policy can avoid, from (1 -"
        " upper end of the rate)/(1 - lower end of the best), at least 1, to (1 - lower end of the"
        " rate)/(1 - upper end of the best); only >= where none is shown to be unavoidable.",
    ]


def _rounded(value: float, *, up: bool) -> str:
    """Return a number from 1 on as text: below 10 with a digit after the point, else without."""
    return f"{float(rounded(value, 1 if value < 10.0 else 0, up=up)):.10g}"


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


_MARKS = {
    ">=": ">= is proved or certified",
    "comp.": "comp. is computed in floating point, and not proved",
    "est.": "est. is estimated, and not proved",
}


def marks_in(columns: Iterable[Column]) -> list[str]:
    """Return what the marks mean that the cells of bounds have.

    Args:
        columns: of a table; those whose titles begin with "bound" are looked at.
    """
    bounds = [column for column in columns if column.title.startswith("bound")]
    words = {word for column in bounds for cell in column.cells for word in str(cell).split()}
    return [text for mark, text in _MARKS.items() if mark in words]


NOTHING_RANDOM = (
    "nothing is random here (no noise, a fixed start, a deterministic policy), so that all"
    " episodes are one and the same: the interval has no meaning."
)


def setting_lines(evaluation: EvaluationData) -> list[str]:
    """Return the setting of an evaluation, and what its rates do not tell by themselves."""
    lines, best = [setting_text(evaluation.config, evaluation.problem)], evaluation.best
    notes = unsafe_starts(1.0 - evaluation.rows[0].curve.rate[0])
    notes += [best_line(best)] if best and best.contradiction else []
    notes += [NOTHING_RANDOM] if evaluation.is_deterministic else []
    sensor = sensor_text(evaluation.config)
    lines += [sensor] if sensor else []
    return lines + [note[:1].upper() + note[1:].rstrip(".") for note in notes]


def setting_text(config: Mapping[str, Any], problem: SafetyProblem) -> str:
    """Return system, timing, monitoring and what filters know.

    Args:
        config: of the evaluation.
        problem: that was evaluated.
    """
    seen = config["filter_spec"]
    system = (
        f"seen through {seen}, {_describe_timing(problem)}" if seen else describe_system(problem)
    )
    goal = ", joint QP with the goal" if config["objective"] == "clf" else ""
    watched = ", monitored continuously" if config["monitoring"] == "continuous" else ""
    return f"{system}{watched}; filters know the {config['knowledge']}{goal}"


def sensor_text(config: Mapping[str, Any]) -> str:
    """Return the sensor and the estimator of an evaluation; "" without a sensor.

    Args:
        config: of the evaluation.
    """
    measured = config.get("measurement")
    if measured is None:
        return ""
    channels = []
    for c in measured["channels"]:
        errors = {"sd": c["noise"], "bias": c["bias"], "dropout": c["dropout"]}
        told = [f"{key} {value:g}" for key, value in errors.items() if value or key == "sd"]
        channels.append(f"{c['name']} ({', '.join(told)})")
    late = f", {measured['delay']} control periods late" if measured["delay"] else ""
    seen = config["estimator"]
    known = f"; estimator {seen}, policies see the {config['observe']}" if seen else ""
    return f"sensor: {', '.join(channels)}{late}{known}"


def unsafe_starts(share: float) -> list[str]:
    """Return a note on episodes that start where h <= 0, if there are some."""
    if share == 0.0:
        return []
    some = "all episodes start" if share == 1.0 else f"{percent(share)} of the episodes start"
    return [f"{some} where h <= 0: they count as violated whatever a filter does"]


def describe_system(problem: SafetyProblem) -> str:
    """Return noise, mismatch and timing of a problem."""
    return f"{describe_plant(problem)}, {_describe_timing(problem)}"


def _describe_timing(problem: SafetyProblem) -> str:
    return f"dt = {problem.dt:g} s, horizon {problem.duration:g} s"


def describe_plant(problem: SafetyProblem) -> str:
    """Return noise and mismatch of a problem."""
    plant = {p.name: value for p, value in problem.plant.parameters.items()}
    model = {p.name: value for p, value in problem.model.parameters.items()}
    noise = ", ".join(f"{name} = {plant[name]:g}" for name in problem.noise)
    differing = [
        f"{name} = {plant[name]:g} (model {model[name]:g})"
        for name in plant
        if plant[name] != model[name]
    ]
    told = (
        f"noise {noise}"
        if any(plant[name] for name in problem.noise)
        else "fixed noise"
        if problem.plant.noisy
        else "no noise"
    )
    mismatch = f"plant {', '.join(differing)}" if differing else "model = plant"
    return f"{told}, {mismatch}"
