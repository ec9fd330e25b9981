"""What a condition is: the rule that turns a system and a barrier into an affine constraint on the input."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import sympy as sp

from safe_envs.barrier import Barrier
from safe_envs.calculus import Derivative, input_derivative, relative_degree, tidied
from safe_envs.errors import ConfigurationError, RelativeDegreeError
from safe_envs.sde import ControlAffineSDE


class AffineConstraint(NamedTuple):
    """a(x) u + b(x) >= 0, with the chain b_0 = h, ..., b_(r-1) that leads to it."""

    coefficient: tuple[sp.Expr, ...]
    offset: sp.Expr
    chain: tuple[sp.Expr, ...]

    @classmethod
    def after(cls, model: ControlAffineSDE, chain: Sequence[sp.Expr], offset: sp.Expr) -> AffineConstraint:
        """The constraint L_g b_(r-1) u + offset >= 0 at the end of a chain."""
        a = input_derivative(model, chain[-1])
        return cls(tuple(tidied(a[0, j]) for j in range(model.m)), tidied(offset), tuple(chain))


class Condition(ABC):
    """Base of the conditions, which are small frozen dataclasses of their parameters.

    Attributes:
        name: by which `parse_condition` and the command line know it.
    """

    name: ClassVar[str]

    @abstractmethod
    def constraint(self, model: ControlAffineSDE, barrier: Barrier) -> AffineConstraint:
        """Derive the constraint for a model and a barrier, in the model's symbols."""

    @classmethod
    @abstractmethod
    def for_gains(cls, gains: Sequence[float]) -> Condition:
        """The condition with the rates p_1..p_r of a problem for its parameters."""

    @property
    def spec(self) -> str:
        """The text from which `parse_condition` makes the same condition."""
        parameters = [
            f"{key}={','.join(map(repr, value)) if isinstance(value, tuple) else repr(value)}" for key, value in vars(self).items()
        ]
        return ":".join([self.name, *parameters])


def positive_rates(name: str, rates: Sequence[float]) -> tuple[float, ...]:
    """Return class-K rates as floats, or say which one is not positive.

    Raises:
        ConfigurationError: there is none, or one is not a positive finite number.
    """
    values = tuple(float(r) for r in rates)
    if not values or not all(math.isfinite(v) and v > 0 for v in values):
        raise ConfigurationError(f"{name} = {values}; give positive rates in 1/s, one for each relative degree")
    return values


def linear_chain(model: ControlAffineSDE, barrier: Barrier, rates: Sequence[float] | None, derivative: Derivative) -> AffineConstraint:
    """b_0 = h, b_j = D b_(j-1) + p_j b_(j-1), and the constraint b_r >= 0.

    Args:
        model: the system that D differentiates along.
        barrier: h.
        rates: p_1..p_r; None for zeros, with r computed.
        derivative: D, the Lie derivative or the Ito generator.

    Raises:
        RelativeDegreeError: the number of rates is not the relative degree, or there is none.
    """
    degree = relative_degree(model, barrier.expression, derivative)
    if rates is None:
        rates = (0.0,) * degree
    if len(rates) != degree:
        raise RelativeDegreeError(f"barrier {barrier.name} has relative degree {degree} and needs as many rates; {len(rates)} given")
    chain = [barrier.expression]
    for p in rates[:-1]:
        chain.append(derivative(model, chain[-1]) + sp.Float(p, 17) * chain[-1] if p else derivative(model, chain[-1]))
    last = chain[-1]
    offset = derivative(model, last) + (sp.Float(rates[-1], 17) * last if rates[-1] else 0)
    return AffineConstraint.after(model, chain, offset)
