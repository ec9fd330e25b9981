"""Conditions with the Ito generator A in place of the Lie derivative: SCBF, SZCBF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from safe_envs.dynamics.lie import generator
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.filters.conditions.base import AffineConstraint, Condition, chain_of
from safe_envs.filters.conditions.class_k import positive_rates
from safe_envs.problem.problem import Barrier


@dataclass(frozen=True)
class SCBF(Condition):
    """A^r h >= 0, with the Ito generator A and the stochastic relative degree r.

    Its bounds: `safe_envs.proofs.guarantees`.

    Source: thesis Def. 4.2.6, Prop. 4.2.8, Thm. 4.2.10. The thesis defines the relative degree by
        A^j h = 0; it means that L_g A^(j-1) h = 0 below r.
    """

    name = "scbf"
    stochastic = True

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint; see `chain_of` for what it raises."""
        return AffineConstraint.after(model, *chain_of(model, barrier, None, generator))

    def chain_rates(self, degree: int) -> tuple[float, ...]:
        """Return zeros; see `Condition.chain_rates`."""
        return (0.0,) * degree


@dataclass(frozen=True)
class SZCBF(Condition):
    """h_0 = h, h_j = A h_(j-1) + alpha_j h_(j-1), and h_r(x, u) >= 0, with the Ito generator A.

    Its bounds: `safe_envs.proofs.guarantees`.

    Attributes:
        alphas: rates alpha_1..alpha_r in 1/s, as many as the relative degree.

    Source: thesis Def. 4.2.4, Prop. 4.2.5 and, for higher degrees, Sec. 4.3.2, whose
        h_2 = A h_1 + alpha_2 h lets even noise-free trajectories leave the set.
    """

    alphas: tuple[float, ...] = (1.0,)
    name = "szcbf"
    stochastic = True

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "alphas", positive_rates("alphas", self.alphas))

    def derived(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint; see `chain_of` for what it raises."""
        return AffineConstraint.after(model, *chain_of(model, barrier, self.alphas, generator))

    @classmethod
    def for_gains(cls, gains: Sequence[float]) -> SZCBF:
        """Return the SZCBF with all rates."""
        return cls(tuple(gains))

    def chain_rates(self, degree: int) -> tuple[float, ...]:
        """Return the rates; see `Condition.chain_rates`."""
        return self.alphas
