"""The affine constraint on the input that a condition derives from a system and a barrier."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import sympy as sp

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source
from safe_envs.compiled.own_source import has_own_source
from safe_envs.dynamics.codegen import Components
from safe_envs.dynamics.lie import lie_derivative_g, tidied
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import NotCompilableError, SystemDefinitionError
from safe_envs.problem.barrier import Barrier


class Terms(Protocol):
    """Numbers of a learned model in a constraint, whose expressions hold symbols for them."""

    @property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        """Symbols of the numbers."""
        ...

    def floats(self, x: Sequence[float]) -> Sequence[float]:
        """Return the values at one state, given by components."""
        ...

    def arrays(self, x: Components) -> Components:
        """Return the values at a batch of states, components of shape (B,) in and out."""
        ...

    def source(self, name: str, data: Data) -> Source:
        """Return a function `name(x, data, work)` of the state, a tuple, that gives the values.

        Args:
            name: of the function, with which the names of other generated functions begin.
            data: receives its numbers.
        """
        ...


def terms_source(terms: Terms, name: str, data: Data) -> Source:
    """Return learned numbers as a function of a compiled program; see `Terms.source`.

    Args:
        terms: whose values it gives. They need no method `source`, as far as this is not called.
        name: of the function.
        data: receives its numbers.

    Raises:
        NotCompilableError: They have no method of their own for that.
    """
    if not has_own_source(terms, "floats", "arrays"):
        raise NotCompilableError(
            f"the learned terms {type(terms).__name__} have no compiled form, which their method"
            " source(name, data) would give"
        )
    return terms.source(name, data)


@dataclass(frozen=True)
class AffineConstraint:
    """The constraint a(x) u + b(x) >= 0 that a condition asks for.

    Attributes:
        coefficient: a, an expression for each input.
        offset: b.
        chain: b_0 = h, ..., b_(r-1); the condition keeps the intersection of {b_j >= 0}, not C
            itself.
        demand: of a reciprocal condition, which asks for a u + b >= demand where h > 0 and has no
            meaning elsewhere. There a u + b is the rate of h, and all that is left is to make that
            as large as the other constraints allow.
        domain: expressions that are all positive where the demand has a meaning, of a certificate's
            constraint for example; h, by more than its rounding, where none are given.
        change: rate of the constraint while the input is held, an expression of states and inputs,
            where a margin of first order is asked for.
        uncertainty: where a and b are known up to an error only, the entries (i, j), i <= j, of the
            symmetric Q(x) with which the condition asks for a u + b >= sqrt([1, u]' Q [1, u]).
        terms: learned numbers in the expressions, whose symbols are no states.
        alternatives: constraints of the functions of a barrier that is their maximum, of which one
            is enough; what else is stated is that of the first.
    """

    coefficient: tuple[sp.Expr, ...]
    offset: sp.Expr
    chain: tuple[sp.Expr, ...]
    demand: sp.Expr | None = None
    change: sp.Expr | None = None
    uncertainty: tuple[sp.Expr, ...] | None = None
    terms: Terms | None = None
    domain: tuple[sp.Expr, ...] = ()
    alternatives: tuple[AffineConstraint, ...] = ()

    @property
    def functions(self) -> tuple[sp.Expr, ...]:
        """The barrier, or the functions that it is the maximum of; () where none is stated."""
        return tuple(c.chain[0] for c in self.alternatives or (self,) if c.chain)

    @classmethod
    def after(
        cls,
        model: ControlAffineSDE,
        chain: Sequence[sp.Expr],
        offset: sp.Expr,
        demand: sp.Expr | None = None,
    ) -> AffineConstraint:
        """Return the constraint L_g b_(r-1) u + offset >= 0, or >= demand, at the end of a chain.

        Args:
            model: system that the chain was derived for.
            chain: b_0, ..., b_(r-1).
            offset: part of b_r without the input.
            demand: see the class.
        """
        # What sympy adds at kinks has no weight: see `safe_envs.wrappers.conditions.chain`.
        a: Any = lie_derivative_g(model, chain[-1]).replace(sp.DiracDelta, lambda *_: sp.Integer(0))
        return cls(
            tuple(tidied(a[0, j]) for j in range(model.m)), tidied(offset), tuple(chain), demand
        )


def either_of(
    name: str, barrier: Barrier, found: Sequence[AffineConstraint], noisy: bool
) -> AffineConstraint:
    """Return the constraint of a barrier that is a maximum.

    Args:
        name: of the condition.
        barrier: h.
        found: constraints of the functions that it is the maximum of.
        noisy: whether the condition takes noise into account.

    Raises:
        SystemDefinitionError: The constraint of one function is not enough.
    """
    special = [p for c in found for p in (c.demand, c.change, c.uncertainty, c.terms)]
    if noisy or any(part is not None for part in special):
        raise SystemDefinitionError(
            f"barrier {barrier.name} = {barrier.expression} is a maximum, which {name} cannot keep:"
            " the constraint of one of its functions is enough only without noise, uncertainty,"
            " reciprocal demands and first-order margins. Take cbf, ecbf or hocbf, or a smooth"
            " function below it, such as log((exp(k*a) + exp(k*b))/2)/k for Max(a, b)"
        )
    return replace(found[0], alternatives=tuple(found))
