"""The options of an evaluation at estimates, checked."""

from __future__ import annotations

from typing import Any

from safe_envs.errors import ConfigurationError, nearest, shown
from safe_envs.wrappers.estimation.names import settings_of

OBSERVATIONS = ("estimate", "measurement")
"""What policies may see of a measured env."""


def require_estimation(estimator: Any, belief: Any, observe: Any) -> None:
    """Raise ConfigurationError for options that are out of range.

    Args:
        estimator: text of an estimator; None for none.
        belief: probability.
        observe: what policies see.
    """
    if estimator is not None:
        if not isinstance(estimator, str):
            raise ConfigurationError(
                f"estimator = {shown(estimator)}; give kf, ekf or ukf, with settings"
            )
        settings_of(estimator)
    is_number = isinstance(belief, int | float) and not isinstance(belief, bool)
    if not (is_number and 0.0 < belief < 1.0):
        raise ConfigurationError(
            f"belief = {shown(belief)}; give a probability above 0 and below 1"
        )
    if observe not in OBSERVATIONS:
        raise ConfigurationError(f"observe = {shown(observe)}; {nearest(observe, OBSERVATIONS)}")
    if observe != "estimate" and estimator is None:
        raise ConfigurationError(
            f"observe = {shown(observe)} goes with an estimator; give one, like 'ekf', or leave it"
            " out"
        )


def describe_sensor(problem: Any, spec: Any) -> dict[str, Any]:
    """Return the sensor and the estimator of an evaluation as JSON-able data; {} without a sensor.

    Args:
        problem: a `SafetyProblem`.
        spec: an `EvaluationSpec`.
    """
    measured = problem.measurement
    if measured is None:
        return {}
    channels = [
        {**vars(channel), "expression": str(channel.expression)} for channel in measured.channels
    ]
    return {
        "measurement": {"channels": channels, "delay": measured.delay},
        "estimator": spec.estimator,
        **({} if spec.estimator is None else {"belief": spec.belief, "observe": spec.observe}),
    }
