"""Chains b_0 = h, b_1, ... by which conditions treat barriers of any relative degree."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sympy as sp

from safe_envs.dynamics.lie import Derivative, has_kinks, relative_degree
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import SystemDefinitionError
from safe_envs.problem.barrier import Barrier
from safe_envs.wrappers.conditions.class_k import ClassK, Rate, applied
from safe_envs.wrappers.conditions.names import wrong_rates


def chain_of(
    model: ControlAffineSDE, barrier: Barrier, alphas: Sequence[Rate] | None, derivative: Derivative
) -> tuple[list[sp.Expr], sp.Expr]:
    """Return a chain and its end without the input.

    It is b_0 = h, b_j = D b_(j-1) + alpha_j(b_(j-1)) for j < r; the end is that part of b_r.

    Args:
        model: the system that D differentiates along.
        barrier: h.
        alphas: alpha_1..alpha_r; None for zeros, with r computed.
        derivative: D, the Lie derivative or the Ito generator.

    Returns:
        b_0, ..., b_(r-1), and the part of b_r without the input.

    Raises:
        RelativeDegreeError: the number of functions is not the relative degree, or there is none.
        SystemDefinitionError: the barrier or a class-K function cannot be differentiated as often
            as the chain needs.
    """
    degree = relative_degree(model, barrier.expression, derivative)
    if alphas is not None and len(alphas) != degree:
        raise wrong_rates(barrier.name, degree, len(alphas))
    for j, alpha in enumerate(alphas or (), start=1):
        if isinstance(alpha, ClassK) and not alpha.is_smooth(degree - j):
            raise SystemDefinitionError(
                f"class-K function {alpha} is the {j}. of {degree} and needs {degree - j}"
                " continuous derivatives, which it has not at 0; use an odd power or another"
                " smooth function there"
            )
    chain = [barrier.expression]
    for alpha in alphas or (None,) * degree:
        term = 0 if alpha is None else applied(alpha, chain[-1])
        chain.append(resolved(derivative(model, chain[-1]), barrier) + term)
    return chain[:-1], chain[-1]


def resolved(expression: Any, barrier: Barrier) -> sp.Expr:
    """Return a derivative of a chain without what sympy adds at kinks of class-K functions.

    At the kink of s |s| and the like, that has no weight.

    Args:
        expression: the derivative.
        barrier: barrier of the chain.

    Raises:
        SystemDefinitionError: the kink is the barrier's own: there the chain would jump, and Ito's
            formula miss a local time.
    """
    if not expression.has(sp.DiracDelta, sp.Derivative, sp.Subs):
        return expression
    if expression.has(sp.Derivative, sp.Subs) or has_kinks(barrier.expression):
        raise not_smooth(barrier)
    return expression.replace(sp.DiracDelta, lambda *_: sp.Integer(0))


def not_smooth(barrier: Barrier) -> SystemDefinitionError:
    """Return the error of a barrier with kinks where a derivative is needed."""
    return SystemDefinitionError(
        f"barrier {barrier.name} = {barrier.expression} cannot be differentiated as often as is"
        " needed; give a smooth one, of real symbols, or one barrier for each of its pieces"
    )
