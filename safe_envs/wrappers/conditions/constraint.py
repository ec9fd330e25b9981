"""The affine constraint on the input that a condition derives from a system and a barrier."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import sympy as sp

from safe_envs.dynamics.codegen import Components
from safe_envs.dynamics.lie import lie_derivative_g, tidied
from safe_envs.dynamics.sde import ControlAffineSDE


class Terms(Protocol):
    """Numbers that a row takes from something learned: they stand in its expressions as symbols of
    their own."""

    @property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        """What stands for them."""
        ...

    def floats(self, x: Sequence[float]) -> Sequence[float]:
        """The values at one state, given by components."""
        ...

    def arrays(self, x: Components) -> Components:
        """The values at a batch of states, components of shape (B,) in and out."""
        ...


@dataclass(frozen=True)
class AffineConstraint:
    """The row a(x) u + b(x) >= 0 that a condition asks for.

    Attributes:
        coefficient: a, an expression for each input.
        offset: b.
        chain: b_0 = h, ..., b_(r-1); the condition keeps the intersection of {b_j >= 0}, not C
            itself.
        demand: of a reciprocal condition, which asks for a u + b >= demand where h > 0 and has no
            meaning elsewhere. There a u + b is the rate of h, and all that is left is to make that
            as large as the other rows allow.
        change: rate of the row while the input is held, an expression of states and inputs, where a
            margin of first order is asked for.
        uncertainty: where a and b are known up to an error only, the entries (i, j), i <= j, of the
            symmetric Q(x) with which the condition asks for a u + b >= sqrt([1, u]' Q [1, u]).
        terms: what stands for numbers of something learned in the expressions, besides the states.
    """

    coefficient: tuple[sp.Expr, ...]
    offset: sp.Expr
    chain: tuple[sp.Expr, ...]
    demand: sp.Expr | None = None
    change: sp.Expr | None = None
    uncertainty: tuple[sp.Expr, ...] | None = None
    terms: Terms | None = None

    @classmethod
    def after(
        cls,
        model: ControlAffineSDE,
        chain: Sequence[sp.Expr],
        offset: sp.Expr,
        demand: sp.Expr | None = None,
    ) -> AffineConstraint:
        """The constraint L_g b_(r-1) u + offset >= 0, or >= demand, at the end of a chain."""
        a = lie_derivative_g(model, chain[-1])
        return cls(
            tuple(tidied(a[0, j]) for j in range(model.m)), tidied(offset), tuple(chain), demand
        )
