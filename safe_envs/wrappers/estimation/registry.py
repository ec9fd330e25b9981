"""Estimators by their names: `kf`, `ekf`, `ukf:alpha=.5`, `ekf:process_noise=.1`."""

from __future__ import annotations

from typing import Any

from safe_envs.errors import ConfigurationError, shown
from safe_envs.number_text import numbers
from safe_envs.problem.measurement import Measurement
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.estimation.estimator import Estimator
from safe_envs.wrappers.estimation.kalman import ExtendedKalmanFilter, KalmanFilter
from safe_envs.wrappers.estimation.names import settings_of
from safe_envs.wrappers.estimation.unscented import UnscentedKalmanFilter

_CLASSES = {each.name: each for each in (KalmanFilter, ExtendedKalmanFilter, UnscentedKalmanFilter)}


def make_estimator(given: Any, problem: SafetyProblem, knowledge: str = "model") -> Estimator:
    """Return an estimator of a measured problem.

    Args:
        given: its text, or an `Estimator`, which is returned.
        problem: with a measurement.
        knowledge: "model" for what the designer believes, "plant" for the true system.

    Raises:
        ConfigurationError: The name or a setting is unknown, or the problem is not measured.
    """
    if isinstance(given, Estimator):
        if given.model.states != problem.model.states:
            raise ConfigurationError(
                f"the estimator {given.text} is of other states than {problem.name}; make one for"
                " its model"
            )
        return given
    if not isinstance(given, str):
        raise ConfigurationError(
            f"estimator = {shown(given)}; give kf, ekf or ukf, or an Estimator object"
        )
    name, settings = settings_of(given)
    measured = require_measured(problem)
    known = problem.plant if knowledge == "plant" else problem.model
    values: dict[str, Any] = {key: numbers(key, text) for key, text in settings.items()}
    single = {key: value[0] if len(value) == 1 else value for key, value in values.items()}
    return _CLASSES[name](known, measured, problem.dt, problem.substeps, **single)


def require_measured(problem: SafetyProblem) -> Measurement:
    """Return the measurement of a problem, or raise ConfigurationError where there is none."""
    if problem.measurement is None:
        raise ConfigurationError(
            f"{problem.name} shows its true state, so that there is nothing to estimate; make it"
            " with measurement='default', or leave the estimator out"
        )
    return problem.measurement
