"""Rows of an evaluation with a sensor: each filter at the true state, at the estimate, and more.

A name with `@state` is a filter at the true state: in the same problem without a sensor, whose
noise is the same. Any other name is of the filter at the estimate.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from safe_envs.agents.evaluation.belief_bound import delta_of, why_not_proved
from safe_envs.agents.evaluation.estimation import (
    EstimationResults,
    EstimationSummary,
    summary_of,
)
from safe_envs.agents.evaluation.resolved import FilterParts, ResolvedEvaluation, conditions_of
from safe_envs.agents.evaluation.rows import RowKind
from safe_envs.agents.evaluation.spec import (
    UNFILTERED,
    EvaluationSpec,
    Filter,
    conditions_in,
    filter_text,
)
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.options import SENSOR_OPTIONS
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers import Condition
from safe_envs.wrappers.conditions.names import AT_STATE, PARAMETERS
from safe_envs.wrappers.conditions.text_parts import parts_of

AT_ESTIMATES = "it decides at an estimate, and these bounds are of filters at the true state"
"""Why filters at an estimate have no bounds of true states."""


class View(NamedTuple):
    """A row of an evaluation.

    Attributes:
        name: of the row.
        base: name of its filter in what is resolved.
        resolved: the evaluation at the true state, or at the estimate.
    """

    name: str
    base: str
    resolved: ResolvedEvaluation

    @property
    def kind(self) -> RowKind:
        """What the row is of."""
        return "unfiltered" if self.base == UNFILTERED else "filter"

    @property
    def estimates(self) -> bool:
        """Whether the filter decides at an estimate."""
        return self.resolved.estimator is not None

    @property
    def filters(self) -> list[FilterParts]:
        """What the filter is made of, in each repeat; there once everything is learned."""
        return self.resolved.filters[self.base]

    @property
    def described(self) -> dict[str, str]:
        """Name and text of the filter."""
        return {"name": self.name, "spec": self.resolved.text_of(self.base)}

    @property
    def why_no_bound(self) -> str | None:
        """Why not to look for bounds that are of true states; None where they are."""
        if self.estimates:
            return AT_ESTIMATES
        conditions = conditions_of(self.filters[0])
        return AT_ESTIMATES if any(c.measurement_error for c in conditions) else None

    def estimation(
        self, found: Sequence[EstimationResults | None], confidence: float
    ) -> EstimationSummary | None:
        """Return how good the estimates were; None at the true state.

        Args:
            found: of the episodes with each identification.
            confidence: of the intervals.
        """
        estimator = self.resolved.estimator
        parts = [each for each in found if each is not None]
        if estimator is None or not parts:
            return None
        delta = delta_of(conditions_of(self.filters[0]))
        monitoring = self.resolved.spec.monitoring
        why_not = why_not_proved(self.resolved.problem, estimator, monitoring) if delta else None
        return summary_of(EstimationResults.joined(parts), confidence, delta, why_not)


def views_of(spec: EvaluationSpec) -> list[View]:
    """Return the rows of an evaluation, everything made that they need.

    Args:
        spec: what is asked for.

    Raises:
        ConfigurationError: The spec names something unknown, or parts of it do not fit together.
        RelativeDegreeError: A condition does not suit a barrier.
    """
    if spec.estimator is None:
        _refuse_true_state(spec.filters or ())
        only = ResolvedEvaluation(spec)
        return [View(name, name, only) for name in only.names]
    asked = _named(spec)
    at_state = {name: each for name, each, truth in asked if truth}
    at_estimate = {name: each for name, each, truth in asked if not truth}
    resolved: dict[bool, ResolvedEvaluation] = {}
    if at_estimate:
        resolved[False] = ResolvedEvaluation(replace(spec, filters=tuple(at_estimate.values())))
    if at_state:
        given = tuple(at_state.values())
        learning = resolved[False].learning if at_estimate else None
        resolved[True] = ResolvedEvaluation(_without_sensor(spec, given), learning)
    return [View(name, filter_text(each), resolved[truth]) for name, each, truth in asked]


def _named(spec: EvaluationSpec) -> list[tuple[str, Filter, bool]]:
    """Return names, filters, and whether they are at the true state, of all rows."""
    asked = spec.filters
    if asked is None:
        from safe_envs.agents.evaluation.targets import make_target

        target = make_target(spec.problem, spec.options, spec.filter_spec)
        asked = (UNFILTERED, target.filter)
    # Who names one row at the true state names all.
    explicit = not spec.compare_estimates or any(
        isinstance(each, str) and each.endswith(AT_STATE) for each in asked
    )
    found: dict[str, tuple[str, Filter, bool]] = {}
    for each in asked:
        rows = [_stated(each)] if explicit else _expanded(each, spec.belief)
        for row in rows:
            # At the true state nothing is measured that a policy could see.
            if explicit or not row[2] or spec.observe == "estimate":
                found.setdefault(row[0], row)
    return list(found.values())


def _stated(given: Filter) -> tuple[str, Filter, bool]:
    name = filter_text(given)
    if isinstance(given, str) and given.endswith(AT_STATE):
        return name, given.removesuffix(AT_STATE), True
    return name, given, False


def _expanded(given: Filter, belief: float) -> list[tuple[str, Filter, bool]]:
    """Return a filter at the true state, at the estimate, and with the belief if it can have it."""
    name = filter_text(given)
    known = _with_belief(given, belief)
    if known is None and _has_belief(given):
        return [(name, given, False)]
    rows: list[tuple[str, Filter, bool]] = [(name + AT_STATE, given, True), (name, given, False)]
    return rows if known is None else [*rows, (filter_text(known), known, False)]


def _with_belief(given: Filter, belief: float) -> Filter | None:
    """Return a filter whose conditions know the belief; None where they cannot, or do already.

    A bound of the error, `measurement_error`, leaves the belief no place.
    """
    if _has_belief(given) or _has_bound(given):
        return None
    if isinstance(given, str):
        parts = [] if given == UNFILTERED else parts_of(given)
        if not parts or any(part.name not in PARAMETERS for part in parts):
            return None
        return "+".join(f"{part.text.strip()}:belief={belief:g}" for part in parts)
    conditions = conditions_in(given)
    if any(condition.is_learned or condition.autonomous for condition in conditions):
        return None
    return tuple(replace(condition, belief=belief) for condition in conditions)


def _has_belief(given: Filter) -> bool:
    if isinstance(given, str):
        return ":belief=" in given
    return any(condition.belief is not None for condition in conditions_in(given))


def _has_bound(given: Filter) -> bool:
    if isinstance(given, str):
        return ":measurement_error=" in given
    return any(condition.measurement_error for condition in conditions_in(given))


def _without_sensor(spec: EvaluationSpec, filters: Sequence[Filter]) -> EvaluationSpec:
    """Return an evaluation of the same at the true state."""
    problem: Any = spec.problem
    if isinstance(problem, SafetyProblem):
        problem = problem.unmeasured
    options = {name: value for name, value in spec.options.items() if name not in SENSOR_OPTIONS}
    return replace(
        spec,
        problem=problem,
        options=options,
        estimator=None,
        observe="estimate",
        filters=tuple(filters),
    )


def _refuse_true_state(filters: Iterable[str | Condition | Sequence[Condition]]) -> None:
    for each in filters:
        if isinstance(each, str) and each.endswith(AT_STATE):
            raise ConfigurationError(
                f"filter {shown(each)}: without an estimator every filter is at the true state;"
                " leave @state out, or give --measurement default and --estimator ekf (in Python:"
                " options={'measurement': 'default'}, estimator='ekf')"
            )
