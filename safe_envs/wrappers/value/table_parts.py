"""What a look-ahead reads, for those who write it as code."""

from __future__ import annotations

from typing import NamedTuple

from safe_envs.wrappers.value.expected_bounds import ExpectedBounds
from safe_envs.wrappers.value.reduction import ReducedProblem
from safe_envs.wrappers.value.step_images import Step
from safe_envs.wrappers.value.table import ValueTable


class TableParts(NamedTuple):
    """What a look-ahead reads, for those who write it as code.

    Attributes:
        table: the table.
        reduced: the problem in few coordinates.
        step: a step of it.
        bounds: of the expected next value.
        leaving: see `ValueSettings`.
    """

    table: ValueTable
    reduced: ReducedProblem
    step: Step
    bounds: ExpectedBounds
    leaving: str
