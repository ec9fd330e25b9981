"""The kernel that projects the inputs of a decision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from safe_envs.wrappers.qp.kernels.interval import project_interval, work_of_interval
from safe_envs.wrappers.qp.kernels.many import project_many, work_of_many
from safe_envs.wrappers.qp.kernels.one_constraint import (
    project_one_constraint,
    work_of_one_constraint,
)
from safe_envs.wrappers.qp.kernels.plane import project_plane, work_of_plane
from safe_envs.wrappers.qp.kernels.second_order import project_second_order, work_of_second_order


def projection_for(k: int, m: int, *, uncertain: bool = False) -> tuple[Callable[..., Any], int]:
    """Return the kernel for k constraints on m inputs, and the scratch entries that it needs.

    Args:
        k: number of constraints.
        m: number of inputs.
        uncertain: whether the constraints on one input are uncertain.
    """
    if uncertain:
        return project_second_order, work_of_second_order(k, m)
    if k == 1:
        return project_one_constraint, work_of_one_constraint(k, m)
    if m == 1:
        return project_interval, work_of_interval(k, m)
    if m == 2:
        return project_plane, work_of_plane(k, m)
    return project_many, work_of_many(k, m)
