"""The joint QP of a control Lyapunov function without other constraints, as a kernel."""

from __future__ import annotations

from math import isfinite, nan

import numpy as np

from safe_envs.dynamics.noise import POLICY
from safe_envs.engine.draws import uniform_at
from safe_envs.engine.qp.kernels.one_constraint import (
    project_one_constraint,
    work_of_one_constraint,
)


def work_of_goal(m: int) -> int:
    """Return the length of the scratch array of `best_inputs_for_goal` for m inputs."""
    return 6 * (m + 1) + 4 + work_of_one_constraint(1, m + 1)


def best_inputs_for_goal(
    goal: tuple[float, ...], place: int, data: np.ndarray, work: np.ndarray
) -> None:
    """Minimise w |u|^2 + w (d / unit)^2 subject to growth + b u <= d and the input bounds.

    It is what `safe_envs.filters.solver.FilterQPSolver.best` does.

    Args:
        goal: growth, and the m entries of b.
        place: of m lower bounds, m upper bounds, w and the unit of d in the data.
        data: numbers of the program.
        work: scratch array, which receives the m inputs in front; NaN where the goal is not finite.
    """
    m = len(goal) - 1
    n = m + 1
    u, row, target = work[:n], work[n : 2 * n].reshape((1, n)), work[2 * n : 3 * n]
    low, high, w = work[3 * n : 4 * n], work[4 * n : 5 * n], work[5 * n : 6 * n]
    single_numbers, scratch = work[6 * n : 6 * n + 4], work[6 * n + 4 :]
    offset, priority = single_numbers[0:1], single_numbers[1:2]
    margin, active = single_numbers[2:3], single_numbers[3:4]
    weight, unit = data[place + 2 * m], data[place + 2 * m + 1]
    total, most = goal[0], 0.0
    for j in range(m):
        low[j], high[j], w[j] = data[place + j], data[place + m + j], weight
        row[0, j], target[j] = -goal[1 + j], 0.0
        total += goal[1 + j]
        most += max(goal[1 + j] * low[j], goal[1 + j] * high[j])
    most += goal[0]
    low[m], high[m], w[m] = 0.0, 2.0 * most / unit if most > 0.0 else 1.0, weight
    row[0, m], target[m], offset[0], priority[0] = unit, 0.0, -goal[0], 1.0
    project_one_constraint(row, offset, target, low, high, w, priority, u, margin, active, scratch)
    if not isfinite(total):
        for j in range(m):
            u[j] = nan


def action_of_input(u: float, low: float, high: float, center: float, half: float) -> float:
    """Return the action in [-1, 1] for an input, which is clipped to its bounds; NaN for NaN.

    Args:
        u: physical input.
        low: lower bound.
        high: upper bound.
        center: middle of the bounds.
        half: half of their distance.
    """
    clipped = low if u < low else high if u > high else u
    return (clipped - center) / half


def input_of_action(action: float, center: float, half: float) -> float:
    """Return the input that an env executes for an action; NaN for NaN.

    Args:
        action: what lies beyond [-1, 1] is clipped.
        center: middle of the input bounds.
        half: half of their distance.
    """
    if action > 1.0:
        return center + half
    if action < -1.0:
        return center - half
    return center + half * action


def random_action(place: int, k0: int, k1: int) -> float:
    """Return the action that a word of the policy's stream of an episode stands for.

    Args:
        place: of the word, from 0.
        k0: first word of the key of the episode.
        k1: second word.
    """
    return 2.0 * uniform_at(place, 0, POLICY, k0, k1) - 1.0


def clip_to_bound(value: float, bound: float) -> float:
    """Return a number, or the end of [-bound, bound] that it lies beyond; NaN for NaN.

    Args:
        value: the number.
        bound: not negative.
    """
    return -bound if value < -bound else bound if value > bound else value


def action_in_another_box(
    action: float, center: float, half: float, new_center: float, new_half: float
) -> float:
    """Return the action that stands for the same or the nearest input in other input bounds.

    Args:
        action: in the old bounds.
        center: of the old bounds.
        half: width of the old bounds, halved.
        new_center: of the new bounds.
        new_half: width of the new bounds, halved.
    """
    return clip_to_bound((center + half * action - new_center) / new_half, 1.0)
