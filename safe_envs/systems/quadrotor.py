"""Quadrotor with all twelve states and four rotors, whose altitude is to stay in a band."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.registered import SystemEnv
from safe_envs.problem.measurement import Channel
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import Feature, Variable
from safe_envs.problem.starts import SamplingDomain, Start
from safe_envs.systems import quadrotor_altitude as vertical
from safe_envs.systems.common import around, uniforms
from safe_envs.systems.quadrotor_altitude import g, m, phi, sigma_z, theta, z, zdot

x, y, psi = sp.symbols("x y psi", real=True)
xdot, ydot, phidot, thetadot, psidot = sp.symbols("xdot ydot phidot thetadot psidot", real=True)
rotors = sp.symbols("rotor_1:5", real=True)
ell, I_x, I_y, I_z, k_t, k_d = sp.symbols("l I_x I_y I_z k_t k_d", real=True)
sigma_x, sigma_y = sp.symbols("sigma_x sigma_y", real=True)
cos_psi, sin_psi = sp.symbols("cos_psi sin_psi", real=True)

_AIRFRAME = {ell: 0.23, I_x: 7.5e-3, I_y: 7.5e-3, I_z: 1.3e-2, k_t: 3.13e-5, k_d: 7.5e-7}
_MOST_ROTOR = 1.0e5

LARGEST_TILT = math.pi / 3
"""Largest roll and pitch in the workspace, in rad."""

_STATES = (
    *(Variable(s, -5.0, 5.0, "m") for s in (x, y)),
    vertical.HEIGHT[0],
    *(Variable(s, -10.0, 10.0, "m/s") for s in (xdot, ydot)),
    vertical.HEIGHT[1],
    *(Variable(s, -LARGEST_TILT, LARGEST_TILT, "rad") for s in (phi, theta)),
    Variable(psi, -math.inf, math.inf, "rad"),
    *(Variable(s, -15.0, 15.0, "rad/s") for s in (phidot, thetadot, psidot)),
)

MIXING = sp.ImmutableMatrix(
    [[k_t] * 4, [0, -k_t, 0, k_t], [k_t, 0, -k_t, 0], [k_d, -k_d, k_d, -k_d]]
)
"""(U_1, U_2, U_3, U_4) = MIXING (Omega_1^2, ..., Omega_4^2). Source: thesis Eq. (3.30)."""


def quadrotor(mass: float) -> ControlAffineSDE:
    """Return the rigid body with four rotors; accelerations along x, y and z carry noise.

    The inputs are the squared speeds of the rotors, in which the system is affine.

    Source: thesis Eq. (3.29), (3.30).
    """
    drift = [
        *(xdot, ydot, zdot),
        *(0, 0, -g),
        *(phidot, thetadot, psidot),
        thetadot * psidot * (I_y - I_z) / I_x,
        phidot * psidot * (I_z - I_x) / I_y,
        phidot * thetadot * (I_x - I_y) / I_z,
    ]
    by_force = sp.zeros(12, 4)
    by_force[3, 0] = (sp.cos(phi) * sp.sin(theta) * sp.cos(psi) + sp.sin(phi) * sp.sin(psi)) / m
    by_force[4, 0] = (sp.cos(phi) * sp.sin(theta) * sp.sin(psi) - sp.sin(phi) * sp.cos(psi)) / m
    by_force[5, 0] = vertical.climb_per_thrust()
    by_force[9, 1], by_force[10, 2], by_force[11, 3] = ell / I_x, ell / I_y, 1 / I_z
    diffusion = sp.zeros(12, 3)
    diffusion[3, 0], diffusion[4, 1], diffusion[5, 2] = sigma_x, sigma_y, sigma_z
    return ControlAffineSDE(
        states=tuple(s.symbol for s in _STATES),
        inputs=rotors,
        drift=drift,
        input_matrix=by_force * MIXING,
        diffusion=diffusion,
        parameters={
            m: mass,
            g: vertical.GRAVITY,
            **_AIRFRAME,
            **dict.fromkeys((sigma_x, sigma_y, sigma_z), 0.0),
        },
    )


def rotor_laws(x_wanted: sp.Expr, x_rate_wanted: sp.Expr) -> tuple[sp.Expr, ...]:
    """Return the rotor speeds for thrust and torques, by the inverse of the mixing.

    Thrust controls the altitude; torques follow x and hold y and the heading at 0.

    The position loop asks for a horizontal acceleration, which for small tilts is g times an angle:
    that angle is what the attitude loop, about three times as fast, follows.

    Args:
        x_wanted: reference of x, in m.
        x_rate_wanted: its rate, in m/s.
    """
    push_x, push_y = x_wanted - x + 2 * (x_rate_wanted - xdot), -y - 2 * ydot
    wanted_phi = (push_x * sin_psi - push_y * cos_psi) / g
    wanted_theta = (push_x * cos_psi + push_y * sin_psi) / g
    efforts = sp.Matrix(
        [
            vertical.thrust_law(),
            I_x / ell * (36 * (wanted_phi - phi) - 12 * phidot),
            I_y / ell * (36 * (wanted_theta - theta) - 12 * thetadot),
            I_z * (-4 * sp.atan2(sin_psi, cos_psi) - 4 * psidot),
        ]
    )
    return tuple(MIXING.inv() * efforts)


def start_at(known: Mapping[sp.Symbol, Any], spread: Sequence[sp.Symbol] = ()) -> Start:
    """Return a start with some components of the state, and 0 for all others.

    Args:
        known: value or expression of each component that is not 0.
        spread: the uniforms in them.
    """
    return Start(tuple(sp.sympify(known.get(s.symbol, 0)) for s in _STATES), tuple(spread))


def rotor_problem(name: str, *, followed: Sequence[Feature] = (), **rest: Any) -> SafetyProblem:
    """Build what the problems with all twelve states share.

    Args:
        name: of the problem.
        followed: references other than the altitude's.
        **rest: see `altitude_problem`.
    """
    return vertical.altitude_problem(
        name,
        states=_STATES,
        inputs=tuple(Variable(s, 0.0, _MOST_ROTOR, "rad^2/s^2") for s in rotors),
        features=(
            *(Feature(s.symbol.name, s.symbol, s.low, s.high) for s in _STATES if s.symbol != psi),
            Feature("cos_psi", sp.cos(psi), -1.0, 1.0),
            Feature("sin_psi", sp.sin(psi), -1.0, 1.0),
            *vertical.FOLLOWED,
            *followed,
        ),
        sensors=(
            *(Channel(s.name, s, 0.05) for s in (x, y, vertical.HEIGHT[0].symbol)),
            *(Channel(s.name, s, 0.01) for s in (phi, theta)),
            Channel(psi.name, psi, 0.02, period=2.0 * math.pi),
            *(Channel(s.name, s, 0.02) for s in (phidot, thetadot, psidot)),
        ),
        noise=("sigma_x", "sigma_y", "sigma_z"),
        plane=("x", "z"),
        scene="side-view",
        **rest,
    )


def quadrotor_full(*, center: float = 5.0, half_width: float = 2.0) -> SafetyProblem:
    """Build the problem of a quadrotor that is heavier than its designer believes.

    Args:
        center: c, the middle of the safe band, in m.
        half_width: p, from the middle of the band to its edges, in m.

    Source: thesis Sec. 3.5.2, Eq. (3.29), (3.30), (3.32).
    """
    height, climb = spread = uniforms(2)
    return rotor_problem(
        "Quadrotor",
        plant=quadrotor(vertical.PLANT_MASS),
        model=quadrotor(vertical.MODEL_MASS),
        barriers=(vertical.band(center, half_width),),
        nominal=rotor_laws(sp.Integer(0), sp.Integer(0)),
        starts={
            "spread": start_at(
                {z: around(5.0, 0.5, height), zdot: around(0.0, 0.5, climb)}, spread
            ),
            "thesis": start_at({z: 5}),
        },
        sampling=SamplingDomain(
            region=tuple(
                {
                    z: (center - half_width, center + half_width),
                    zdot: vertical.CLIMB_RATES,
                    psi: (-math.pi, math.pi),
                }.get(s.symbol, (s.low, s.high))
                for s in _STATES
            ),
            coordinates=(z, zdot, phi, theta),
        ),
    )


class Quadrotor(SystemEnv):
    """The altitude of a quadrotor with all its twelve states and four rotors is to stay in a band.

    ## Description
    The task of `QuadrotorAltitude` with the full dynamics: the thrust that a filter adds is shared
    among four rotors, and acts along a body axis that tilts.

    ## Equations
        Positions and angles integrate their rates; i = 1, ..., 4, O_i = rotor_i:
        dxdot   = (cos(phi) sin(theta) cos(psi) + sin(phi) sin(psi)) U_1/m dt + sigma_x dW_1
        dydot   = (cos(phi) sin(theta) sin(psi) - sin(phi) cos(psi)) U_1/m dt + sigma_y dW_2
        dzdot   = (-g + cos(phi) cos(theta) U_1/m) dt + sigma_z dW_3
        dphidot   = (thetadot psidot (I_y - I_z)/I_x + l/I_x U_2) dt
        dthetadot = (phidot psidot (I_z - I_x)/I_y + l/I_y U_3) dt
        dpsidot   = (phidot thetadot (I_x - I_y)/I_z + 1/I_z U_4) dt
        U_1 = k_t (O_1 + O_2 + O_3 + O_4),  U_2 = k_t (O_4 - O_2),  U_3 = k_t (O_1 - O_3)
        U_4 = k_d (O_1 - O_2 + O_3 - O_4)

    where the inputs are the squares of the rotor speeds. Assumed, in the range of a small research
    quadrotor: $l = .23$ m, $I_x = I_y = .0075$ kg m^2, $I_z = .013$ kg m^2, $k_t = 3.13e-5$ N s^2,
    $k_d = 7.5e-7$ N m s^2, $g = 9.81$ m/s^2.

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
    | `rotor_1` to `rotor_4` | squared rotor speeds | rad^2/s^2 | [0, 1e5], an assumption |

    ## Observation
    The states, in order, without psi; then $cos(psi)$, $sin(psi)$, $z_ref = 5 + 2.5 sin(t)$, and
    the rate of the reference.

    ## Barrier
    $$h = 1 - ((z - c)/p)^4$$

    with $c = 5$ m and $p = 2$ m, of relative degree 2. The input does not act on $h$ at $z = c$,
    where it is not needed. Gains 2 and 8. Default filter: `hocbf`.

    ## Noise
    `sigma_x`, `sigma_y`, `sigma_z` of the accelerations in m/s/sqrt(s), all 0.

    ## Mismatch
    The plant has $m = .6$ kg, the model $m = .4$ kg.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: position with a standard
    deviation of .05 m, roll and pitch with .01 rad, yaw with .02 rad, modulo 2 pi, and the
    three rates of turn with .02 rad/s. Velocities are not measured.

    ## Reward
    $$exp(-(z - z_ref)^2)$$

    at each step, in (0, 1].

    ## Nominal controller
    $U_1$ as in `QuadrotorAltitude`; PD laws that hold x, y and psi at 0 through the roll and pitch
    angles, for the torques; and the rotor speeds by the inverse of the mixing.

    ## Start
    `spread`: z uniform within .5 m of 5 m, zdot within .5 m/s of 0, all else 0. `thesis`: z = 5 m,
    all else 0.

    ## Episode end
    Terminated outside the workspace, truncated after 30 s = 600 steps.

    ## Arguments
    `barrier={"center": 5.0, "half_width": 2.0}`, c and p in m; for all others see `SystemEnv`.

    ## Source
    Thesis Sec. 3.5.2, Eq. (3.29), (3.30), (3.32). Its experiment uses the altitude alone.
    """

    problem_factory = staticmethod(quadrotor_full)
