"""A system of one's own, as a person writes it into a file."""

SYSTEM = """
import sympy as sp

from safe_envs import ControlAffineSDE, define_problem

x, v, u, sigma = sp.symbols("x v u sigma", real=True)


def _cart(noise, parameters, barrier=1 - x**2, **more):
    system = ControlAffineSDE.from_rate(
        (x, v), (u,), [v, u - 0.5 * v], diffusion=[0, noise], parameters=parameters
    )
    given = {"start": [(-0.5, 0.5), (-0.5, 0.5)], "dt": 0.03, "horizon": 1.0}
    given |= {"nominal": 1.5 * v - 4 * x, "gains": (2.0, 2.0), "name": "cart"}
    return define_problem(system, barrier, input_bounds=(-5.0, 5.0), **{**given, **more})


problem = _cart(sigma, {sigma: 0.1})
bounded = _cart(sigma, {sigma: 0.1}, workspace={x: (-2, 2), v: (-3, 3)})
fixed = _cart(0.1, {})
still = _cart(0, {})
falling = _cart(sigma, {sigma: 0.1}, barrier=1.0 * x, start=[1.0, (-3.0, 1.0)])
"""
