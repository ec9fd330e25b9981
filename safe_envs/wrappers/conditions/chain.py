"""Chains b_0 = h, b_1, ... by which conditions treat barriers of any relative degree."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sympy as sp

from safe_envs.dynamics.kinks import STEPS, edges, is_bent, switches
from safe_envs.dynamics.lie import (
    Derivative,
    gradient,
    lie_derivative_f,
    lie_derivative_g,
    relative_degree,
    vanishes,
)
from safe_envs.dynamics.min_max import MOST, clauses
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
    """Return a derivative of a chain without what sympy adds where functions have kinks.

    It has no weight where what is differentiated is continuous; see `require_smooth`.

    Args:
        expression: the derivative.
        barrier: barrier of the chain.

    Raises:
        SystemDefinitionError: sympy cannot differentiate.
    """
    if expression.has(sp.Derivative, sp.Subs):
        raise SystemDefinitionError(
            f"barrier {barrier.name} = {barrier.expression} cannot be differentiated as often as is"
            " needed; give a smooth one, of real symbols"
        )
    return expression.replace(sp.DiracDelta, lambda *_: sp.Integer(0))


def require_smooth(
    model: ControlAffineSDE,
    barrier: Barrier,
    functions: Sequence[sp.Expr],
    noisy: bool,
    kinks: bool = False,
) -> None:
    """Raise SystemDefinitionError where functions cannot be differentiated along a system.

    Where one jumps, its derivative lacks the jump. Where it has a kink, the two sides have their
    own constraints. The chain is right where states only pass, which they do where neither the
    input nor noise acts across the kink. Where the input does, it may hold the state there, by
    turns of inputs that the two sides allow, with a mean that neither allows. Where noise does, the
    generator lacks a local time.

    Args:
        model: the system.
        barrier: barrier of the chain.
        functions: that are differentiated.
        noisy: whether noise counts.
        kinks: whether they may have kinks anywhere.
    """
    for function in filter(is_bent, functions):
        known = model.exact(function)
        for edge in edges(known, model.measured):
            raise _not_smooth(model, barrier, edge, "may jump", "which its derivative leaves out")
        for edge in () if kinks else edges(known, model.measured, 1):
            across: list[Any] = [*lie_derivative_g(model, edge)]
            across += [*(gradient(model, edge) * model.diffusion)] if noisy else []
            speed = model.exact(lie_derivative_f(model, edge))
            if edges(speed, model.measured) or not all(vanishes(model, e) for e in across):
                why = "across which an input or noise acts"
                raise _not_smooth(model, barrier, edge, "may have a kink", why)


def _not_smooth(
    model: ControlAffineSDE, barrier: Barrier, edge: Any, what: str, why: str
) -> SystemDefinitionError:
    """Return the error of a chain that is not smooth, with the function that makes it so."""
    parts = {f"the drift of {s}": e for s, e in zip(model.states, model.drift, strict=True)}
    parts |= {"the input matrix": model.input_matrix, "the diffusion": model.diffusion}
    entries = [(name, e) for name, part in parts.items() for e in sp.flatten([part])]
    causes = [(name, e) for name, e in entries if edge in switches(model.exact(e))]
    place = f"where {edge} = 0" if isinstance(edge, sp.Expr) else f"by {edge}"
    place = f"by {edge}" if isinstance(edge, STEPS) else place
    reason = f"{what}{'' if edge.atoms(sp.Dummy) else f' {place}'}, {why}"
    if edge in switches(model.exact(barrier.expression)) or not causes:
        others = f"a smooth one, a sum of multiples of Min, Max and Abs of up to {MOST} ones, or "
        others *= len(clauses(barrier.expression)) == 1
        return SystemDefinitionError(
            f"barrier {barrier.name} = {barrier.expression} {reason}; give {others}one barrier for"
            " each of its pieces"
        )
    name, expression = causes[0]
    return SystemDefinitionError(
        f"{name} = {expression} {reason}; the chain of barrier {barrier.name} differentiates it:"
        " give a smooth function, such as tanh for a step, or another barrier"
    )
