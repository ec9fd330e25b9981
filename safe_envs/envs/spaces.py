"""Observation and action spaces of a problem, and actions in physical units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from safe_envs.arrays import real_array
from safe_envs.dynamics.codegen import Components, constants, finite
from safe_envs.errors import InvalidInputError
from safe_envs.problem.measurement import Channel
from safe_envs.problem.problem import SafetyProblem

_FAR = 1e6
"""Bound of what is measured, in its unit, where its range is not known."""

_DEVIATIONS = 10.0
"""Standard deviations of a sensor that observations leave room for."""

_LOWEST, _HIGHEST = constants((-1.0, 1.0))


def observation_box(problem: SafetyProblem) -> gym.spaces.Box:
    """Return the observation space of a problem: what is measured, or its features."""
    if problem.measurement is not None:
        ends = [channel_bounds(problem, c) for c in problem.measurement.channels]
    else:
        ends = [(f.low, f.high) for f in problem.features]
    low, high = np.array(ends, dtype=np.float32).T
    return gym.spaces.Box(low.copy(), high.copy(), dtype=np.float32)


def observation_names(problem: SafetyProblem) -> list[str]:
    """Return the names of the entries of an observation."""
    measured = problem.measurement
    return [each.name for each in (problem.features if measured is None else measured.channels)]


def channel_bounds(problem: SafetyProblem, channel: Channel) -> tuple[float, float]:
    """Return bounds of what a channel of the sensor measures.

    Those of a periodic channel are half a period; the others are the ends of what is measured as a
    state or a feature, or a large number, and its bias and ten standard deviations beyond.

    Args:
        problem: which is measured.
        channel: one of its sensor.
    """
    if channel.period:
        return -0.5 * channel.period, 0.5 * channel.period
    ranges = {f.expression: (f.low, f.high) for f in problem.features}
    for v in problem.states:
        ranges.setdefault(v.symbol, (v.low, v.high))
    low, high = ranges.get(channel.expression, (-_FAR, _FAR))
    if not (math.isfinite(low) and math.isfinite(high)):
        low, high = -_FAR, _FAR
    beyond = abs(channel.bias) + _DEVIATIONS * channel.noise
    return low - beyond, high + beyond


def action_box(problem: SafetyProblem) -> gym.spaces.Box:
    """Return the action space of a problem: [-1, 1] for each input, scaled to its bounds."""
    return gym.spaces.Box(-1.0, 1.0, (len(problem.inputs),), dtype=np.float32)


def center_and_half_width(problem: SafetyProblem) -> tuple[list[float], list[float]]:
    """Return c and w of each input: physical input = c + w * action, for an action in [-1, 1]."""
    center = [0.5 * (low + high) for low, high in problem.input_bounds]
    half = [0.5 * (high - low) for low, high in problem.input_bounds]
    return center, half


class BatchActions:
    """Actions of a batch, scaled to the physical inputs and back.

    Attributes:
        center: midpoints of the input bounds, as arrays without axes.

    Args:
        problem: whose inputs they are.
        num_envs: size of the batch.
    """

    def __init__(self, problem: SafetyProblem, num_envs: int) -> None:
        self._shape = (num_envs, len(problem.inputs))
        self.center, self._half = (constants(c) for c in center_and_half_width(problem))

    def checked(self, actions: Any) -> np.ndarray:
        """Return actions as doubles of shape (num_envs, m), in C order.

        Raises:
            InvalidInputError: The actions have another shape, or are not real numbers.
        """
        given = real_array("array of actions", actions)
        if given.shape != self._shape:
            raise InvalidInputError(
                f"actions have shape {given.shape}; the envs take {self._shape}"
            )
        return np.ascontiguousarray(given, dtype=np.float64)

    def physical(self, actions: Any) -> Components:
        """Scale actions in [-1, 1], clipped to them.

        Args:
            actions: shape (num_envs, m).

        Returns:
            The components of the physical inputs, m arrays of shape (num_envs,).

        Raises:
            InvalidInputError: The actions have another shape, or are not finite real numbers.
        """
        given = self.checked(actions)
        with np.errstate(over="ignore"):
            suspicious = not finite(given)
        if suspicious and not np.isfinite(given).all():
            bad = np.flatnonzero(~np.isfinite(given).all(axis=1))
            raise InvalidInputError(
                f"the actions of envs {bad[:5].tolist()} are not finite; give numbers in [-1, 1]"
            )
        clipped = np.minimum(np.maximum(given, _LOWEST), _HIGHEST)
        return tuple(
            [
                c + w * clipped[:, j] if c else w * clipped[:, j]
                for j, (c, w) in enumerate(zip(self.center, self._half, strict=True))
            ]
        )

    def normalized(self, physical: Sequence[Any]) -> np.ndarray:
        """Invert `physical`: return actions of shape (num_envs, m) in double precision."""
        actions = np.empty(self._shape)
        for j, (u, c, w) in enumerate(zip(physical, self.center, self._half, strict=True)):
            np.divide(u - c, w, out=actions[:, j])
        return actions
