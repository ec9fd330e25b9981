"""A system of one's own, as a person writes it into a file."""

SYSTEM = """
import sympy as sp

from safe_envs import ControlAffineSDE, state_problem

x, v, u, sigma = sp.symbols("x v u sigma", real=True)


def _cart(noise, parameters, barrier=1 - x**2, **more):
    rate, noises = [v, u - 0.5 * v], [0, noise]
    system = ControlAffineSDE.from_rate(
        (x, v), (u,), rate, diffusion=noises, parameters=parameters
    )
    given = {"start": [(-0.5, 0.5), (-0.5, 0.5)], "dt": 0.03, "horizon": 1.0}
    given |= {"nominal": 1.5 * v - 4 * x, "gains": (2.0, 2.0)}
    return state_problem(system, barrier, box=(-5.0, 5.0), name="cart", **{**given, **more})


problem = _cart(sigma, {sigma: 0.1})
bounded = _cart(sigma, {sigma: 0.1}, workspace={x: (-2, 2), v: (-3, 3)})
fixed = _cart(0.1, {})
still = _cart(0, {})
falling = _cart(sigma, {sigma: 0.1}, barrier=1.0 * x, start=[1.0, (-3.0, 1.0)])
"""
