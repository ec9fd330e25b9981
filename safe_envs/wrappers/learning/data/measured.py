"""Data of a system whose states are seen by a sensor."""

from __future__ import annotations

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem


def sensor_deviations(problem: SafetyProblem) -> np.ndarray:
    """Return the standard deviation with which each state is measured, (n,); 0 without a sensor.

    Args:
        problem: whose sensor is taken.

    Raises:
        ConfigurationError: The sensor does not measure each state by itself.
    """
    states = problem.plant.states
    if problem.measurement is None:
        return np.zeros(len(states))
    known = {c.expression: c for c in problem.measurement.channels}
    missing = [s.name for s in states if s not in known]
    if missing:
        raise ConfigurationError(
            f"the sensor of {problem.name} does not measure {', '.join(missing)} by itself, so that"
            " a log of it is none of states; measure each state, like"
            f" '{missing[0]}:noise=S', or estimate the states and learn from these"
        )
    return np.array([known[s].noise for s in states])


def measured(
    problem: SafetyProblem, x: np.ndarray, successors: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return states as the sensor of a problem sees them: each start once, and each successor.

    Bias is part of what is seen. Losses and delays are not: a log holds complete samples.

    Args:
        problem: whose sensor is taken.
        x: start states, shape (P, n).
        successors: shape (P, K, n).
        rng: of the noise.

    Returns:
        Both, with errors; the same arrays without a sensor.

    Raises:
        ConfigurationError: See `sensor_deviations`.
    """
    if problem.measurement is None:
        return x, successors
    size = sensor_deviations(problem)
    known = {c.expression: c for c in problem.measurement.channels}
    bias = np.array([known[s].bias for s in problem.plant.states])
    return tuple(  # pyright: ignore[reportReturnType]
        each + bias + size * rng.standard_normal(each.shape) for each in (x, successors)
    )
