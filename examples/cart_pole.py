"""A cart-pole pushed by gusts, whose pole must stay within 15 degrees.

    safe-envs evaluate --system examples/cart_pole.py:problem --filter none --filter hocbf

The equations are those of A. G. Barto, R. S. Sutton and C. W. Anderson, "Neuronlike adaptive
elements that can solve difficult learning control problems", IEEE Trans. SMC 13 (1983), without
friction.
"""

import math

import sympy as sp

from safe_envs import ControlAffineSDE, SafetyProblem, define_problem

x, v, theta, omega, force = sp.symbols("x v theta omega F", real=True)
M, m, length = sp.symbols("M m l", positive=True)
gust = sp.Symbol("gust", nonnegative=True)

swing = (force + m * length * omega**2 * sp.sin(theta)) / (M + m)
turn = (9.81 * sp.sin(theta) - sp.cos(theta) * swing) / (
    length * (sp.Rational(4, 3) - m * sp.cos(theta) ** 2 / (M + m))
)
cart_pole = ControlAffineSDE.from_rate(
    states=(x, v, theta, omega),
    inputs=(force,),
    rate=[v, swing - m * length * turn * sp.cos(theta) / (M + m), omega, turn],
    diffusion=[0, 0, 0, gust],
    parameters={M: 1.0, m: 0.1, length: 0.5, gust: 0.05},
)


def problem(*, limit: float = 15.0) -> SafetyProblem:
    """State the problem; the nominal controller hurries to the middle of the track.

    Args:
        limit: Largest angle of the pole in degrees.
    """
    widest = math.radians(limit)
    return define_problem(
        cart_pole,
        1 - (theta / widest) ** 2,
        input_bounds=(-30.0, 30.0),
        start=[(-4.0, 4.0), 0.0, (-0.05, 0.05), 0.0],
        dt=0.02,
        horizon=10.0,
        name="CartPole",
        nominal=60 * theta + 14 * omega + 6 * x + 8 * v,
        reward=sp.exp(-(x**2)),
        workspace={
            x: (-10.0, 10.0),
            v: (-20.0, 20.0),
            theta: (-0.5 * math.pi, 0.5 * math.pi),
            omega: (-20.0, 20.0),
        },
        units={x: "m", v: "m/s", theta: "rad", omega: "rad/s", force: "N"},
        gains=(5.0, 5.0),
    )
