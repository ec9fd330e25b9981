"""Dubins vehicle in a disk, at a speed that its designer underestimates (DubinsDisk)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import sympy as sp

from safe_envs.dynamics.lie import lie_derivative_f
from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.registered import SystemEnv
from safe_envs.problem.backup import BackupFunction
from safe_envs.problem.frame import Frame
from safe_envs.problem.measurement import Channel
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Feature, Variable
from safe_envs.problem.starts import SamplingDomain, Start
from safe_envs.systems.backup_laws import turning_backup
from safe_envs.systems.common import in_disk, positive, uniforms

x, y, theta, omega = sp.symbols("x y theta omega", real=True)
v, sigma_1, sigma_2 = sp.symbols("v sigma_1 sigma_2", real=True)
distance, phi = sp.symbols("distance phi", real=True)
cos_theta, sin_theta = sp.symbols("cos_theta sin_theta", real=True)

_HEADING_GAIN = 2
HEADING = (
    Feature("cos_theta", sp.cos(theta), -1.0, 1.0),
    Feature("sin_theta", sp.sin(theta), -1.0, 1.0),
)

POSE_SENSORS = (
    Channel("x", x, 0.05),
    Channel("y", y, 0.05),
    Channel("theta", theta, 0.05, period=2.0 * math.pi),
)
"""A positioning system, and a compass."""
"""The heading, as it is observed."""

SHOWN: dict[str, Any] = {"noise": ("sigma_1", "sigma_2"), "plane": ("x", "y"), "scene": "top-view"}
"""Attributes of every problem with the vehicle."""

UNIFORMS = uniforms(3)
"""Of a start anywhere: area, direction and heading."""


def vehicle(speed: float, noise: float) -> ControlAffineSDE:
    """Return the vehicle.

    dx = v cos(theta) dt + sigma_1 dW_1, dy = v sin(theta) dt + sigma_2 dW_2, dtheta = omega dt.

    Args:
        speed: v, in m/s.
        noise: sigma_1 = sigma_2, in m/sqrt(s).

    Source: thesis Eq. (3.27) and Sec. 4.3.2.
    """
    return ControlAffineSDE(
        states=(x, y, theta),
        inputs=(omega,),
        drift=[v * sp.cos(theta), v * sp.sin(theta), 0],
        input_matrix=[0, 0, 1],
        diffusion=[[sigma_1, 0], [0, sigma_2], [0, 0]],
        parameters={v: speed, sigma_1: noise, sigma_2: noise},
    )


def turn_rate_towards(wanted_x: sp.Expr, wanted_y: sp.Expr) -> sp.Expr:
    """Return a law proportional to the angle from the heading to a wanted course.

    It takes cosine and sine of the heading.

    Args:
        wanted_x: x component of the course, of any length.
        wanted_y: y component of the course.
    """
    return _HEADING_GAIN * sp.atan2(
        cos_theta * wanted_y - sin_theta * wanted_x, cos_theta * wanted_x + sin_theta * wanted_y
    )


def _patrol(r: float) -> tuple[sp.Expr, sp.Expr]:
    """Return reward and turn rate for riding a circle that lies partly outside the disk."""
    # The vehicle rides counterclockwise.
    #
    # The wanted course is the circle's tangent, turned outward inside the circle and inward beyond
    # it, in proportion to the distance from it. The circle is not the edge itself: a filtered
    # vehicle would come arbitrarily near to h = 0 there, where rounding decides whether that is a
    # violation.
    radius, from_center = 0.75 * r, x - 0.5 * r
    distance = sp.sqrt(
        from_center**2 + y**2 + 1e-9 * r**2
    )  # the small term keeps the centre from a division by zero
    off = (radius - distance) / r
    course = (-y + 3 * off * from_center) / distance, (from_center + 3 * off * y) / distance
    on_circle = 1 / (1 + (2 * ((from_center**2 + y**2) / radius**2 - 1)) ** 2)
    along = (from_center * sp.sin(theta) - y * sp.cos(theta)) / radius
    return on_circle * (1 + along) / 2, v / radius + turn_rate_towards(*course)


def disk_frame(r: float) -> Frame:
    """Return distance from the centre and heading against the radius.

    A turn around the centre leaves both as they are, and the law of a step as well where the noise
    is the same in every direction.

    Args:
        r: radius of the disk, in m.
    """
    return Frame(
        coordinates=(
            Variable(distance, 0.0, 2 * r, "m"),
            Variable(phi, -math.pi, math.pi, "rad"),
        ),
        values=(sp.sqrt(x**2 + y**2), theta - sp.atan2(y, x)),
        section=(distance, sp.Integer(0), phi),
        periods=(0.0, 2 * math.pi),
    )


def disk_problem(
    name: str,
    *,
    plant: ControlAffineSDE,
    model: ControlAffineSDE,
    r: float,
    h: sp.Expr,
    starts: Mapping[str, Start],
    **rest: Any,
) -> SafetyProblem:
    """Build what the problems in a disk share.

    Args:
        name: of the problem.
        plant: the vehicle.
        model: the vehicle that the designer believes.
        r: radius of the disk, in m.
        h: the barrier.
        starts: distributions other than the uniform one.
        **rest: other attributes of `SafetyProblem`.
    """
    reward, turn_rate = _patrol(r)
    return SafetyProblem(
        name=name,
        plant=plant,
        model=model,
        barriers=(Barrier(h),),
        states=(
            Variable(x, -2 * r, 2 * r, "m"),
            Variable(y, -2 * r, 2 * r, "m"),
            Variable(theta, -math.inf, math.inf, "rad"),
        ),
        features=(Feature("x", x, -2 * r, 2 * r), Feature("y", y, -2 * r, 2 * r), *HEADING),
        sensors=POSE_SENSORS,
        reward=reward,
        nominal=(turn_rate,),
        starts={**starts, "uniform": Start(anywhere(r), UNIFORMS)},
        **SHOWN,
        sampling=SamplingDomain(region=((-r, r), (-r, r), (-math.pi, math.pi))),
        frame=disk_frame(r),
        **rest,
    )


def anywhere(r: float) -> tuple[sp.Expr, ...]:
    """Return a start with position uniform in the disk and heading uniform."""
    area, angle, heading = UNIFORMS
    return (*in_disk(r, area, angle), 2 * sp.pi * heading)


def dubins_disk(*, radius: float = 1.0) -> SafetyProblem:
    """Build the problem in the disk with a vehicle that is faster than its designer believes.

    Args:
        radius: of the safe disk, in m.

    Source: thesis Sec. 3.5.1, static case.
    """
    r = positive("radius", radius)
    plant, model = vehicle(0.8, noise=0.0), vehicle(0.5, noise=0.0)
    h = r**2 - x**2 - y**2
    gains = (1.0, 2.0)
    b_1 = plant.numeric(lie_derivative_f(plant, h)) + gains[0] * h
    return disk_problem(
        "DubinsDisk",
        plant=plant,
        model=model,
        r=r,
        h=h,
        inputs=(Variable(omega, -math.pi, math.pi, "rad/s"),),
        starts={
            "feasible": Start(anywhere(r), UNIFORMS, b_1),
            "thesis": Start.at((0.9, 0.1, 0.0)),
            "valid": Start.at((0.0, 0.1, 0.0)),
        },
        dt=0.05,
        horizon=50.0,
        gains=gains,
        filter="hocbf",
        backup=BackupFunction(turning_backup, {"speed": v, "radius": r}),
    )


class DubinsDisk(SystemEnv):
    """A vehicle at constant speed, faster than its designer believes, is to stay in a disk.

    ## Description
    The vehicle cannot stop or slow down; it can only turn. Its task is to follow a circle that lies
    partly outside the safe disk, so a policy that maximizes the reward alone leaves the disk in
    every lap.

    ## Equations
        dx = v cos(theta) dt + sigma_1 dW_1
        dy = v sin(theta) dt + sigma_2 dW_2
        dtheta = omega dt

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `x`, `y` | position | m | [-2 r, 2 r], r = 1 m |
    | `theta` | heading | rad | unbounded |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `omega` | turn rate | rad/s | [-pi, pi] (assumed) |

    ## Observation
    $x$, $y$, $cos(theta)$, $sin(theta)$.

    ## Barrier
    $$h = r^2 - x^2 - y^2$$

    of relative degree 2. Where the heading is radial, the input does not act on the second
    derivative of $h$: the condition can be met there only if $b_2 >= 0$ without it, which at the
    centre requires $p_1 p_2 >= 2 v^2/r^2$. The gains are therefore 1 and 2; those of the thesis, 1
    and 1, are too small for $v = .8$ m/s. Default filter: `hocbf`.

    ## Noise
    `sigma_1`, `sigma_2` in m/sqrt(s), both 0: the system is deterministic.

    ## Mismatch
    The plant has $v = .8$ m/s, the model $v = .5$ m/s. With a filter that uses the model, $h$
    settles near $-2 v_model (v_plant - v_model)/(p_1 p_2) = -.15$ m^2.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: position with a standard
    deviation of .05 m and heading with .05 rad, known modulo 2 pi.

    ## Backup
    `left` and `right`: drive straight on until the circle of the tightest turn fits into the disk,
    then turn at the full rate. The terminal set is in closed form. With noise there is no
    guarantee, and none with knowledge of the model alone: its turning circles are smaller than the
    plant's, and every episode ends unsafe. Use `knowledge="plant"`, or a model with the plant's
    speed.

    ## Reward
    $$(1 + d/R cos(a))/2 / (1 + 4 (d^2/R^2 - 1)^2)$$

    at each step, at most about 1, where $d$ is the distance from $(.5 r, 0)$, $R = .75 r$, and $a$
    the angle between the heading and the counterclockwise tangent. Without the factor with $a$,
    turning on the spot would pay. Not from the thesis.

    ## Nominal controller
    Turns towards a course that leads onto that circle and around it.

    ## Start
    `feasible`: uniform in the disk and in heading, restricted to where $b_1 > 0$ for the plant's
    default speed and the default gains, since a filter with these gains guarantees nothing
    elsewhere. `uniform`: without that restriction. `thesis`: $(.9, .1, 0)$, which lies outside the
    set $b_1 >= 0$ for all gains that the thesis tries. `valid`: $(0, .1, 0)$, which lies inside.

    ## Episode end
    Terminated outside the workspace, truncated after 50 s = 1000 steps.

    ## Arguments
    `barrier={"radius": 1.0}`, the radius r in m; for all others see `SystemEnv`.

    ## Source
    Thesis Sec. 3.5.1, static obstacle avoidance, Eq. (3.27).
    """

    problem_factory = staticmethod(dubins_disk)
