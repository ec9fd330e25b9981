"""The min-norm law of a control Lyapunov function, in closed form and in symbols."""

from __future__ import annotations

import sympy as sp

from safe_envs.calculus import generator, input_derivative
from safe_envs.sde import ControlAffineSDE


def min_norm_clf(
    system: ControlAffineSDE, V: sp.Expr, rate: float, input_weight: sp.Expr | float, slack_weight: sp.Expr | float
) -> tuple[sp.Expr, ...]:
    """The input of the smallest cost that makes V decay, with a slack d that keeps the program feasible.

        min  w_u |u|^2 + w_d d^2   s.t.   a + b u <= d,   a = L_f V + 1/2 tr(sigma sigma' V_xx) + rate V,   b = L_g V

    Its only constraint is inactive where a <= 0. Elsewhere the multiplier follows from a + b u = d, so that
    u = -b' max(a, 0) / (b b' + w_u / w_d): there is no division by zero, for w_u > 0.

    Args:
        system: whose generator is taken. Its parameters stay symbols in the result.
        V: the Lyapunov function of the states.
        rate: wanted decay rate of V, in 1/s.
        input_weight: w_u.
        slack_weight: w_d.

    Returns:
        An expression of the states and parameters for each input.

    Source: the CLF part of the quadratic programs in thesis Sec. 4.3.1. The print asks for AV <= d, without the rate,
    and with the trace of sigma' sigma V_xx.
    """
    a = generator(system, V) + sp.sympify(rate) * V
    b = input_derivative(system, V)
    scale = sp.Max(a, 0) / ((b * b.T)[0, 0] + sp.sympify(input_weight) / slack_weight)
    return tuple(-scale * entry for entry in b)
