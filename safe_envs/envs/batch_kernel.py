"""One control period of all envs of a batch in one compiled function."""

from __future__ import annotations

from math import inf, isfinite

import numpy as np

from safe_envs.compiled.draws import draw_start, fill_normals
from safe_envs.compiled.plain_natives import vector_view
from safe_envs.compiled.slots import (
    advance,
    resting_input,
    state_at,
)
from safe_envs.dynamics.philox import NOISE
from safe_envs.envs.batch_layout import (
    BAD_ACTION,
    DONE,
    ENDED,
    NO_START,
    NOT_FINITE,
    PERIOD,
    PERIODS,
    STEPS,
    TERMINATED,
    TRUNCATED,
    UNDEFINED_FILTER,
)
from safe_envs.envs.batch_part_kernels import (
    filter_input,
    given_input,
    read_state,
    rest_filter,
    store_from,
)


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
