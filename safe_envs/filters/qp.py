"""The quadratic program of a filter, as data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import sympy as sp

from safe_envs.dynamics.defined import may_lack_value
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.filters.conditions.base import AffineConstraint, Terms
from safe_envs.problem.clf import CLF


@dataclass(frozen=True)
class FilterQP:
    """Minimise over the input bounds, subject to constraints; see `SafetyFilter`.

    Attributes:
        model: system whose symbols the constraints hold. Parameters whose values come in at run
            time are signals of it.
        constraints: k constraints.
        low: m lower input bounds, where no others are given at run time.
        high: m upper input bounds, likewise.
        weights: m weights of the inputs.
        priorities: k weights of the squared slacks.
        dt: control period in s, 0 where no constraint needs it.
        clf: goal of the joint QP, if there is one.
        runtime: what the constraints may hold besides the states: the model's signals, and the time
            if it occurs.
        owners: number of the barrier that each constraint is of, not falling; () where each
            constraint is of a barrier of its own.
        partial: the constraints whose barrier may have no value at some state. There it is not
            safe: the input does not regard the constraint, which is violated by infinity.
    """

    model: ControlAffineSDE
    constraints: tuple[AffineConstraint, ...]
    low: Sequence[float]
    high: Sequence[float]
    weights: Sequence[float]
    priorities: Sequence[float]
    dt: float
    clf: CLF | None
    runtime: tuple[sp.Symbol, ...] = ()
    owners: tuple[int, ...] = ()
    partial: tuple[int, ...] = field(init=False)

    def __post_init__(self) -> None:
        partial = [
            i
            for i, c in enumerate(self.constraints)
            if any(may_lack_value(self.model.numeric(sp.sympify(h))) for h in c.functions)
        ]
        object.__setattr__(self, "partial", tuple(partial))
        # What is compiled into solvers does not change from outside.
        for name in ("low", "high", "weights", "priorities"):
            object.__setattr__(self, name, tuple(getattr(self, name)))

    @property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        """Symbols whose values a decision takes: the states, then what comes in at run time."""
        return (*self.model.states, *self.runtime)

    @property
    def plain(self) -> bool:
        """Whether the constraints at the proposed input are all there is.

        Then there is no demand of a reciprocal condition, no sampling margin of first order, no
        maximum, no goal, no uncertainty, and no barrier that may have no value.
        """
        return (
            not self.partial
            and self.clf is None
            and all(
                c.demand is None
                and c.change is None
                and not c.alternatives
                and c.uncertainty is None
                for c in self.constraints
            )
        )

    @property
    def owner_of_each(self) -> Sequence[int]:
        """Number of the barrier that each constraint is of."""
        return self.owners or range(len(self.constraints))

    @property
    def partial_barriers(self) -> tuple[int, ...]:
        """Numbers of the barriers that may have no value at some state."""
        return tuple(dict.fromkeys(self.owner_of_each[i] for i in self.partial))

    @property
    def members(self) -> list[list[int]]:
        """Numbers of the constraints of each barrier."""
        owners = self.owner_of_each
        return [[i for i, o in enumerate(owners) if o == owner] for owner in dict.fromkeys(owners)]

    @property
    def terms(self) -> list[Terms]:
        """Learned terms of the constraints, each once."""
        return list(
            {id(c.terms): c.terms for c in self.constraints if c.terms is not None}.values()
        )


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
