"""Backup law of a quadrotor: level out, and brake to a hover in the middle of the safe band.

**Law.** Thrust over weight in the direction of gravity gives the acceleration k_2 (v_w - zdot) with the
wanted climb rate v_w = -v_m tanh(k_1 (z - z_m)/v_m); torques give the angular accelerations
-k_3 phi - k_4 phidot and the like, with the products of the rates taken off, and damp the yaw. What a
torque needs of the rotors is bounded smoothly by a share of their range, and the lift leaves room for
it at both ends: so no rotor is clipped, and levelling out goes before climbing. Where the vehicle drifts
to is not part of it.

The terminal set is derived and proved for the numbers of the problem: see
`safe_envs.wrappers.backup_sets`. Attitude and altitude form blocks; x, y and the heading are left
out, for nothing depends on them.
"""

from __future__ import annotations

from typing import Any

import sympy as sp

from safe_envs.problem.backup import Backup, BackupLaw
from safe_envs.systems.quadrotor import (
    MIXING,
    I_x,
    I_y,
    I_z,
    ell,
    k_d,
    k_t,
    phi,
    phidot,
    psidot,
    theta,
    thetadot,
    z,
    zdot,
)
from safe_envs.systems.quadrotor_altitude import g, m

_LEVEL = (100.0, 16.0)
"""k_3 in 1/s^2 and k_4 in 1/s."""
_CLIMB = (1.0, 7.0)
"""k_1 and k_2, in 1/s."""
_YAW = 4.0
"""Damping of the yaw, in 1/s."""
_FASTEST_CLIMB = 1.5
"""v_m, in m/s."""
_SHARES = (0.45, 0.04)
"""Of the rotors' range, for roll and pitch and for yaw."""
_LONGEST_PERIOD = 0.05
"""Control period in s up to which the gains hold; longer ones lower them."""
_HORIZON = 2.0


def climb_rate_wanted(middle: float, slower: float) -> sp.Expr:
    """Return v_w.

    Args:
        middle: z_m, in m.
        slower: factor of the gain, 1 for short control periods.
    """
    return -_FASTEST_CLIMB * sp.tanh(slower * _CLIMB[0] * (z - middle) / _FASTEST_CLIMB)


def slowed(dt: float) -> float:
    """Return the factor by which gains in 1/s are lowered for a long control period.

    Args:
        dt: control period in s.
    """
    return min(1.0, _LONGEST_PERIOD / dt)


def climb_wanted(middle: float, slower: float) -> sp.Expr:
    """Return the wanted vertical acceleration k_2 (v_w - zdot).

    Args:
        middle: z_m, in m.
        slower: see `slowed`.
    """
    return slower * _CLIMB[1] * (climb_rate_wanted(middle, slower) - zdot)


def levelling_backup(problem: Any, middle: float, reach: float, tilt: float) -> Backup:
    """Return the backup of levelling out.

    Args:
        problem: a `SafetyProblem` with the states and inputs of the quadrotor.
        middle: of the band of altitudes, in m.
        reach: from there to its ends, in m.
        tilt: largest safe angle, in rad.
    """
    low, high = max(b[0] for b in problem.box), min(b[1] for b in problem.box)
    slower = slowed(problem.dt)
    most, most_yaw = (share * (high - low) for share in _SHARES)

    def torque(angle: Any, rate: Any, inertia: Any, product: Any) -> Any:
        wanted = -(slower**2) * _LEVEL[0] * angle - slower * _LEVEL[1] * rate - product
        return most * sp.tanh(inertia / (2 * k_t * ell * most) * wanted)

    roll = torque(phi, phidot, I_x, thetadot * psidot * (I_y - I_z) / I_x)
    pitch = torque(theta, thetadot, I_y, phidot * psidot * (I_z - I_x) / I_y)
    yaw = most_yaw * sp.tanh(-slower * _YAW * I_z * psidot / (4 * k_d * most_yaw))
    room = sp.sqrt(roll**2 + pitch**2) + sp.Abs(yaw)
    asked = m * (g + climb_wanted(middle, slower)) / (sp.cos(phi) * sp.cos(theta)) / (4 * k_t)
    lift = sp.Max(low + room, sp.Min(high - room, asked))
    angle, rate = min(0.06, 0.2 * tilt), min(1.0, 3.0 * tilt)
    return Backup(
        (
            BackupLaw(
                "level out",
                tuple(lift + share for share in _of_rotors(roll, pitch, yaw)),
                equilibrium=dict.fromkeys((phi, theta, phidot, thetadot, psidot, zdot), 0.0)
                | {z: middle},
                extent={
                    **dict.fromkeys((phi, theta), angle),
                    **dict.fromkeys((phidot, thetadot), rate),
                    psidot: 0.5,
                    z: reach,
                    zdot: 1.0,
                },
            ),
        ),
        _HORIZON / slower,
    )


def _of_rotors(roll: Any, pitch: Any, yaw: Any) -> list[Any]:
    """Return what the rotors add for torques, given by what a rotor of each has to add."""
    signs = MIXING.subs({k_t: 1, k_d: 1})
    return [signs[1, i] * roll + signs[2, i] * pitch + signs[3, i] * yaw for i in range(signs.cols)]
