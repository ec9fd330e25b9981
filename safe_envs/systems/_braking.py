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
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.errors import ConfigurationError
from safe_envs.problem.backup import Backup, BackupLaw

_REACH = 1.05
"""By how much v* is lower than what full braking at w > 0 needs."""
_HORIZON = 3.0


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
    force = -problem.box[0][0]
    if force <= 0.0:
        return Backup((BackupLaw("brake", (sp.Integer(0),), sp.Integer(-1)),), _HORIZON)
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
        _HORIZON,
    )


def _require_assumptions(
    problem: Any, system: ControlAffineSDE, drag: Callable[[Any], Any], mass: sp.Symbol
) -> None:
    """Raise ConfigurationError where the proof does not hold for the numbers of a system."""
    speed = sp.Dummy("v", nonnegative=True)
    *rising, at_rest = sp.Poly(system.numeric(drag(speed)), speed).all_coeffs()
    low, high = problem.box[0]
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
