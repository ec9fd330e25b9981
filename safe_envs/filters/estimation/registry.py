"""Estimators by their names: `kf`, `ekf`, `ukf:alpha=.5`, `ekf:process_noise=.1`."""

from __future__ import annotations

from typing import Any

from safe_envs.errors import ConfigurationError, shown
from safe_envs.filters.estimation.estimator import Estimator, initial_belief, require_observable
from safe_envs.filters.estimation.kalman import ExtendedKalmanFilter, KalmanFilter
from safe_envs.filters.estimation.names import settings_of
from safe_envs.filters.estimation.unscented import UnscentedKalmanFilter
from safe_envs.problem.actuators import require_direct
from safe_envs.problem.measurement import Measurement
from safe_envs.problem.problem import SafetyProblem
from safe_envs.text import numbers

_CLASSES = {each.name: each for each in (KalmanFilter, ExtendedKalmanFilter, UnscentedKalmanFilter)}


def make_estimator(given: Any, problem: SafetyProblem, knowledge: str = "model") -> Estimator:
    """Return an estimator of a measured problem, which begins with its start distribution.

    Args:
        given: its text, or an `Estimator` with an initial belief, which is returned.
        problem: with a measurement.
        knowledge: "model" for what the designer believes, "plant" for the true system.

    Raises:
        ConfigurationError: The name or a setting is unknown, the problem is not measured or has
            delayed or rate-limited actuators, or an `Estimator` is of something else.
        SystemDefinitionError: The measurement does not determine the state.
    """
    measured = require_measured(problem)
    require_direct(problem, "estimators")
    if isinstance(given, Estimator):
        if given.model.states != problem.model.states:
            raise ConfigurationError(
                f"the estimator {given.text} is of other states than {problem.name}; make one for"
                " its model"
            )
        if given.initial is None or given.measurement != measured:
            what = "has no initial belief" if given.initial is None else "is of another sensor"
            raise ConfigurationError(
                f"the estimator {given.text} {what}; make it with initial=... and the measurement"
                f" of {problem.name}, or name it, like 'ekf'"
            )
        return given
    if not isinstance(given, str):
        raise ConfigurationError(
            f"estimator = {shown(given)}; give kf, ekf or ukf, or an Estimator object"
        )
    name, settings = settings_of(given)
    known = problem.plant if knowledge == "plant" else problem.model
    values: dict[str, Any] = {key: numbers(key, text) for key, text in settings.items()}
    single = {key: value[0] if len(value) == 1 else value for key, value in values.items()}
    initial = initial_belief(problem)
    found = _CLASSES[name](known, measured, problem.dt, problem.substeps, initial=initial, **single)
    require_observable(found, problem, initial)
    return found


def require_measured(problem: SafetyProblem) -> Measurement:
    """Return the measurement of a problem, or raise ConfigurationError where there is none."""
    if problem.measurement is None:
        raise ConfigurationError(
            f"{problem.name} shows its true state, so that there is nothing to estimate; make it"
            " with measurement='default', or leave the estimator out"
        )
    return problem.measurement
