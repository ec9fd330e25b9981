"""Functions that are generated for each program: declarations, which kernels import.

`x`, `u` and `observation` are tuples of floats, `data` the numbers of the program (see
`safe_envs.engine.slots`), `work` a scratch array, and `values` what `measure` returns.

Problems that differ in their numbers alone share one compiled program.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

State = tuple[float, ...]
Input = tuple[float, ...]


def start_state(uniforms: np.ndarray, data: np.ndarray) -> State:
    """Return the start state that uniforms stand for.

    Args:
        uniforms: in [0, 1), one for each of the distribution's.
        data: numbers of the program.
    """
    raise NotImplementedError


def start_margin(x: State, data: np.ndarray) -> float:
    """Return a number that is positive where a start state is allowed.

    Args:
        x: the start state.
        data: numbers of the program.
    """
    raise NotImplementedError


def no_state(data: np.ndarray) -> State:
    """Return a state of NaN."""
    raise NotImplementedError


def advance(x: State, u: Input, noise: np.ndarray, first: int, data: np.ndarray) -> State:
    """Return the state one control period later.

    Args:
        x: n components of the state.
        u: m components of the physical input.
        noise: standard normals.
        first: index of the first one of the period.
        data: numbers of the program.
    """
    raise NotImplementedError


def measure(x: State, u: Input, time: float, data: np.ndarray) -> tuple[float, ...]:
    """Return the features, the barriers, the reward, and how far the workspace and goal are off.

    Args:
        x: n components of the state.
        u: m components of the input that led to it.
        time: since the start of the episode, in s.
        data: numbers of the program.
    """
    raise NotImplementedError


def observation_of(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return the features, rounded to single precision."""
    raise NotImplementedError


def barriers_of(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return the barriers, -inf where one has no value."""
    raise NotImplementedError


def smallest_barrier(barriers: tuple[float, ...]) -> float:
    """Return the smallest of the barriers."""
    raise NotImplementedError


def lowest_between(
    x: State,
    before: tuple[float, ...],
    after: tuple[float, ...],
    uniforms: np.ndarray,
    first: int,
    data: np.ndarray,
) -> float:
    """Return the smallest h that counts in a control period.

    Args:
        x: state at its beginning.
        before: barriers there.
        after: barriers at its end.
        uniforms: numbers in [0, 1); from `first` on there is one for each barrier, if any is used.
        first: where those of this period begin.
        data: numbers of the program.
    """
    raise NotImplementedError


def no_barriers(data: np.ndarray) -> tuple[float, ...]:
    """Return barriers of NaN."""
    raise NotImplementedError


def reward_of(values: tuple[float, ...]) -> float:
    """Return the reward."""
    raise NotImplementedError


def has_ended(values: tuple[float, ...]) -> bool:
    """Return whether the workspace was left or the goal reached."""
    raise NotImplementedError


def is_finite(x: State, values: tuple[float, ...]) -> bool:
    """Return whether a state and what an env reads off it are finite; not so for huge numbers.

    Args:
        x: n components of the state.
        values: what `measure` returns.
    """
    raise NotImplementedError


def resting_input(data: np.ndarray) -> Input:
    """Return the middle of the input bounds, which stands for the input before the first step."""
    raise NotImplementedError


def act(
    observation: tuple[float, ...], step: int, k0: int, k1: int, data: np.ndarray, work: np.ndarray
) -> Input:
    """Return the physical input that a policy proposes in period `step` of an episode.

    It lies within the input bounds; an entry is NaN where the policy has no finite value.

    Args:
        observation: features in single precision.
        step: number of the control period, from 0.
        k0: first word of the key of the episode.
        k1: second word.
        data: numbers of the program.
        work: scratch array.
    """
    raise NotImplementedError


def decide(x: State, u: Input, data: np.ndarray, work: np.ndarray) -> tuple[Any, ...]:
    """Return what the filter decides on a proposed input.

    These are the action (a tuple), the proposed input (a tuple: the given one, or that of the goal
    of a joint QP), whether a constraint is active, whether all can be met, the slacks of the
    constraints (a tuple), the number of the constraint that caused an intervention (without meaning
    where none is active), and whether all numbers of the QP are finite; see `FilterDecision`.
    """
    raise NotImplementedError


def has_left(values: tuple[float, ...]) -> bool:
    """Return whether the workspace was left."""
    raise NotImplementedError


def observation_within(observation: tuple[float, ...], data: np.ndarray) -> tuple[float, ...]:
    """Return an observation, clipped to the bounds of its space.

    Args:
        observation: features in single precision.
        data: numbers of the program.
    """
    raise NotImplementedError


def state_at(table: np.ndarray, i: int) -> State:
    """Return the state of an env, which the first columns of a table hold.

    Args:
        table: shape (num_envs, n or more).
        i: index of the env.
    """
    raise NotImplementedError


def input_at(table: np.ndarray, i: int) -> Input:
    """Return the input of an env, which the first columns of a table hold.

    Args:
        table: shape (num_envs, m or more).
        i: index of the env.
    """
    raise NotImplementedError


def scaled_input(action: Input, data: np.ndarray) -> Input:
    """Return the physical input of an action in [-1, 1], which is clipped to it.

    Args:
        action: m components.
        data: numbers of the program.
    """
    raise NotImplementedError


class Data:
    """Numbers that a program reads at fixed places of one array."""

    def __init__(self) -> None:
        self._values: list[float] = []

    def add(self, values: Iterable[float]) -> int:
        """Append numbers and return the place of the first one."""
        first = len(self._values)
        self._values.extend(float(value) for value in values)
        return first

    def array(self) -> np.ndarray:
        """Return all numbers, float64."""
        return np.array(self._values, dtype=np.float64)
