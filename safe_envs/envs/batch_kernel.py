"""One control period of all envs of a batch in one compiled function."""

from __future__ import annotations

from math import inf, isfinite

import numpy as np

from safe_envs.dynamics.noise import NOISE
from safe_envs.engine.draws import draw_start, fill_normals
from safe_envs.engine.plain_natives import vector_view
from safe_envs.engine.slots import (
    Input,
    State,
    advance,
    barriers_of,
    decide,
    has_ended,
    has_left,
    input_at,
    is_finite,
    measure,
    observation_of,
    observation_within,
    resting_input,
    reward_of,
    scaled_input,
    smallest_barrier,
    state_at,
)

# What happened in a step.
DONE = 0
BAD_ACTION = 1
UNDEFINED_FILTER = 2
NO_START = 3
NOT_FINITE = 4

PERIODS = 8
"""Control periods of noise that are drawn at once. With a multiple of 4, whole blocks are."""

STEPS = 0
PERIOD = 1
COST = 0
H_MIN = 1
EPISODE_COST = 2
BARRIERS = 3
TERMINATED = 0
TRUNCATED = 1
ENDED = 2
VIOLATION = 3
INTERVENTION = 4
ACTIVE = 5
FEASIBLE = 6
INTERVENTIONS = 0
INFEASIBLE = 1
ACTIVE_BARRIER = 2


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


def step_batch(  # noqa: PLR0913
    actions: np.ndarray,
    scaled: bool,
    stepping: bool,
    filtered: bool,
    placed: bool,
    restarts: np.ndarray,
    limit: int,
    dt: float,
    channels: int,
    keys: np.ndarray,
    episodes: np.ndarray,
    chunks: np.ndarray,
    noise: np.ndarray,
    uniforms: np.ndarray,
    work: np.ndarray,
    data: np.ndarray,
    rest: np.ndarray,
    states_before: np.ndarray,
    counts_before: np.ndarray,
    tallies_before: np.ndarray,
    states: np.ndarray,
    counts: np.ndarray,
    tallies: np.ndarray,
    inputs: np.ndarray,
    choices: np.ndarray,
    flags: np.ndarray,
    observations: np.ndarray,
    rewards: np.ndarray,
    readings: np.ndarray,
) -> int:
    """Step the envs of a batch, begin an episode in some of them, and read all states.

    Nothing that is read here is written, but for scratch and the noise that is drawn ahead: where
    the result is `BAD_ACTION`, `UNDEFINED_FILTER` or `NO_START`, nothing has happened.

    Args:
        actions: m numbers of each env.
        scaled: whether the actions are physical inputs.
        stepping: whether the envs step that begin no episode; otherwise they are only read.
        filtered: whether `decide` chooses the input, and `inputs`, `choices` and `tallies` have
            entries for it.
        placed: whether the envs that begin an episode do so where `states_before` and
            `counts_before` have them, and not at a draw.
        restarts: the envs that begin an episode.
        limit: control periods until an episode is truncated.
        dt: control period in s.
        channels: standard normals of a control period.
        keys: the two words of each env's key.
        episodes: number of each env's episode since its seed.
        chunks: number of the chunk of noise of each env, -1 without one.
        noise: those chunks, one after the other.
        uniforms: scratch array, with an entry for each uniform of the start distribution.
        work: scratch array.
        data: numbers of the program.
        rest: what a filter reports at reset, in the order of `inputs` after the executed one.
        states_before: n states, smallest barrier and cost of the episode.
        counts_before: steps of the episode, and period of its noise.
        tallies_before: interventions and infeasible steps of the episode.
        states: receives the same after the step.
        counts: likewise.
        tallies: likewise.
        inputs: receives the executed input, and of the filter the proposed and the executed one,
            the largest slack and the slacks.
        choices: receives interventions, infeasible steps and the active barrier.
        flags: receives for each flag those of all envs.
        observations: receives the observations.
        rewards: receives the rewards.
        readings: receives cost, smallest barrier and cost of the episode, and the barriers.

    Returns:
        What happened, one of the constants of this module.
    """
    status = DONE
    width = PERIODS * channels
    if stepping and channels:
        draw_ahead(width, restarts, counts_before, keys, episodes, chunks, noise)
    for i in range(len(restarts)):
        u = resting_input(data)
        if restarts[i]:
            x = state_at(states_before, i)
            counts[i, STEPS] = counts_before[i, STEPS]
            counts[i, PERIOD] = counts_before[i, PERIOD]
            if not placed:
                x = draw_start(keys[i, 0], keys[i, 1], episodes[i], uniforms, data)
                counts[i, STEPS] = 0
                counts[i, PERIOD] = 0
            if not isfinite(x[0]):
                return NO_START
            chunks[i] = -1
            states[i, len(x)] = inf
            states[i, len(x) + 1] = 0.0
            if filtered:
                rest_filter(i, u, rest, inputs, tallies, choices, flags)
            if stepping:
                u, sound = given_input(i, actions, scaled, data)
                if not sound:
                    return BAD_ACTION
                store_from(inputs, i, 0, u)
        else:
            x = state_at(states_before, i)
            states[i, len(x)] = states_before[i, len(x)]
            states[i, len(x) + 1] = states_before[i, len(x) + 1]
            period = counts_before[i, PERIOD]
            counts[i, STEPS] = counts_before[i, STEPS] + stepping
            counts[i, PERIOD] = period + stepping
            if stepping:
                u, sound = given_input(i, actions, scaled, data)
                if not sound:
                    return BAD_ACTION
                if filtered:
                    u, sound = filter_input(
                        i, x, u, data, work, inputs, tallies_before, tallies, choices, flags
                    )
                    if not sound:
                        return UNDEFINED_FILTER
                store_from(inputs, i, 0, u)
                place = i * width + period % PERIODS * channels
                x = advance(x, u, noise, place, data)
        time = counts[i, STEPS] * dt
        counted = stepping or restarts[i]
        if not read_state(
            i, x, u, time, counted, data, states, flags, observations, rewards, readings
        ):
            status = NOT_FINITE
        if restarts[i]:
            rewards[i] = 0.0
        flags[TRUNCATED, i] = counts[i, STEPS] >= limit
        flags[ENDED, i] = flags[TERMINATED, i] or flags[TRUNCATED, i]
    return status


def draw_ahead(
    width: int,
    restarts: np.ndarray,
    counts: np.ndarray,
    keys: np.ndarray,
    episodes: np.ndarray,
    chunks: np.ndarray,
    noise: np.ndarray,
) -> None:
    """Draw a chunk of noise for each env that has none of its coming period.

    Args:
        width: numbers of a chunk.
        restarts: see `step_batch`, as for the other arguments.
        counts: before the step.
        keys: see `step_batch`.
        episodes: see `step_batch`.
        chunks: see `step_batch`.
        noise: see `step_batch`.
    """
    for i in range(len(restarts)):
        chunk = counts[i, PERIOD] // PERIODS
        if not restarts[i] and chunks[i] != chunk:
            chunks[i] = chunk
            ahead = vector_view(noise, i * width, width)
            fill_normals(ahead, chunk * width, episodes[i], NOISE, keys[i, 0], keys[i, 1])


def scaled_action(action: float, center: float, half_width: float) -> float:
    """Return the physical input of an action, clipped to [-1, 1].

    Args:
        action: of one input.
        center: midpoint of the input's bounds.
        half_width: distance from it to both bounds.
    """
    if action > 1.0:
        return center + half_width
    if action < -1.0:
        return center - half_width
    return center + half_width * action


def within(value: float, low: float, high: float) -> float:
    """Return a number, clipped to an interval; NaN stays.

    Args:
        value: the number.
        low: lower end.
        high: upper end.
    """
    if value < low:
        return low
    if value > high:
        return high
    return value
