"""Backup law of a car behind another: brake until it is no faster, then keep the speed.

**Law.** Let w = v - v_f be the closing speed and F_r the drag, a polynomial of the speed v >= 0
without falling terms; other numbers are refused. The law asks for the acceleration min(0, (v* -
v)/dt), u = F_r(v) + M min(0, (v* - v)/dt), and is clipped to the force -F at most. v* is so far
below v_f that it brakes fully where w > 0.

**Terminal set.** Let a_1 = (F + F_r(v_f))/M and a = (F + F_r(v_f - a_1 dt))/M, which full braking
from w > 0 exceeds during a period. With h the distance to what is unsafe, h = z - D or h = z - tau
v, and w' = w - tau a (tau = 0 for a fixed distance D), a period of the law keeps

    b = h - max(w', 0)^2/(2 a) >= 0.

*Proof.* Let w > 0. All four stages of the integrator brake by a at least, so that w falls by a dt
or more, and the weighted mean of the closing speeds of the stages is at most w - a dt/2. Hence h
changes by at least -w dt + a dt^2/2 + tau a dt = -w' dt + a dt^2/2. If w' >= a dt, b does not
decrease, for (w' - a dt)^2/(2 a) = w'^2/(2 a) - w' dt + a dt^2/2. If 0 < w' < a dt, the new h is at
least w'^2/(2 a) - w' dt + a dt^2/2 = (w' - a dt)^2/(2 a) >= 0, and the new w' <= 0. If w' <= 0, h
grows and w' stays <= 0. Let now w <= 0: the input takes the drag off exactly at first, and as v
falls the drag falls by less than what the law brakes; so v does not grow, w stays <= 0 and h does
not fall. QED

It takes that v stays >= 0, and that a period changes the drag by less than what changes it, dt
F_r'(v) <= M: both are parts of the terminal set, and stay true in it.

As the drag grows with the speed the true stopping distance is shorter; the horizon, within which
the law may reach the set, regains that. Noise is left out: with it no law keeps a distance for
certain.

**Law.** Thrust, with the weight and the tilt taken into account, gives the acceleration k_2 (v_w -
zdot) with the wanted climb rate v_w = -v_m tanh(k_1 (z - z_m)/v_m). Torques give the angular
accelerations -k_3 phi - k_4 phidot and the like, less the products of the rates, and damp the yaw.
What a torque needs of the rotors is bounded smoothly by a share of their range, and the lift leaves
room for it at both ends: so no rotor is clipped, and levelling out goes before climbing. Where the
vehicle drifts to is not part of it.

The terminal set is derived and proved for the numbers of the problem: see
`safe_envs.proofs.backup_sets`. Attitude and altitude form blocks; x, y and the heading are left
out, for nothing depends on them.

**The circle of a held turn.** Under a constant turn rate w the heading of the env's integrator is
exact, and its four stages make a step of h seconds one of length s = v h (2 + cos(w h/2))/3, along
the heading at its middle: Simpson's rule for the integral of (cos, sin). So the vehicle moves along
chords of equal length, each turned by w h against the last: on a circle of radius

    R = s / (2 sin(w h/2)),    with its centre at (x, y) + R (-sin(theta), cos(theta))  for w > 0,

for the first chord makes the angle w h/2 with the tangent theta. R > v/w, the radius of the exact
arc, by one part in 180/(w h/2)^4; so the exact arc from the same state lies within R of the same
centre too, as does all that is between. Turning for good keeps every state whose circle fits:

    sqrt(x_c^2 + y_c^2) + R <= r.

**What no law betters.** Let h -> 0, R = v/w and 2 R <= r. Where the heading points outwards, the
distance from the centre of the disk grows until the heading is tangential. Of all laws the tightest
turn brings that about first, at the farthest point of its circle: the circle of one of both turns
has to fit, or the vehicle leaves. Where the heading points inwards, driving straight leads to a
point of closest approach, where a circle fits. Hence the kernel is

    {a circle fits} united with {the heading points inwards}.

The laws here turn at full rate where the circle fits and straight on towards that point before.
Held inputs decide a period late: they lose a seam at the edge, of about v h.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.backup import Backup, BackupLaw
from safe_envs.systems.quadrotor import (
    MIXING,
    I_x,
    I_y,
    I_z,
    ell,
    k_d,
    k_t,
    phidot,
    psidot,
    thetadot,
)
from safe_envs.systems.quadrotor_altitude import g, m, phi, theta, z, zdot

_REACH = 1.05
"""By how much v* is lower than what full braking at w > 0 needs."""
_BRAKING_HORIZON = 3.0


def braking_backup(
    problem: Any,
    *,
    speed: sp.Symbol,
    lead: sp.Symbol,
    distance: sp.Expr,
    headway: float,
    drag: Callable[[Any], Any],
    mass: sp.Symbol,
) -> Backup:
    """Return the backup of braking.

    Args:
        problem: a `SafetyProblem` with one force as its input.
        speed: v, in m/s.
        lead: v_f, a state or a parameter.
        distance: h, in m, of relative degree 1 with a headway and 2 without.
        headway: tau in h = z - tau v, in s; 0 for h = z - D.
        drag: F_r of a speed, in N.
        mass: M, in kg.

    Raises:
        ConfigurationError: the proof does not hold for these numbers.
    """
    for system in (problem.plant, problem.model):
        _require_assumptions(problem, system, drag, mass)
    force = -problem.input_bounds[0][0]
    if force <= 0.0:
        return Backup((BackupLaw("brake", (sp.Integer(0),), sp.Integer(-1)),), _BRAKING_HORIZON)
    most = (force + drag(lead)) / mass
    slowest = sp.Max(0, lead - most * problem.dt)
    a = (force + drag(slowest)) / mass
    wanted = lead - _REACH * most * problem.dt
    slowdown = sp.Min(0, (wanted - speed) / problem.dt)
    late = sp.Max(0, speed - lead - headway * a)
    return Backup(
        (
            BackupLaw(
                "brake",
                (drag(speed) + mass * slowdown,),
                sp.Min(
                    distance - late**2 / (2 * a),
                    speed,
                    lead - 2 * most * problem.dt,
                    mass / problem.dt - sp.diff(drag(speed), speed),
                ),
            ),
        ),
        _BRAKING_HORIZON,
    )


def _require_assumptions(
    problem: Any, system: ControlAffineSDE, drag: Callable[[Any], Any], mass: sp.Symbol
) -> None:
    """Raise ConfigurationError where the proof does not hold for the numbers of a system."""
    speed = sp.Dummy("v", nonnegative=True)
    *rising, at_rest = sp.Poly(system.numeric(drag(speed)), speed).all_coeffs()
    low, high = problem.input_bounds[0]
    for fits, what in (
        (float(system.numeric(mass)) > 0.0, "a positive mass"),
        (all(c >= 0.0 for c in rising), "a drag without terms that fall with the speed"),
        (low >= 0.0 or at_rest > low, "a drag at rest above the lower bound of the force"),
        (high >= at_rest, "an upper bound of the force that is no less than the drag at rest"),
    ):
        if not fits:
            raise ConfigurationError(
                f"the backup of {problem.name} needs {what}, for else its terminal set is not kept:"
                f" given {system.parameter_values} and a force in [{low:g}, {high:g}]; take other"
                " numbers or another filter"
            )


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
_LEVELLING_HORIZON = 2.0


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
    low, high = max(b[0] for b in problem.input_bounds), min(b[1] for b in problem.input_bounds)
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
        _LEVELLING_HORIZON / slower,
    )


def _of_rotors(roll: Any, pitch: Any, yaw: Any) -> list[Any]:
    """Return what the rotors add for torques, given by what a rotor of each has to add."""
    signs = MIXING.subs({k_t: 1, k_d: 1})
    return [signs[1, i] * roll + signs[2, i] * pitch + signs[3, i] * yaw for i in range(signs.cols)]


_SHARPNESS = 50.0
_ROUNDING = 1e-9
"""Part of the radius by which circles are to fit: turning for hours moves them by less."""


def circle_radius(speed: Any, rate: float, step: float) -> Any:
    """Return the radius of the circle that a held turn makes, in m.

    Args:
        speed: v, in m/s.
        rate: w, in rad/s; |w| step < 2 pi.
        step: of the integration, in s.
    """
    half = 0.5 * abs(rate) * step
    return speed * step * (2 + math.cos(half)) / (6 * math.sin(half))


def turning_backup(problem: Any, speed: sp.Symbol, radius: float) -> Backup:
    """Return the backup of turning left or right in a disk around the origin.

    Args:
        problem: a `SafetyProblem` with states x, y and heading, and the turn rate as its input.
        speed: symbol of v.
        radius: of the disk, in m.
    """
    x, y, theta = problem.plant.states
    step = problem.dt / problem.substeps
    laws = []
    for name, rate in zip(("right", "left"), problem.input_bounds[0], strict=True):
        side = 1 if name == "left" else -1
        if not 0.0 < side * rate < math.pi / step:
            continue
        circle = circle_radius(speed, rate, step)
        center = x - side * circle * sp.sin(theta), y + side * circle * sp.cos(theta)
        reach = sp.Abs(circle) + sp.sqrt(center[0] ** 2 + center[1] ** 2)
        fits = radius * (1 - _ROUNDING) - reach
        turn = sp.Max(0, sp.Min(1, 1 + _SHARPNESS * fits / radius))
        laws.append(BackupLaw(name, (rate * turn,), fits))
    if not laws:
        laws = [BackupLaw("straight", (sp.Integer(0),), sp.Integer(-1))]
    crossing = 2.0 * radius / max(abs(problem.plant.parameters[speed]), 1e-9)
    return Backup(tuple(laws), crossing)
