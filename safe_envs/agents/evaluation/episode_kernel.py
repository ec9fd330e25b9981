"""Whole episodes as kernels: what `rollout` and `EpisodeBatch` count, one episode after the other.

Rows of the arrays stand for episodes. `numbers` holds the return, the minimum h and the mean |u|^2,
the largest h and the largest slack; `counts` the first violation, the length, the interventions and
the infeasible periods; `states` the start, where h was largest, where the slack was, and where h
was smallest; `inputs` what was executed where the slack was largest.
"""

from __future__ import annotations

from math import inf, isfinite, nan, sqrt
from typing import Any

import numpy as np

from safe_envs.dynamics.noise import BRIDGE, NOISE
from safe_envs.dynamics.normal_kernel import standard_exponential
from safe_envs.engine.draws import draw_start, episode_key, fill_normal_run, fill_uniforms
from safe_envs.engine.slots import (
    Input,
    State,
    act,
    advance,
    barriers_of,
    decide,
    has_ended,
    is_finite,
    lowest_between,
    measure,
    no_barriers,
    observation_of,
    resting_input,
    reward_of,
    smallest_barrier,
)

FIRST_STATE = 0
DEEPEST_STATE = 1
VIOLATING_STATE = 2
LOWEST_STATE = 3


def play_episodes(  # noqa: PLR0913
    first: int,
    k0: int,
    k1: int,
    sizes: tuple[int, int, int, int],
    dt: float,
    numbers: np.ndarray,
    counts: np.ndarray,
    states: np.ndarray,
    inputs: np.ndarray,
    data: np.ndarray,
    noise: np.ndarray,
    bridge: np.ndarray,
    uniforms: np.ndarray,
    work: np.ndarray,
) -> int:
    """Simulate consecutive episodes, up to one that does not come to an end.

    That is one in which something has no finite value, or no start is allowed.

    Args:
        first: number of the first episode.
        k0: first word of the key of the evaluation.
        k1: second word.
        sizes: control periods of an episode, periods that are drawn ahead (a multiple of 4), and
            standard normals and uniforms of the bridges for each.
        dt: control period in s.
        numbers: see the module, shape (E, 5).
        counts: shape (E, 4).
        states: shape (E, 4, n).
        inputs: shape (E, m).
        data: numbers of the program.
        noise: scratch array for the normals that are drawn ahead, with three entries for each.
        bridge: the same for the uniforms of the bridges.
        uniforms: scratch array for those of a start.
        work: scratch array.

    Returns:
        The number of episodes that came to an end.
    """
    for row in range(len(numbers)):
        key = episode_key(first + row, k0, k1)
        if not play_episode(
            row,
            key,
            sizes,
            dt,
            numbers,
            counts,
            states,
            inputs,
            data,
            noise,
            bridge,
            uniforms,
            work,
        ):
            return row
    return len(numbers)


def play_episode(  # noqa: PLR0913
    row: int,
    key: int,
    sizes: tuple[int, int, int, int],
    dt: float,
    numbers: np.ndarray,
    counts: np.ndarray,
    states: np.ndarray,
    inputs: np.ndarray,
    data: np.ndarray,
    noise: np.ndarray,
    bridge: np.ndarray,
    uniforms: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Simulate an episode from its key, and return whether it came to an end.

    Args:
        row: of the arrays.
        key: first word of the key of the episode.
        sizes: see `play_episodes`, as for the other arguments.
        dt: control period in s.
        numbers: receives results.
        counts: receives results.
        states: receives results.
        inputs: receives results.
        data: numbers of the program.
        noise: scratch array.
        bridge: scratch array.
        uniforms: scratch array.
        work: scratch array.
    """
    steps, ahead, channels, draws = sizes
    x = draw_start(key, 0, 0, uniforms, data)
    action = resting_input(data)
    before, barriers = x, no_barriers(data)
    h_min, depth, worst, effort, returned = inf, -inf, 0.0, 0.0, 0.0
    counted, interventions, infeasible, length = 0, 0, 0, 0
    safe = True
    # What is read off a state and decided on it is in one round: compiled code then computes the
    # sines and cosines of a state once.
    for k in range(steps + 1):
        values = measure(x, action, k * dt, data)
        if not is_finite(x, values):
            return False
        after = barriers_of(values)
        if k == 0:
            h = smallest_barrier(after)
            store_state(states, row, FIRST_STATE, x)
        else:
            h = lowest_between(before, barriers, after, bridge, (k - 1) % ahead * draws, data)
            returned += reward_of(values)
        if safe and h > depth:
            depth = h
            store_state(states, row, DEEPEST_STATE, x)
        if h < h_min:
            h_min = h
            if h <= 0.0:
                store_state(states, row, LOWEST_STATE, x)
        safe = safe and h > 0.0
        length = k
        if (k > 0 and has_ended(values)) or k == steps:
            break
        drawn = k % ahead
        if drawn == 0:
            fill_normal_run(noise, k * channels, 0, NOISE, key, 0)
            fill_uniforms(bridge, k * draws, 0, BRIDGE, key, 0)
        proposed = act(observation_of(values), k, key, 0, data, work)
        action, wanted, active, feasible, slacks, _, sound = decide(x, proposed, data, work)
        if not (sound and is_finite_input(proposed)):
            return False
        if safe:
            # The conditions mean nothing after a violation.
            counted += 1
            interventions += 1 if active and action != wanted else 0
            infeasible += 0 if feasible else 1
            effort += square_of_input(action)
            slack = largest_slack(slacks)
            if slack > worst:
                worst = slack
                store_state(states, row, VIOLATING_STATE, x)
                store_entries(inputs, row, action)
        before, barriers = x, after
        x = advance(x, action, noise, drawn * channels, data)
    mean = effort / counted if counted else nan
    store_entries(numbers, row, (returned, h_min, mean, depth, worst))
    store_entries(counts, row, (-1 if safe else counted, length, interventions, infeasible))
    return True


def store_entries(table: np.ndarray, row: int, values: tuple[Any, ...]) -> None:
    """Write values to a row of a table.

    Args:
        table: receives them, shape (E, k).
        row: of the table.
        values: k numbers.
    """
    for j in range(len(values)):
        table[row, j] = values[j]


def store_state(states: np.ndarray, row: int, place: int, x: State) -> None:
    """Write a state to a place of an episode.

    Args:
        states: receives it, shape (E, 4, n).
        row: of the episode.
        place: `FIRST_STATE` or another one.
        x: the state.
    """
    for j in range(len(x)):
        states[row, place, j] = x[j]


def square_of_input(u: Input) -> float:
    """Return |u|^2."""
    total = u[0] * u[0]
    for j in range(1, len(u)):
        total += u[j] * u[j]
    return total


def is_finite_input(u: Input) -> bool:
    """Return whether the entries of an input, which lie within their bounds, are numbers."""
    total = 0.0
    for v in u:
        total += v
    return isfinite(total)


def largest_slack(slacks: tuple[float, ...]) -> float:
    """Return the largest slack."""
    slack = slacks[0]
    for each in slacks:
        slack = max(slack, each)
    return slack


def bridge_minimum(before: float, after: float, rate: float, uniform: float) -> float:
    """Return the smallest value of a barrier during a control period; see `BrownianBridge`.

    Args:
        before: its value at the beginning.
        after: its value at the end.
        rate: 2 s^2 dt.
        uniform: number in [0, 1).
    """
    end = min(before, after)
    rise = after - before
    reach = sqrt(rise * rise + rate * standard_exponential(uniform))
    low = 0.5 * (before + after - reach)
    # Rounding must not lift the minimum above an end.
    return low if low < end else end
