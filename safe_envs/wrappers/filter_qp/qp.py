"""The quadratic program of a filter, as data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import sympy as sp

from safe_envs.dynamics.defined import may_lack_value
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.clf import CLF
from safe_envs.wrappers.conditions.constraint import AffineConstraint, Terms


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
        maximum, no goal, no barrier that may have no value, and uncertainty only for one input.
        """
        return (
            not self.partial
            and self.clf is None
            and all(
                c.demand is None
                and c.change is None
                and not c.alternatives
                and (c.uncertainty is None or self.model.m == 1)
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
