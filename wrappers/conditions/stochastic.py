"""Conditions that know the noise: SCBF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from safe_envs.barrier import Barrier
from safe_envs.calculus import generator
from safe_envs.sde import ControlAffineSDE
from wrappers.conditions.base import AffineConstraint, Condition, linear_chain


@dataclass(frozen=True)
class SCBF(Condition):
    """A^r h >= 0, with the Ito generator A and the stochastic relative degree r.

    For r = 1 and c = sup h over C finite, P(safe for ever) >= h(x_0)/c as long as the condition can be met.

    Source: thesis Def. 4.2.6, Prop. 4.2.8, Thm. 4.2.10. The print defines the relative degree by A^j h = 0; what is
    meant is that L_g A^(j-1) h = 0 below r.
    """

    name = "scbf"

    def constraint(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint; see `linear_chain` for what it raises."""
        return linear_chain(model, barrier, None, generator)

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> SCBF:
        """The SCBF has no rates."""
        return cls()
