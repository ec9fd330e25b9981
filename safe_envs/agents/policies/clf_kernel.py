"""The joint QP of a control Lyapunov function without other constraints, as a kernel."""

from __future__ import annotations

from math import isfinite, nan

import numpy as np

from safe_envs.wrappers.qp.kernels.one_constraint import (
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

    It is what `safe_envs.wrappers.filter_qp.solver.FilterQPSolver.best` does.

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
