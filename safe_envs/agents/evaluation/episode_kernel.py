"""Whole episodes in one compiled function."""

from __future__ import annotations

import numpy as np

from safe_envs.compiled.draws import NOISE, draw_start, episode_key, fill_normals, store_row
from safe_envs.compiled.slots import (
    act,
    advance,
    barriers_of,
    decide,
    has_ended,
    is_finite,
    measure,
    observation_of,
    resting_input,
    reward_of,
    smallest_barrier,
)


def play_episodes(  # noqa: PLR0913
    first: int,
    k0: int,
    k1: int,
    steps: int,
    channels: int,
    dt: float,
    numbers: np.ndarray,
    counts: np.ndarray,
    states: np.ndarray,
    inputs: np.ndarray,
    data: np.ndarray,
    noise: np.ndarray,
    uniforms: np.ndarray,
    work: np.ndarray,
) -> int:
    """Simulate consecutive episodes and return how many came to a regular end."""
    for row in range(len(numbers)):
        key = episode_key(first + row, k0, k1)
        x = draw_start(key, 0, 0, uniforms, data)
        values = measure(x, resting_input(data), 0.0, data)
        h = smallest_barrier(barriers_of(values))
        store_row(states[row, 0], x)
        store_row(states[row, 1], x)
        store_row(states[row, 3], x)
        h_min, depth, worst_slack, effort, returned = h, h, 0.0, 0.0, 0.0
        safe = h > 0.0
        counted, length, interventions, infeasible = 0, 0, 0, 0
        place = len(noise)
        for k in range(steps):
            if channels and place == len(noise):
                fill_normals(noise, k * channels, 0, NOISE, key, 0)
                place = 0
            proposed = act(observation_of(values), k, key, 0, data, work)
            action, wanted, active, feasible, slacks, _, sound = decide(x, proposed, data, work)
            slack = slacks[0]
            for each in slacks:
                slack = max(slack, each)
            if safe and slack > worst_slack:
                worst_slack = slack
                store_row(states[row, 2], x)
                store_row(inputs[row], action)
            x = advance(x, action, noise, place, data)
            place += channels
            values = measure(x, action, (k + 1) * dt, data)
            if not (sound and is_finite(x, values)):
                return row
            h = smallest_barrier(barriers_of(values))
            length += 1
            if safe:
                counted += 1
                if active and action != wanted:
                    interventions += 1
                if not feasible:
                    infeasible += 1
                for v in action:
                    effort += v * v
                if h > depth:
                    depth = h
                    store_row(states[row, 1], x)
            if h < h_min:
                h_min = h
                if h <= 0.0:
                    store_row(states[row, 3], x)
            safe = safe and h > 0.0
            returned += reward_of(values)
            if has_ended(values):
                break
        numbers[row, 0] = returned
        numbers[row, 1] = h_min
        numbers[row, 2] = effort / counted if counted else np.nan
        numbers[row, 3] = depth
        numbers[row, 4] = worst_slack
        counts[row, 0] = -1 if safe else counted
        counts[row, 1] = length
        counts[row, 2] = interventions
        counts[row, 3] = infeasible
    return len(numbers)
