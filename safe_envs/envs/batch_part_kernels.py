"""What a compiled batch does with each of its envs: parts of `batch_kernel.step_batch`."""

from __future__ import annotations

from math import isfinite

import numpy as np

from safe_envs.compiled.slots import (
    Input,
    State,
    barriers_of,
    decide,
    has_ended,
    has_left,
    input_at,
    is_finite,
    measure,
    observation_of,
    observation_within,
    reward_of,
    scaled_input,
    smallest_barrier,
)
from safe_envs.envs.batch_layout import (
    ACTIVE,
    ACTIVE_BARRIER,
    BARRIERS,
    COST,
    EPISODE_COST,
    FEASIBLE,
    H_MIN,
    INFEASIBLE,
    INTERVENTION,
    INTERVENTIONS,
    TERMINATED,
    VIOLATION,
)


def given_input(i: int, actions: np.ndarray, scaled: bool, data: np.ndarray) -> tuple[Input, bool]:
    """Return the physical input that an env is given.

    Args:
        i: index of the env.
        actions: see `batch_kernel.step_batch`.
        scaled: whether they are physical inputs.
        data: numbers of the program.

    Returns:
        The input, and whether the action is finite.
    """
    u = input_at(actions, i)
    if scaled:
        return u, True
    for a in u:
        if not isfinite(a):
            return u, False
    return scaled_input(u, data), True


def filter_input(  # noqa: PLR0913
    i: int,
    x: State,
    u: Input,
    data: np.ndarray,
    work: np.ndarray,
    inputs: np.ndarray,
    tallies_before: np.ndarray,
    tallies: np.ndarray,
    choices: np.ndarray,
    flags: np.ndarray,
) -> tuple[Input, bool]:
    """Decide on the proposed input of an env, report and count it.

    Args:
        i: index of the env.
        x: its state.
        u: proposed input.
        data: numbers of the program.
        work: scratch array.
        inputs: see `batch_kernel.step_batch`, as for the others.
        tallies_before: see there.
        tallies: see there.
        choices: see there.
        flags: see there.

    Returns:
        The input to execute, and whether the constraints have finite values.
    """
    action, proposed, active, feasible, slacks, cause, sound = decide(x, u, data, work)
    slack = slacks[0]
    for each in slacks:
        slack = max(slack, each)
    m = len(u)
    store_from(inputs, i, m, proposed)
    store_from(inputs, i, 2 * m, action)
    inputs[i, 3 * m] = slack
    store_from(inputs, i, 3 * m + 1, slacks)
    intervened = active and action != proposed
    tallies[i, INTERVENTIONS] = tallies_before[i, INTERVENTIONS] + intervened
    tallies[i, INFEASIBLE] = tallies_before[i, INFEASIBLE] + (not feasible)
    choices[i, INTERVENTIONS] = tallies[i, INTERVENTIONS]
    choices[i, INFEASIBLE] = tallies[i, INFEASIBLE]
    choices[i, ACTIVE_BARRIER] = cause if intervened else -1
    flags[INTERVENTION, i] = intervened
    flags[ACTIVE, i] = active
    flags[FEASIBLE, i] = feasible
    return action, sound


def rest_filter(
    i: int,
    u: Input,
    rest: np.ndarray,
    inputs: np.ndarray,
    tallies: np.ndarray,
    choices: np.ndarray,
    flags: np.ndarray,
) -> None:
    """Report of an env what a filter reports at reset.

    Args:
        i: index of the env.
        u: any input.
        rest: see `batch_kernel.step_batch`, as for the others.
        inputs: see there.
        tallies: see there.
        choices: see there.
        flags: see there.
    """
    for j in range(len(rest)):
        inputs[i, len(u) + j] = rest[j]
    tallies[i, INTERVENTIONS] = 0
    tallies[i, INFEASIBLE] = 0
    choices[i, INTERVENTIONS] = 0
    choices[i, INFEASIBLE] = 0
    choices[i, ACTIVE_BARRIER] = -1
    flags[INTERVENTION, i] = False
    flags[ACTIVE, i] = False
    flags[FEASIBLE, i] = True


def read_state(  # noqa: PLR0913
    i: int,
    x: State,
    u: Input,
    time: float,
    counted: bool,
    data: np.ndarray,
    states: np.ndarray,
    flags: np.ndarray,
    observations: np.ndarray,
    rewards: np.ndarray,
    readings: np.ndarray,
) -> bool:
    """Store the state of an env and what is read off it.

    Args:
        i: index of the env.
        x: its state; its counters are in `states`.
        u: input that led to it.
        time: since the start of the episode, in s.
        counted: whether the state is new.
        data: numbers of the program.
        states: see `batch_kernel.step_batch`, as for the others.
        flags: see there.
        observations: see there.
        rewards: see there.
        readings: see there.

    Returns:
        Whether all is finite.
    """
    values = measure(x, u, time, data)
    barriers = barriers_of(values)
    h = smallest_barrier(barriers)
    cost = 1.0 if h < 0.0 else 0.0
    n = len(x)
    store_from(states, i, 0, x)
    h_min = states[i, n]
    if not h >= h_min:
        h_min = h
    episode_cost = states[i, n + 1]
    if counted:
        episode_cost += cost
    states[i, n] = h_min
    states[i, n + 1] = episode_cost
    readings[i, COST] = cost
    readings[i, H_MIN] = h_min
    readings[i, EPISODE_COST] = episode_cost
    store_from(readings, i, BARRIERS, barriers)
    flags[VIOLATION, i] = h < 0.0
    flags[TERMINATED, i] = has_ended(values)
    if has_left(values):
        store_from(observations, i, 0, observation_within(observation_of(values), data))
    else:
        store_from(observations, i, 0, observation_of(values))
    rewards[i] = reward_of(values)
    return is_finite(x, values)


def store_from(table: np.ndarray, i: int, first: int, values: tuple[float, ...]) -> None:
    """Write a tuple to the entries of an env.

    Args:
        table: to write to, shape (num_envs, columns).
        i: index of the env.
        first: column of the first entry.
        values: the entries.
    """
    for j in range(len(values)):
        table[i, first + j] = values[j]
