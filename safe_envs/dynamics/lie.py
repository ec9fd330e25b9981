"""Lie derivatives, the Ito generator and relative degree, by symbolic differentiation.

The printed derivations of this field contain sign errors; here nothing is differentiated by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import sympy as sp
from sympy.simplify.fu import TR5

from safe_envs.dynamics.identities import is_zero
from safe_envs.dynamics.min_max import pieces
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.dynamics.symbols import TIME
from safe_envs.errors import RelativeDegreeError

Derivative = Callable[[ControlAffineSDE, sp.Expr], sp.Expr]

_STEPS = (sp.floor, sp.ceiling, sp.frac, sp.Mod)
_KINKED = (
    *(sp.Piecewise, sp.Abs, sp.Min, sp.Max, sp.sign, sp.Heaviside, sp.DiracDelta),
    *_STEPS,
)
_LARGEST_TIDIED = 100
_MOST_TERMS = 200


def gradient(system: ControlAffineSDE, expression: sp.Expr) -> sp.ImmutableMatrix:
    """Return the row of partial derivatives with respect to the states, shape (1, n).

    Args:
        system: the dynamics.
        expression: phi, of the states and the parameters.
    """
    return _gradient(system.states, expression)


@lru_cache(maxsize=512)
def _gradient(states: tuple[sp.Symbol, ...], expression: sp.Expr) -> sp.ImmutableMatrix:
    """Differentiate once: drift, input and noise each need the gradient of a chain's link."""
    return sp.ImmutableMatrix([[slope(expression, s) for s in states]])


def slope(expression: Any, symbol: sp.Symbol) -> sp.Expr:
    """Return the derivative of an expression, in which steps count as constant between them.

    Sympy has no derivative of floor, ceiling, frac and Mod.

    Args:
        expression: phi.
        symbol: by which it is taken.
    """
    if not expression.has(*_STEPS):
        return sp.diff(expression, symbol)
    by_floors = expression.replace(sp.Mod, lambda a, b: a - b * sp.floor(a / b))
    by_floors = by_floors.replace(sp.frac, lambda a: a - sp.floor(a))
    steps = {step: sp.Dummy() for step in by_floors.atoms(sp.floor, sp.ceiling)}
    found: Any = sp.diff(by_floors.xreplace(steps), symbol)
    return found.xreplace({held: step for step, held in steps.items()})


def lie_derivative_f(system: ControlAffineSDE, expression: sp.Expr) -> sp.Expr:
    """Return L_f phi = grad phi . f + explicit rate, the rate of phi without input and noise.

    Args:
        system: the dynamics.
        expression: phi, of the states, the parameters, the signals and the time.
    """
    along = (gradient(system, expression) * system.drift)[0, 0]
    return along + explicit_rate(system, expression)


def explicit_rate(system: ControlAffineSDE, expression: sp.Expr) -> sp.Expr:
    """Return dphi/dt + sum over the signals s of dphi/ds rate_s: what changes phi by itself.

    It is what L_f phi would gain if the signals were states with their rates as drift, and the time
    one with the drift 1.

    Args:
        system: the dynamics.
        expression: phi, of the states, the parameters, the signals and the time.
    """
    used = expression.free_symbols
    rates = {**system.signals, TIME: sp.Integer(1)}
    return sp.Add(*[slope(expression, s) * rate for s, rate in rates.items() if s in used])


def lie_derivative_g(system: ControlAffineSDE, expression: sp.Expr) -> sp.ImmutableMatrix:
    """Return L_g phi = grad phi . g, shape (1, m): how the input changes the rate of phi.

    Args:
        system: the dynamics.
        expression: phi, of the states and the parameters.
    """
    return sp.ImmutableMatrix(gradient(system, expression) * system.input_matrix)


def ito_correction(system: ControlAffineSDE, expression: sp.Expr) -> sp.Expr:
    """Return 1/2 tr(sigma sigma' phi_xx), the drift that noise gives to a curved function.

    Args:
        system: the dynamics.
        expression: phi, of the states and the parameters.
    """
    covariance = system.diffusion * system.diffusion.T
    total = sp.Integer(0)
    for i, row_state in enumerate(system.states):
        if all(covariance[i, j] == 0 for j in range(system.n)):
            continue
        along = slope(expression, row_state)
        total += sum(
            covariance[i, j] * slope(along, s)
            for j, s in enumerate(system.states)
            if covariance[i, j] != 0
        )
    return total / 2


def quadratic_variation_rate(system: ControlAffineSDE, expression: sp.Expr) -> sp.Expr:
    """Return |sigma' grad phi|^2, the variance of phi per s that the noise makes.

    Args:
        system: the dynamics.
        expression: phi, of the states and the parameters.
    """
    row = gradient(system, expression) * system.diffusion
    return (row * row.T)[0, 0]


def has_kinks(expression: Any) -> bool:
    """Return whether an expression has functions that are not smooth everywhere."""
    return expression.has(*_KINKED)


def generator(system: ControlAffineSDE, expression: sp.Expr) -> sp.Expr:
    """Return the input-free part of A phi = L_f phi + L_g phi u + 1/2 tr(sigma sigma' phi_xx).

    Args:
        system: the dynamics.
        expression: phi, of the states and the parameters.

    Source: thesis Eq. (4.4).
    """
    return lie_derivative_f(system, expression) + ito_correction(system, expression)


def vanishes(system: ControlAffineSDE, expression: Any) -> bool:
    """Return whether an expression is zero at every state, for the system's parameters.

    Where that can be neither shown nor refuted, the answer is no, which is the safe one: noise that
    may reach h is drawn, and an input that may have a say is not taken for one that has none.

    Args:
        system: whose parameters' values are used.
        expression: or matrix, of the states and the parameters.
    """
    return is_zero(system.exact(expression))


def derivatives(
    system: ControlAffineSDE, expression: sp.Expr, order: int, derivative: Derivative
) -> tuple[sp.Expr, ...]:
    """Return (phi, D phi, ..., D^order phi) for D = `lie_derivative_f` or `generator`.

    Args:
        system: along which phi is differentiated.
        expression: phi.
        order: of the last derivative.
        derivative: D.
    """
    result = [expression]
    for _ in range(order):
        result.append(derivative(system, result[-1]))
    return tuple(result)


def tidied(expression: Any) -> sp.Expr:
    """Return an equal expression with fewer operations, if one is found quickly.

    Only sin^2 + cos^2 = 1 and common factors are tried.
    """
    if expression.count_ops() > _LARGEST_TIDIED or _expanded_terms(expression) > _MOST_TERMS:
        return expression
    # An exponential that is taken apart may overflow in one factor and vanish in the other.
    expanded = expression if expression.has(sp.exp) else sp.expand(TR5(sp.expand(expression)))
    return min(
        (expression, sp.factor_terms(expression), sp.factor_terms(expanded)), key=sp.count_ops
    )


def _expanded_terms(expression: Any) -> int:
    """Return how many terms an expression has at most once it is multiplied out."""
    parts = [_expanded_terms(part) for part in expression.args]
    if expression.is_Add:
        return sum(parts)
    if expression.is_Mul:
        return math.prod(parts)
    if expression.is_Pow and expression.exp.is_Integer and expression.exp > 0:
        return math.comb(parts[0] + int(expression.exp) - 1, int(expression.exp))
    return 1


def relative_degree(
    system: ControlAffineSDE, expression: sp.Expr, derivative: Derivative = lie_derivative_f
) -> int:
    """Return the smallest r with L_g D^(r-1) h not identically zero.

    Args:
        system: with the parameters for which the degree is asked.
        expression: h.
        derivative: D; `lie_derivative_f` for the deterministic degree (thesis Def. 3.1.3),
            `generator` for the stochastic one. Thesis Def. 4.2.9 prints A^j h = 0 as the condition
            below r, where L_g A^(j-1) h = 0 is meant.

    Raises:
        RelativeDegreeError: the input reaches none of the first n derivatives (3 n with the
            generator), h does not depend on the states, or it is a minimum or maximum of functions
            of different degrees.
    """
    system.require_known("the barrier", expression.free_symbols, system.measured)
    found = pieces(expression)
    degrees = {h: _degree(system, h, derivative, len(found) > 1) for h in found}
    if len(set(degrees.values())) > 1:
        listing = ", ".join(f"{degree} of {h}" for h, degree in degrees.items())
        raise RelativeDegreeError(
            f"the pieces of {expression} have different relative degrees ({listing}); give one"
            " barrier for each of its pieces, each with rates of its own"
        )
    return max(degrees.values())


def _degree(
    system: ControlAffineSDE, expression: sp.Expr, derivative: Derivative, is_piece: bool
) -> int:
    what = f"{expression}, a piece of the barrier" if is_piece else "the barrier"
    # Differentiation along a flow leaves nothing new after as many orders as there are quantities
    # that change; the Ito term has no such bound.
    timed = TIME in expression.free_symbols or system.uses_time
    changing = system.n + len(system.signals) + timed
    orders = changing if derivative is lie_derivative_f else 3 * changing
    for order in range(orders):
        if any(not vanishes(system, entry) for entry in lie_derivative_g(system, expression)):
            return order + 1
        expression = derivative(system, expression)
    raise RelativeDegreeError(
        f"no input ({', '.join(map(str, system.inputs))}) appears in the first {orders} derivatives"
        f" of {what}: it has no relative degree, and no action can keep it positive. Check the"
        " barrier and the input matrix"
    )
