"""Altitude of a quadrotor that is to stay in a band, and what the full quadrotor shares with it."""

from __future__ import annotations

from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.registered import SystemEnv
from safe_envs.problem.backup import Backup, BackupFunction, BackupLaw
from safe_envs.problem.measurement import Channel
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import TIME, Feature, Variable
from safe_envs.problem.starts import SamplingDomain, Start
from safe_envs.systems.common import positive, uniform_box
from safe_envs.text import finite_number

z, zdot, phi, theta = sp.symbols("z zdot phi theta", real=True)
U_1 = sp.Symbol("U_1", real=True)
m, g, sigma_z = sp.symbols("m g sigma_z", real=True)
z_ref, z_ref_rate = sp.symbols("z_ref z_ref_rate", real=True)

PLANT_MASS = 0.6
MODEL_MASS = 0.4
GRAVITY = 9.81

_MOST_THRUST = 12.0
_REFERENCE = sp.Add(5, sp.Rational(5, 2) * sp.sin(TIME))

HEIGHT = (Variable(z, 0.0, 10.0, "m"), Variable(zdot, -10.0, 10.0, "m/s"))
"""Range of the altitude and of its rate."""

ALTITUDE_REWARD = sp.exp(-((z - _REFERENCE) ** 2))
"""Reward of a step for the altitude, in (0, 1]."""

FOLLOWED = (
    Feature("z_ref", _REFERENCE, 2.5, 7.5),
    Feature("z_ref_rate", _REFERENCE.diff(TIME), -2.5, 2.5),
)
"""The reference altitude, and its rate."""


def climb_per_thrust() -> sp.Expr:
    """Return the vertical acceleration per newton of thrust in thesis Eq. (3.29) and (3.31)."""
    return sp.cos(phi) * sp.cos(theta) / m


def altitude(mass: float) -> ControlAffineSDE:
    """Return the altitude in level flight: dz = zdot dt, dzdot = (-g + U_1/m) dt + sigma_z dW.

    Source: thesis Eq. (3.31) with phi = theta = 0.
    """
    return ControlAffineSDE(
        states=(z, zdot),
        inputs=(U_1,),
        drift=[zdot, -g],
        input_matrix=[0, climb_per_thrust().subs({phi: 0, theta: 0})],
        diffusion=[0, sigma_z],
        parameters={m: mass, g: GRAVITY, sigma_z: 0.0},
    )


def thrust_law() -> sp.Expr:
    """Return the PD law on the altitude with gravity compensated: m (g + 6 e + 4 edot)."""
    return m * (g + 6 * (z_ref - z) + 4 * (z_ref_rate - zdot))


def band(center: float, half_width: float) -> Barrier:
    """Return the barrier h = 1 - ((z - c)/p)^4.

    Args:
        center: c, in m.
        half_width: p, in m.

    Source: thesis Eq. (3.32).
    """
    return Barrier(
        1 - ((z - finite_number("center", center)) / positive("half_width", half_width)) ** 4
    )


def altitude_problem(
    name: str, *, reward: sp.Expr = ALTITUDE_REWARD, gains: Any = (2.0, 8.0), **rest: Any
) -> SafetyProblem:
    """Build what all quadrotors share: the task, the timing and the gains.

    Args:
        name: of the problem.
        reward: of a step.
        gains: rates of the conditions, in 1/s.
        **rest: other attributes of `SafetyProblem`.
    """
    return SafetyProblem(
        name=name, reward=reward, dt=0.05, horizon=30.0, gains=gains, filter="hocbf", **rest
    )


def hovering_backup(problem: SafetyProblem, middle: float, reach: float) -> Backup:
    """Return the backup of braking to a hover in level flight.

    Args:
        problem: with altitude and climb rate as its states and the thrust as its input.
        middle: of the band, in m.
        reach: from there to its ends, in m.
    """
    slower = min(1.0, 0.05 / problem.dt)
    wanted = -1.5 * sp.tanh(slower * (z - middle) / 1.5)
    hover = BackupLaw(
        "hover",
        (m * (g + 7 * slower * (wanted - zdot)),),
        equilibrium={z: middle, zdot: 0},
        extent={z: reach, zdot: 1.0},
    )
    return Backup((hover,), 2.0 / slower)


CLIMB_RATES = (-5.0, 5.0)
"""Where a climb rate is explored, in m/s."""


def quadrotor_altitude(*, center: float = 5.0, half_width: float = 2.0) -> SafetyProblem:
    """Build the problem of the altitude alone, with a mass that the designer underestimates.

    Args:
        center: c, the middle of the safe band, in m.
        half_width: p, from the middle of the band to its edges, in m.

    Source: thesis Sec. 3.5.2, Eq. (3.31), (3.32).
    """
    return altitude_problem(
        "QuadrotorAltitude",
        plant=altitude(PLANT_MASS),
        model=altitude(MODEL_MASS),
        barriers=(band(center, half_width),),
        states=HEIGHT,
        inputs=(Variable(U_1, 0.0, _MOST_THRUST, "N"),),
        features=(*(Feature(s.symbol.name, s.symbol, s.low, s.high) for s in HEIGHT), *FOLLOWED),
        sensors=(Channel("z", z, 0.05),),
        nominal=(thrust_law(),),
        starts={"spread": uniform_box((5.0, 0.0), (0.5, 0.5)), "thesis": Start.at((5.0, 0.0))},
        noise=("sigma_z",),
        plane=("z", "zdot"),
        scene="altitude",
        sampling=SamplingDomain(region=((center - half_width, center + half_width), CLIMB_RATES)),
        backup=BackupFunction(
            hovering_backup, {"middle": float(center), "reach": float(half_width)}
        ),
    )


class QuadrotorAltitude(SystemEnv):
    """The altitude of a quadrotor, heavier than its designer believes, is to stay in a band.

    ## Description
    A quadrotor in level flight follows a sinusoidal altitude that leaves the safe band at both
    ends.

    ## Equations
        dz = zdot dt
        dzdot = (-g + U_1/m) dt + sigma_z dW

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `z` | altitude | m | [0, 10] |
    | `zdot` | climb rate | m/s | [-10, 10] |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `U_1` | thrust | N | [0, 12], twice the plant's weight (assumed) |

    ## Observation
    $z$, $zdot$, the reference $z_ref = 5 + 2.5 sin(t)$ at the time t of the observation, and the
    rate of the reference.

    ## Barrier
    $$h = 1 - ((z - c)/p)^4$$

    with $c = 5$ m and $p = 2$ m, of relative degree 2. The input does not act on $h$ at $z = c$,
    where it is not needed. Gains 2 and 8. Default filter: `hocbf`.

    ## Noise
    `sigma_z` of the acceleration in m/s/sqrt(s), 0.

    ## Mismatch
    The plant has $m = .6$ kg, the model $m = .4$ kg: the designer expects one and a half times the
    acceleration that the thrust gives.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: the altitude with a
    standard deviation of .05 m. The vertical speed is not measured.

    ## Backup
    `hover`: thrust brakes to a hover in the middle of the band. Its terminal set is proved for the
    numbers of the problem when a filter is made: for the plant, with knowledge of the plant.

    ## Reward
    $$exp(-(z - z_ref)^2)$$

    at each step, in (0, 1].

    ## Nominal controller
    $$U_1 = m (g + 6 e + 4 edot)$$

    with $e = z_ref - z$ and the model's mass. The thesis mentions a PID controller without its
    gains.

    ## Start
    `spread`: z uniform within .5 m of 5 m, $zdot$ within .5 m/s of 0. `thesis`: $(5, 0)$.

    ## Episode end
    Terminated outside the workspace, truncated after 30 s = 600 steps.

    ## Arguments
    `barrier={"center": 5.0, "half_width": 2.0}`, c and p in m; for all others see `SystemEnv`.

    ## Source
    Thesis Sec. 3.5.2, Eq. (3.31) with $phi = theta = 0$, (3.32). Eq. (3.33) has wrong signs in two
    Lie derivatives of $h$, and $zdot$ in place of its square; nothing here depends on it.
    """

    problem_factory = staticmethod(quadrotor_altitude)
