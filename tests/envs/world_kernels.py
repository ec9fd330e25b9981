"""Entry points that call each function of a world once."""

from __future__ import annotations

import numpy as np

from safe_envs.engine.draws import draw_start, store_row
from safe_envs.engine.slots import (
    State,
    advance,
    barriers_of,
    has_ended,
    is_finite,
    measure,
    observation_of,
    resting_input,
    reward_of,
    smallest_barrier,
)


def moved(x: State, u: State, noise: np.ndarray, out: np.ndarray, data: np.ndarray) -> None:
    """Write the state one control period later."""
    store_row(out, advance(x, u, noise, 1, data))


def looked_at(x: State, time: float, out: np.ndarray, data: np.ndarray) -> bool:
    """Write what is read off a state, and return whether it is finite."""
    values = measure(x, resting_input(data), time, data)
    seen, barriers = observation_of(values), barriers_of(values)
    store_row(out, seen)
    store_row(out[len(seen) :], barriers)
    rest = (smallest_barrier(barriers), reward_of(values), 1.0 if has_ended(values) else 0.0)
    store_row(out[len(seen) + len(barriers) :], rest)
    return is_finite(x, values)


def started(k0: int, episode: int, uniforms: np.ndarray, out: np.ndarray, data: np.ndarray) -> None:
    """Write a start state."""
    store_row(out, draw_start(k0, 0, episode, uniforms, data))
