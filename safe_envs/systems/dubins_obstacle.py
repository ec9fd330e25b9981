"""Dubins vehicle on its way to a goal that a moving obstacle crosses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.registered import SystemEnv
from safe_envs.problem.measurement import Channel
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Feature, Variable
from safe_envs.problem.starts import SamplingDomain, Start
from safe_envs.systems.common import positive, uniform_box
from safe_envs.systems.dubins import (
    HEADING,
    POSE_SENSORS,
    SHOWN,
    omega,
    theta,
    turn_rate_towards,
    vehicle,
    x,
    y,
)

x_o, y_o, v_o = sp.symbols("x_o y_o v_o", real=True)

_GOAL_X, _GOAL_Y = 3.0, 1.5
_GOAL_RADIUS = 0.3
_GOAL_BONUS = 10
_START = (-2.0, -2.0, 0.0)
_OBSTACLE_START = (-1.0, 0.0)


def vehicle_among(
    speed: float,
    obstacles: Mapping[sp.Symbol, sp.Expr],
    parameters: Mapping[sp.Symbol, float],
    noise: float = 0.0,
) -> ControlAffineSDE:
    """Return the vehicle of Eq. (3.27) with obstacles, whose coordinates are states.

    Args:
        speed: v of the vehicle, in m/s.
        obstacles: rate of each coordinate, in its unit a second.
        parameters: value of the symbols in the rates.
        noise: sigma_1 = sigma_2 of the vehicle, in m/sqrt(s).

    Source: thesis Sec. 3.5.1. The thesis drives the obstacle by the clock and forgets its velocity
        in the
    derivatives of h; here its position is a state, so that nothing can be forgotten.
    """
    car = vehicle(speed, noise)
    rest = [0] * len(obstacles)
    return ControlAffineSDE(
        states=(*car.states, *obstacles),
        inputs=car.inputs,
        drift=[*car.drift, *obstacles.values()],
        input_matrix=[*car.input_matrix, *rest],
        diffusion=car.diffusion.col_join(sp.zeros(len(rest), 2)),
        parameters={**car.parameters, **parameters},
    )


def way_to(goal_x: float, goal_y: float) -> dict[str, Any]:
    """Return reward, nominal controller and goal of a vehicle that is to reach a point.

    Args:
        goal_x: of the point, in m.
        goal_y: of the point, in m.

    Returns:
        Arguments of `SafetyProblem`.
    """
    to_goal_x, to_goal_y = goal_x - x, goal_y - y
    distance = sp.sqrt(
        to_goal_x**2 + to_goal_y**2 + 1e-12
    )  # the small term keeps the goal from a division by zero
    towards_goal = (to_goal_x * sp.cos(theta) + to_goal_y * sp.sin(theta)) / distance
    goal = _GOAL_RADIUS**2 - to_goal_x**2 - to_goal_y**2
    return {
        "reward": towards_goal + _GOAL_BONUS * (1 + sp.sign(goal)) / 2,
        "nominal": (turn_rate_towards(to_goal_x, to_goal_y),),
        "goal": goal,
    }


def separation(x_i: sp.Expr, y_i: sp.Expr, distance: float) -> sp.Expr:
    """Return an expression that is positive where the vehicle is farther than a distance away.

    Args:
        x_i: of the point, in m.
        y_i: of the point, in m.
        distance: in m.
    """
    return (x - x_i) ** 2 + (y - y_i) ** 2 - distance**2


def obstacle_sensors(x_i: sp.Expr, y_i: sp.Expr, suffix: str = "") -> tuple[Channel, Channel]:
    """Return the range of an obstacle and its bearing, as a radar of the vehicle measures them.

    Args:
        x_i: of the obstacle, in m.
        y_i: of the obstacle, in m.
        suffix: of the names.
    """
    return (
        Channel(f"range{suffix}", sp.sqrt((x_i - x) ** 2 + (y_i - y) ** 2), 0.1),
        Channel(f"bearing{suffix}", sp.atan2(y_i - y, x_i - x) - theta, 0.05),
    )


def dubins_obstacle(*, radius: float = 0.5) -> SafetyProblem:
    """Build the problem of reaching a goal past an obstacle.

    The vehicle is faster than its designer believes.

    Args:
        radius: r_O of the obstacle, in m.

    Source: thesis Sec. 3.5.1, moving case.
    """
    r = positive("radius", radius)
    moving = {x_o: v_o, y_o: sp.Integer(0)}
    return SafetyProblem(
        name="DubinsObstacle",
        plant=vehicle_among(0.8, moving, {v_o: 0.5}),
        model=vehicle_among(0.5, moving, {v_o: 0.5}),
        barriers=(Barrier(separation(x_o, y_o, r)),),
        states=(
            Variable(x, -5.0, 6.0, "m"),
            Variable(y, -5.0, 5.0, "m"),
            Variable(theta, -math.inf, math.inf, "rad"),
            Variable(x_o, -5.0, 20.0, "m"),
            Variable(y_o, -5.0, 5.0, "m"),
        ),
        inputs=(Variable(omega, -math.pi, math.pi, "rad/s"),),
        features=(
            Feature("x", x, -5.0, 6.0),
            Feature("y", y, -5.0, 5.0),
            *HEADING,
            Feature("ahead_x", x_o - x, -11.0, 25.0),
            Feature("ahead_y", y_o - y, -10.0, 10.0),
        ),
        sensors=(*POSE_SENSORS, *obstacle_sensors(x_o, y_o)),
        starts={
            "spread": uniform_box((*_START, *_OBSTACLE_START), (0.5, 0.5, 0.5, 0.0, 0.0)),
            "thesis": Start.at((*_START, *_OBSTACLE_START)),
        },
        dt=0.05,
        horizon=15.0,
        gains=(1.0, 1.0),
        filter="hocbf",
        **SHOWN,
        sampling=SamplingDomain(
            region=((-3.0, 4.0), (-3.0, 3.0), (-math.pi, math.pi), (-2.0, 7.0), (-1.0, 1.0)),
            coordinates=(sp.cos(theta), sp.sin(theta), x_o - x, y_o - y),
        ),
        **way_to(_GOAL_X, _GOAL_Y),
    )


class DubinsObstacle(SystemEnv):
    """A vehicle at constant speed heads for a goal, and an obstacle moves across its way.

    ## Description
    The straight path to the goal leads through the place where the obstacle will be. The vehicle
    cannot slow down; it has to turn aside. The obstacle does not react.

    ## Equations
        dx = v cos(theta) dt + sigma_1 dW_1
        dy = v sin(theta) dt + sigma_2 dW_2
        dtheta = omega dt
        dx_o = v_o dt
        dy_o = 0

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `x` | position of the vehicle | m | [-5, 6] |
    | `y` | | m | [-5, 5] |
    | `theta` | heading | rad | unbounded |
    | `x_o` | position of the obstacle | m | [-5, 20] |
    | `y_o` | | m | [-5, 5] |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `omega` | turn rate | rad/s | [-pi, pi] (assumed) |

    ## Observation
    The position, $cos(theta)$, $sin(theta)$, and the position of the obstacle relative to the
    vehicle, $x_o - x$ and $y_o - y$.

    ## Barrier
    $$h = (x - x_o)^2 + (y - y_o)^2 - r_O^2$$

    with $r_O = .5$ m, of relative degree 2. Gains 1 and 1. Default filter: `hocbf`.

    ## Noise
    `sigma_1`, `sigma_2` of the vehicle in m/sqrt(s), both 0.

    ## Mismatch
    The plant has $v = .8$ m/s, the model $v = .5$ m/s; both know the speed of the obstacle, $v_o =
    .5$ m/s.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: position with a standard
    deviation of .05 m and heading with .05 rad, known modulo 2 pi, range of the obstacle with
    .1 m and its bearing from the heading with .05 rad.

    ## Reward
    The cosine of the angle between heading and goal at each step, in $[-1, 1]$, which is the
    progress in units of $v dt$; and 10 on arrival. The sum of the progress is the decrease of the
    distance, so neither circling nor leaving the workspace pays.

    ## Nominal controller
    Turns towards the goal with gain 2 1/s.

    ## Start
    `spread`: vehicle uniform within .5 (m, m, rad) of $(-2, -2, 0)$, obstacle at $(-1, 0)$.
    `thesis`: exactly there.

    ## Episode end
    Terminated within .3 m of the goal $(3, 1.5)$ or outside the workspace, truncated after 15 s =
    300 steps.

    ## Arguments
    `barrier={"radius": 0.5}`, the radius of the obstacle in m; for all others see `SystemEnv`.

    ## Source
    Thesis Sec. 3.5.1, moving obstacle avoidance. The derivatives of $h$ printed there omit the
    velocity of the obstacle; with the obstacle as a state they are right by construction.
    """

    problem_factory = staticmethod(dubins_obstacle)
