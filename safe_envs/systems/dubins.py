"""Dubins vehicles: in a disk (without and with noise) and around a moving obstacle."""

from __future__ import annotations

import sympy as sp

from safe_envs.barrier import Barrier
from safe_envs.calculus import generator
from safe_envs.env import SystemEnv
from safe_envs.errors import ConfigurationError
from safe_envs.problem import Feature, SafetyProblem, Start, Variable
from safe_envs.sde import ControlAffineSDE
from safe_envs.vector import SystemVectorEnv

x, y, theta, omega = sp.symbols("x y theta omega", real=True)
x_o, y_o = sp.symbols("x_o y_o", real=True)
v, sigma_1, sigma_2, v_o = sp.symbols("v sigma_1 sigma_2 v_o", real=True)
cos_theta, sin_theta = sp.symbols("cos_theta sin_theta", real=True)
_radius, _angle, _heading = sp.symbols("uniform_1:4", real=True)

_HEADING_GAIN = 2.0
_GOAL = (3.0, 1.5)
_GOAL_RADIUS = 0.3


def vehicle(speed: float, noise: float) -> ControlAffineSDE:
    """dx = v cos(theta) dt + sigma_1 dW_1, dy = v sin(theta) dt + sigma_2 dW_2, dtheta = omega dt.

    Source: thesis Eq. (3.27) and Sec. 4.3.2.
    """
    return ControlAffineSDE(
        states=(x, y, theta),
        inputs=(omega,),
        drift=[v * sp.cos(theta), v * sp.sin(theta), 0],
        input_matrix=[0, 0, 1],
        diffusion=[[sigma_1, 0], [0, sigma_2], [0, 0]],
        parameters={v: speed, sigma_1: noise, sigma_2: noise},
    )


def vehicle_and_obstacle(speed: float) -> ControlAffineSDE:
    """The vehicle, and an obstacle that moves along x with the known speed v_o.

    Source: thesis Sec. 3.5.1. The print drives the obstacle by the clock and forgets its velocity in the
    derivatives of h; here its position is a state.
    """
    car = vehicle(speed, noise=0.0)
    return ControlAffineSDE(
        states=(*car.states, x_o, y_o),
        inputs=car.inputs,
        drift=[*car.drift, v_o, 0],
        input_matrix=[*car.input_matrix, 0, 0],
        diffusion=car.diffusion.col_join(sp.zeros(2, 2)),
        parameters={**car.parameters, v_o: 0.5},
    )


def _disk(name: str, *, plant_speed: float, model_speed: float, noise: float, radius: float, **timing: object) -> SafetyProblem:
    if not radius > 0:
        raise ConfigurationError(f"radius = {radius}; give a positive number of metres")
    r = sp.Float(radius, 17)
    model = vehicle(model_speed, noise)
    h = r**2 - x**2 - y**2
    anywhere = (
        r * sp.sqrt(_radius) * sp.cos(2 * sp.pi * _angle),
        r * sp.sqrt(_radius) * sp.sin(2 * sp.pi * _angle),
        2 * sp.pi * _heading,
    )
    uniforms = (_radius, _angle, _heading)
    return SafetyProblem(
        name=name,
        plant=vehicle(plant_speed, noise),
        model=model,
        barriers=(Barrier(h),),
        states=(Variable(x, -2 * radius, 2 * radius, "m"), Variable(y, -2 * radius, 2 * radius, "m"), Variable(theta, -sp.oo, sp.oo, "rad")),
        inputs=(Variable(omega, -10.0, 10.0, "rad/s"),),
        features=(
            Feature("x", x, -2 * radius, 2 * radius),
            Feature("y", y, -2 * radius, 2 * radius),
            Feature("cos_theta", sp.cos(theta), -1.0, 1.0),
            Feature("sin_theta", sp.sin(theta), -1.0, 1.0),
        ),
        reward=sp.exp(-4 * (h / r**2) ** 2),
        nominal=(_patrol(r),),
        starts={"inward": Start(anywhere, uniforms, generator(model, h)), "uniform": Start(anywhere, uniforms)},
        noise=("sigma_1", "sigma_2"),
        plane=("x", "y"),
        **timing,
    )


def _patrol(r: sp.Expr) -> sp.Expr:
    """Turn rate that leads onto the circle of radius r, and around it counterclockwise.

    The wanted course is the tangent, turned outward inside the circle and inward beyond it, in proportion to
    the distance from it.
    """
    distance = sp.sqrt(x**2 + y**2 + sp.Float(1e-9) * r**2)
    outward = 1 - distance / r
    wanted_x = (-y + 2 * outward * x) / distance
    wanted_y = (x + 2 * outward * y) / distance
    error = sp.atan2(cos_theta * wanted_y - sin_theta * wanted_x, cos_theta * wanted_x + sin_theta * wanted_y)
    return v / r + _HEADING_GAIN * error


def stochastic_dubins(*, radius: float = 3.0) -> SafetyProblem:
    return _disk(
        "StochasticDubins", plant_speed=2.0, model_speed=2.0, noise=0.2, radius=radius, dt=0.05, horizon=5.0, filter="scbf"
    )


class StochasticDubins(SystemEnv):
    problem_factory = staticmethod(stochastic_dubins)


class StochasticDubinsVector(SystemVectorEnv):
    env_class = StochasticDubins
