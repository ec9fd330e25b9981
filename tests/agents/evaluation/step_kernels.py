"""An entry point that takes a filtered step from each of many states."""

from __future__ import annotations

import numpy as np

from safe_envs.engine.slots import (
    Input,
    State,
    advance,
    barriers_of,
    decide,
    has_ended,
    measure,
    smallest_barrier,
)


def state_at(table: np.ndarray, row: int) -> State:
    """Return a row of a table; generated for a number of states."""
    raise NotImplementedError


def input_at(table: np.ndarray, row: int) -> Input:
    """Return a row of a table; generated for a number of inputs."""
    raise NotImplementedError


def take_steps(
    states: np.ndarray,
    inputs: np.ndarray,
    noise: np.ndarray,
    moved: np.ndarray,
    actions: np.ndarray,
    flags: np.ndarray,
    data: np.ndarray,
    work: np.ndarray,
) -> None:
    """Write the states that steps lead to, what was executed, and flags: see `FLAGS`."""
    channels = len(noise) // len(states)
    for row in range(len(states)):
        x, u = state_at(states, row), input_at(inputs, row)
        action, wanted, active, feasible, _, _, sound = decide(x, u, data, work)
        y = advance(x, action, noise, row * channels, data)
        values = measure(y, action, 0.0, data)
        for i in range(len(y)):
            moved[row, i] = y[i]
        for j in range(len(action)):
            actions[row, j] = action[j]
        flags[row, 0] = active
        flags[row, 1] = active and action != wanted
        flags[row, 2] = feasible
        flags[row, 3] = smallest_barrier(barriers_of(values)) <= 0.0
        flags[row, 4] = has_ended(values)
        flags[row, 5] = sound
