"""What a filter decides."""

from __future__ import annotations

from typing import Any, NamedTuple


class FilterDecision(NamedTuple):
    """What a filter decides, for m inputs and k barriers.

    A barrier that is a minimum has several constraints: of these, the one that is violated most
    counts.

    `SafetyFilter.filter` gives arrays, of one state or of a batch with leading axes `...`.
    `decide_floats` and `decide_arrays` give sequences of components in place of the last axes,
    floats or arrays (B,), and no values of the barriers.

    Attributes:
        action: executed input, shape (..., m), inside the input bounds.
        margin: of each constraint at the action, less what a sampling margin or a reciprocal
            condition demands, shape (..., k); outside the domain of such a condition, the rate of
            h, and of a certificate's condition the left side of its inequality.
        active: constraints that bind or cannot be met, shape (..., k).
        feasible: whether some input within its bounds meets every constraint, shape (...). Where
            it is False, the action is the least-violating one.
        slack: by how much the action violates each constraint where they cannot be met, 0
            elsewhere, shape (..., k).
        cause: index of the active constraint that lies furthest from the proposed input, shape
            (...), where one that no input changes is nearer than any; without an active one -1 in
            arrays, and without meaning in components.
        proposed: input that the constraints changed, shape (..., m): the given one, or with a goal
            the one that is best without constraints.
        barrier: value of each barrier, shape (..., k); None in components.
    """

    action: Any
    margin: Any
    active: Any
    feasible: Any
    slack: Any
    cause: Any
    proposed: Any
    barrier: Any = None


class UndefinedConstraintError(ArithmeticError):
    """A constraint or the goal has no finite value.

    Attributes:
        index: of the state in the batch.
        what: the constraint or the goal.
    """

    def __init__(self, index: int, what: str) -> None:
        super().__init__(index, what)
        self.index, self.what = index, what
