"""Dubins vehicle that drives through obstacles moving in circles, each with a barrier."""

from __future__ import annotations

import math

import sympy as sp

from safe_envs.envs.registered import SystemEnv
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.measurement import Channel
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Feature, Variable
from safe_envs.problem.starts import Start
from safe_envs.systems.common import around, positive, uniforms
from safe_envs.systems.dubins import HEADING, POSE_SENSORS, SHOWN, omega, theta, x, y
from safe_envs.systems.dubins_obstacle import (
    separation,
    vehicle_among,
    way_to,
)

w_o = sp.Symbol("w_o", real=True)

_MOST_OBSTACLES = 20
_SPEED = 0.8
_ORBIT = 0.6
_ORBIT_RATE = 0.6
_CLEARANCE = 1.0
_SPACING = 1.35
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def centers(count: int) -> list[tuple[sp.Expr, sp.Expr]]:
    """Return the middles of the obstacles' circles, in m, to the centimetre.

    They lie like the seeds of a sunflower, which fill a disk evenly for any number of them.
    """
    polar = [(_SPACING * math.sqrt(i + 0.5), i * _GOLDEN_ANGLE) for i in range(count)]
    return [
        (
            sp.Rational(round(100 * rho * math.cos(a)), 100),
            sp.Rational(round(100 * rho * math.sin(a)), 100),
        )
        for rho, a in polar
    ]


def _number_of_obstacles(given: object) -> int:
    if not isinstance(given, int) or isinstance(given, bool) or not 1 <= given <= _MOST_OBSTACLES:
        raise ConfigurationError(
            f"num_obstacles = {shown(given)}; give a whole number from 1 to {_MOST_OBSTACLES}"
        )
    return given


def dubins_obstacles(*, num_obstacles: int = 5, radius: float = 0.4) -> SafetyProblem:
    """Build the problem of reaching a goal through a field of obstacles.

    Args:
        num_obstacles: N, from 1 to 20. The field grows with it, so that its density stays the same.
        radius: r_O of each obstacle, in m.
    """
    count, r = _number_of_obstacles(num_obstacles), positive("radius", radius)
    field = _SPACING * math.sqrt(count)
    edge = field + _ORBIT + r + _CLEARANCE
    side = edge + 2.0
    phases = sp.symbols(f"phase_1:{count + 1}", real=True)
    places = [
        (c_x + _ORBIT * sp.cos(p), c_y + _ORBIT * sp.sin(p))
        for (c_x, c_y), p in zip(centers(count), phases, strict=True)
    ]
    # Neighbours circle in opposite directions.
    car = vehicle_among(
        _SPEED, {p: w_o * (-1) ** i for i, p in enumerate(phases)}, {w_o: _ORBIT_RATE}
    )
    along, across, heading, *turns = spread = uniforms(3 + count)
    return SafetyProblem(
        name="DubinsObstacles",
        plant=car,
        model=car,
        barriers=tuple(
            Barrier(separation(*place, r), f"h_{i}") for i, place in enumerate(places, start=1)
        ),
        states=(
            *(Variable(s, -side, side, "m") for s in (x, y)),
            *(Variable(s, -math.inf, math.inf, "rad") for s in (theta, *phases)),
        ),
        inputs=(Variable(omega, -math.pi, math.pi, "rad/s"),),
        features=(
            *(Feature(s.name, s, -side, side) for s in (x, y)),
            *HEADING,
            *(
                Feature(f"ahead_{own}_{i}", position - own, -2 * side, 2 * side)
                for i, place in enumerate(places, start=1)
                for own, position in zip((x, y), place, strict=True)
            ),
        ),
        sensors=(
            *POSE_SENSORS,
            *(Channel(p.name, p, 0.05, period=2.0 * math.pi) for p in phases),
        ),
        starts={
            "spread": Start(
                (
                    around(-edge - 0.5, 0.5, along),
                    around(0.0, field, across),
                    around(0.0, 0.5, heading),
                    *(2 * sp.pi * turn for turn in turns),
                ),
                spread,
            )
        },
        dt=0.05,
        horizon=math.ceil(4 * edge / _SPEED),
        gains=(3.0, 5.0),
        filter="hocbf",
        **SHOWN,
        **way_to(edge, 0.0),
    )


class DubinsObstacles(SystemEnv):
    """A vehicle heads for a goal through a field of obstacles that move in circles.

    ## Description
    The vehicle cannot slow down, only turn, and has to find gaps that open and close. The obstacles
    do not react, and the vehicle is faster than they are. Each obstacle has its own barrier, so a
    filter has to meet N conditions with one input.

    ## Equations
        dx = v cos(theta) dt + sigma_1 dW_1
        dy = v sin(theta) dt + sigma_2 dW_2
        dtheta = omega dt
        dphase_i = +-w_o dt

    Obstacle i is at $x_i = c_xi + R_o cos(phase_i)$, $y_i = c_yi + R_o sin(phase_i)$, where $R_o =
    .6$ m and $w_o = .6$ rad/s, so it moves at .36 m/s; obstacles with odd numbers turn to the left,
    the others to the right. The centres are arranged like the seeds of a sunflower, in a field of
    radius $F = 1.35 sqrt(N)$ m around the origin, so far apart that obstacles of $r_O < .44$ m
    never touch. With $E = F + R_o + r_O + 1$ m, the path leads from $x < -E$ to $(E, 0)$.

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `x`, `y` | position of the vehicle | m | [-E - 2, E + 2], 7.02 m for N = 5 |
    | `theta` | heading | rad | unbounded |
    | `phase_1` to `phase_N` | angle of each obstacle on its circle | rad | unbounded |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `omega` | turn rate | rad/s | [-pi, pi] |

    ## Observation
    The position, $cos(theta)$, $sin(theta)$, and the position of each obstacle relative to the
    vehicle, $x_i - x$ and $y_i - y$. The velocity of an obstacle follows from its position.

    ## Barrier
    `h_1` to `h_N`:

    $$h_i = (x - x_i)^2 + (y - y_i)^2 - r_O^2$$

    with $r_O = .4$ m, each of relative degree 2. The input does not act on $h_i$ where the vehicle
    heads straight for the obstacle or away from it. Gains 3 and 5 for each: with smaller gains the
    vehicle keeps a larger distance, and the constraints of several obstacles contradict each other
    more often. Default filter: `hocbf`.

    ## Noise
    `sigma_1`, `sigma_2` of the vehicle in m/sqrt(s), both 0.

    ## Mismatch
    None: plant and model have $v = .8$ m/s and $w_o = .6$ rad/s. The difficulty is the number of
    barriers.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: position with a standard
    deviation of .05 m and heading with .05 rad, known modulo 2 pi; each obstacle broadcasts its
    phase, with .05 rad.

    ## Reward
    The cosine of the angle between heading and goal at each step, in $[-1, 1]$, which is the
    progress in units of $v dt$; and 10 on arrival.

    ## Nominal controller
    Turns towards the goal with gain 2 1/s, and ignores the obstacles.

    ## Start
    `spread`: x uniform in $[-E - 1, -E]$, y within $F$ of 0, heading within .5 rad of 0, phases
    uniform. No obstacle comes nearer to these places than 1 m, so the vehicle starts in the set
    that the filter keeps.

    ## Episode end
    Terminated within .3 m of the goal or outside the workspace, truncated after the time in which
    the vehicle covers four times $E$: 26 s for N = 5.

    ## Arguments
    `num_obstacles=5`, N, from 1 to 20; `radius=0.4`, the radius of the obstacles in m. For all
    others see `SystemEnv`.

    ## Source
    The vehicle of thesis Eq. (3.27) and the barrier of Sec. 3.5.1, which has one obstacle. The
    field is not from the thesis.
    """

    problem_factory = staticmethod(dubins_obstacles)
