"""Backup laws of a vehicle in a disk: turn left, or right, on a circle that fits into the disk.

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
from typing import Any

import sympy as sp

from safe_envs.problem.backup import Backup, BackupLaw

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
    for name, rate in zip(("right", "left"), problem.box[0], strict=True):
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
