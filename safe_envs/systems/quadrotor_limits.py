"""Quadrotor between a floor and a ceiling, with limited tilt: three barriers, four inputs."""

from __future__ import annotations

import math

import sympy as sp

from safe_envs.envs.registered import SystemEnv
from safe_envs.errors import ConfigurationError
from safe_envs.problem.backup import BackupFunction
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import TIME, Feature
from safe_envs.systems.backup_laws import levelling_backup
from safe_envs.systems.common import around, uniforms
from safe_envs.systems.quadrotor import (
    LARGEST_TILT,
    psi,
    quadrotor,
    rotor_laws,
    rotor_problem,
    start_at,
    x,
)
from safe_envs.systems.quadrotor_altitude import (
    ALTITUDE_REWARD,
    HEIGHT,
    PLANT_MASS,
    phi,
    theta,
    z,
    zdot,
)
from safe_envs.text import finite_number

x_ref, x_ref_rate = sp.symbols("x_ref x_ref_rate", real=True)

_SWAY = 2.0
_SWAY_RATE = 1.5
_REFERENCE = _SWAY * sp.sin(_SWAY_RATE * TIME)


def quadrotor_limits(
    *, floor: float = 3.0, ceiling: float = 7.0, tilt: float = 0.5
) -> SafetyProblem:
    """Build the problem of a band of altitudes and a cone of tilts, with a known quadrotor.

    Args:
        floor: lowest safe altitude, in m.
        ceiling: highest safe altitude, in m.
        tilt: largest safe angle between the thrust and the vertical, in rad.

    Raises:
        ConfigurationError: the limits are not within the workspace, or in the wrong order.
    """
    low, high, angle = (
        finite_number("floor", floor),
        finite_number("ceiling", ceiling),
        finite_number("tilt", tilt),
    )
    bottom, top = HEIGHT[0].low, HEIGHT[0].high
    if not bottom < low < high < top:
        raise ConfigurationError(
            f"floor = {low} and ceiling = {high}; give {bottom} < floor < ceiling < {top}"
        )
    if not 0 < angle < LARGEST_TILT:
        raise ConfigurationError(
            f"tilt = {angle}; give an angle between 0 and {LARGEST_TILT:.3f} rad"
        )
    craft = quadrotor(PLANT_MASS)
    height, climb, heading = spread = uniforms(3)
    return rotor_problem(
        "QuadrotorLimits",
        plant=craft,
        model=craft,
        barriers=(
            Barrier(z - low, "floor"),
            Barrier(high - z, "ceiling"),
            Barrier(sp.cos(phi) * sp.cos(theta) - math.cos(angle), "tilt"),
        ),
        followed=(
            Feature("x_ref", _REFERENCE, -_SWAY, _SWAY),
            Feature("x_ref_rate", _REFERENCE.diff(TIME), -_SWAY * _SWAY_RATE, _SWAY * _SWAY_RATE),
        ),
        reward=ALTITUDE_REWARD * sp.exp(-((x - _REFERENCE) ** 2)),
        nominal=rotor_laws(x_ref, x_ref_rate),
        starts={
            "spread": start_at(
                {
                    z: around((low + high) / 2, (high - low) / 8, height),
                    zdot: around(0.0, 0.5, climb),
                    psi: around(0.0, 0.5, heading),
                },
                spread,
            )
        },
        gains=((2.0, 8.0), (2.0, 8.0), (3.0, 12.0)),
        backup=BackupFunction(
            levelling_backup, {"middle": (low + high) / 2, "reach": (high - low) / 2, "tilt": angle}
        ),
    )


class QuadrotorLimits(SystemEnv):
    """A quadrotor is to stay between a floor and a ceiling, and its tilt below a limit.

    ## Description
    The quadrotor follows an altitude that leaves the band at both ends, and sways from side to side
    faster than the tilt limit allows. Thrust serves the floor and the ceiling, and torques serve
    the tilt; both come from the same four rotors, within their speed limits.

    ## Equations
    The equations and the parameters are those of `Quadrotor`.

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `x`, `y` | horizontal position | m | [-5, 5] |
    | `z` | altitude | m | [0, 10] |
    | `xdot`, `ydot`, `zdot` | velocity | m/s | [-10, 10] |
    | `phi`, `theta` | roll, pitch | rad | [-pi/3, pi/3] |
    | `psi` | yaw | rad | unbounded |
    | `phidot`, `thetadot`, `psidot` | rates | rad/s | [-15, 15] |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `rotor_1` to `rotor_4` | squared rotor speeds | rad^2/s^2 | [0, 1e5], twice the hover |

    ## Observation
    The states, in order, without psi; then $cos(psi)$, $sin(psi)$, $z_ref = 5 + 2.5 sin(t)$ and its
    rate, $x_ref = 2 sin(1.5 t)$ and its rate.

    ## Barrier
    | name | h | relative degree | gains |
    |---|---|---|---|
    | `floor` | $z - z_min$, $z_min = 3$ m | 2 | 2, 8 |
    | `ceiling` | $z_max - z$, $z_max = 7$ m | 2 | 2, 8 |
    | `tilt` | $cos(phi) cos(theta) - cos(a)$, $a = .5$ rad | 2 | 3, 12 |

    The angle between the thrust and the vertical is to stay below $a$. In level flight no torque
    acts on the second derivative of the last barrier: the condition can be met there only if
    $phidot^2 + thetadot^2 <= p_1 p_2 (1 - cos(a))$, so a limit below about .3 rad needs larger
    gains. Default filter: `hocbf`.

    ## Noise
    `sigma_x`, `sigma_y`, `sigma_z` of the accelerations in m/s/sqrt(s), all 0.

    ## Mismatch
    None: plant and model have $m = .6$ kg. The difficulty is the number of barriers and inputs.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: position with a standard
    deviation of .05 m, roll and pitch with .01 rad, yaw with .02 rad, modulo 2 pi, and the
    three rates of turn with .02 rad/s. Velocities are not measured.

    ## Backup
    `level out`: torques bring roll and pitch back to 0, and the thrust brakes to a hover in the
    middle of the band. Its terminal set is proved for the numbers of the problem when a filter is
    made. The horizontal drift of the vehicle in the meantime is not part of it.

    ## Reward
    $$exp(-(z - z_ref)^2 - (x - x_ref)^2)$$

    at each step, in (0, 1].

    ## Nominal controller
    That of `Quadrotor`, with $x_ref$ in place of 0.

    ## Start
    `spread`: z uniform in the middle quarter of the band, zdot within .5 m/s of 0, psi within .5
    rad of 0, all else 0.

    ## Episode end
    Terminated outside the workspace, truncated after 30 s = 600 steps.

    ## Arguments
    `floor=3.0`, `ceiling=7.0` in m, within $(0, 10)$; `tilt=0.5` in rad, within $(0, pi/3)$. For
    all others see `SystemEnv`.

    ## Source
    The vehicle of thesis Sec. 3.5.2, Eq. (3.29), (3.30). Barriers and task are not from the thesis.
    """

    problem_factory = staticmethod(quadrotor_limits)
