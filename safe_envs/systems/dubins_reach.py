"""Dubins vehicle with noise that is to reach a goal before a moving obstacle hits it."""

from __future__ import annotations

import math

import sympy as sp

from safe_envs.envs.registered import SystemEnv
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Feature, Variable
from safe_envs.problem.starts import SamplingDomain, Start
from safe_envs.systems.common import positive, uniform_box
from safe_envs.systems.dubins import HEADING, POSE_SENSORS, SHOWN, omega, theta, x, y
from safe_envs.systems.dubins_obstacle import (
    obstacle_sensors,
    separation,
    v_o,
    vehicle_among,
    way_to,
    x_o,
    y_o,
)

_GOAL = (1.4, 1.0)
_GATE, _GATE_RADIUS = (-0.6, 1.1), 0.4
_START = (-1.5, -1.0, 0.4)
_OBSTACLE_START = (0.0, -1.2)


def dubins_reach(*, radius: float = 0.4) -> SafetyProblem:
    """Build the problem of reaching a goal past a moving obstacle, with noise in the position.

    Args:
        radius: r_O of the obstacle, in m.
    """
    r = positive("radius", radius)
    car = vehicle_among(1.0, {x_o: sp.Integer(0), y_o: v_o}, {v_o: 0.7}, noise=0.2)
    return SafetyProblem(
        name="DubinsReach",
        plant=car,
        model=car,
        barriers=(Barrier(separation(x_o, y_o, r)),),
        regions={"gate": _GATE_RADIUS**2 - (x - _GATE[0]) ** 2 - (y - _GATE[1]) ** 2},
        states=(
            Variable(x, -2.0, 2.0, "m"),
            Variable(y, -2.0, 2.0, "m"),
            Variable(theta, -math.inf, math.inf, "rad"),
            Variable(x_o, -5.0, 5.0, "m"),
            Variable(y_o, -5.0, 5.0, "m"),
        ),
        inputs=(Variable(omega, -3.0, 3.0, "rad/s"),),
        features=(
            Feature("x", x, -2.0, 2.0),
            Feature("y", y, -2.0, 2.0),
            *HEADING,
            Feature("ahead_x", x_o - x, -7.0, 7.0),
            Feature("ahead_y", y_o - y, -7.0, 7.0),
        ),
        sensors=(*POSE_SENSORS, *obstacle_sensors(x_o, y_o)),
        starts={
            "spread": uniform_box((*_START, *_OBSTACLE_START), (0.2, 0.2, 0.5, 0.0, 0.0)),
            "fixed": Start.at((*_START, *_OBSTACLE_START)),
        },
        dt=0.2,
        horizon=6.0,
        gains=(1.0, 2.0),
        filter="hocbf",
        **SHOWN,
        sampling=SamplingDomain(
            region=((-2.0, 2.0), (-2.0, 2.0), (-math.pi, math.pi), (-0.5, 0.5), (-1.2, 3.0)),
            coordinates=(sp.cos(theta), sp.sin(theta), x_o - x, y_o - y),
        ),
        **way_to(*_GOAL),
    )


class DubinsReach(SystemEnv):
    """A vehicle with noise heads for a goal, and an obstacle moves across its way.

    ## Description
    As `DubinsObstacle`, with noise in the position and in a small workspace: the task is to reach
    the goal before a collision with the obstacle, "always safe & eventually goal". The path of the
    obstacle is known from the start, so three coordinates and the time describe the state. The
    vehicle cannot slow down, and the workspace ends 2 m from the centre. In one step it moves by .2
    m, which is five cells of a table with 100 cells along x and y; the bounds of such a table are
    close to each other.

    ## Equations
        dx = v cos(theta) dt + sigma_1 dW_1
        dy = v sin(theta) dt + sigma_2 dW_2
        dtheta = omega dt
        dx_o = 0
        dy_o = v_o dt

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `x`, `y` | position of the vehicle | m | [-2, 2] |
    | `theta` | heading | rad | unbounded |
    | `x_o`, `y_o` | position of the obstacle | m | [-5, 5] |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `omega` | turn rate | rad/s | [-3, 3] |

    ## Observation
    The position, $cos(theta)$, $sin(theta)$, and the position of the obstacle relative to the
    vehicle, $x_o - x$ and $y_o - y$.

    ## Barrier
    $$h = (x - x_o)^2 + (y - y_o)^2 - r_O^2$$

    with $r_O = .4$ m, of relative degree 2. Gains 1 and 2. Default filter: `hocbf`, which ignores
    the noise.

    ## Regions
    `gate`, the disk of radius .4 m around $(-.6, 1.1)$, for sequences: "always safe & eventually
    (gate then goal)" leads around the path of the obstacle.

    ## Noise
    `sigma_1`, `sigma_2` of the vehicle in m/sqrt(s), both .2.

    ## Mismatch
    None: plant and model have $v = 1$ m/s and $v_o = .7$ m/s; `plant={"v": 1.2}` or `model={"v_o":
    0.5}` makes them differ.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: position with a standard
    deviation of .05 m and heading with .05 rad, known modulo 2 pi, range of the obstacle with
    .1 m and its bearing from the heading with .05 rad.

    ## Reward
    The cosine of the angle between heading and goal at each step, in $[-1, 1]$, which is the
    progress in units of $v dt$; and 10 on arrival. Neither circling nor leaving the workspace pays.

    ## Nominal controller
    Turns towards the goal with gain 2 1/s.

    ## Start
    `spread`: vehicle uniform within (.2 m, .2 m, .5 rad) of $(-1.5, -1, .4)$, obstacle at $(0,
    -1.2)$. `fixed`: exactly there.

    ## Episode end
    Terminated within .3 m of the goal $(1.4, 1)$ or outside the workspace, truncated after 6 s = 30
    steps.

    ## Arguments
    `barrier={"radius": 0.4}`, the radius of the obstacle in m; for all others see `SystemEnv`.

    ## Source
    Not from the thesis: the vehicle of its Eq. (3.27) and Sec. 4.3.2, in a task like that of Sec.
    3.5.1.
    """

    problem_factory = staticmethod(dubins_reach)
