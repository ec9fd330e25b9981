"""A condition that asks for a formula of the thesis as it is printed, errors included."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from safe_envs import Barrier, ControlAffineSDE
from safe_envs.wrappers import AffineConstraint, Condition


@dataclass(frozen=True)
class PrintedCondition(Condition):
    """The constraint of a formula, for a model and a barrier.

    Attributes:
        formula: makes the constraint.
    """

    formula: Callable[[ControlAffineSDE, Barrier], AffineConstraint]
    name = "printed"
    stochastic = True

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Return the constraint of the formula."""
        return self.formula(model, barrier)

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> PrintedCondition:
        """Raise TypeError: a formula is not made of rates."""
        raise TypeError(f"a printed formula is not made of the rates {gains}")
