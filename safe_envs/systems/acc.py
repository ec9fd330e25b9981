"""Adaptive cruise control with a time headway (ACC)."""

from __future__ import annotations

from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.registered import SystemEnv
from safe_envs.problem.backup import BackupFunction
from safe_envs.problem.clf import CLF
from safe_envs.problem.measurement import Channel
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.problem.starts import SamplingDomain, Start
from safe_envs.systems.backup_laws import braking_backup
from safe_envs.systems.common import positive

u = sp.Symbol("u", real=True)
x_1, x_2, x_3 = sp.symbols("x_1 x_2 x_3", real=True)
f_0, f_1, f_2, M, sigma_1 = sp.symbols("f_0 f_1 f_2 M sigma_1", real=True)

CAR = {f_0: 0.1, f_1: 5.0, f_2: 0.25, M: 1650.0}
WEIGHT = CAR[M] * 9.81
"""M g, in N."""
_MOST_FORCE = 0.3 * WEIGHT
_DESIRED_SPEED = 22
LEAD_SPEED = 20.0


def drag(speed: sp.Expr) -> sp.Expr:
    """Return F_r = f_0 + f_1 v + f_2 v^2, in N.

    Source: thesis Sec. 4.3.1.
    """
    return f_0 + f_1 * speed + f_2 * speed**2


def own_acceleration(speed: sp.Symbol) -> sp.Expr:
    """Return -F_r/M, without engine force."""
    return -drag(speed) / M


def near_desired_speed(speed: sp.Symbol) -> sp.Expr:
    """Return 1/(1 + ((v - 22)/4)^2): 1 at the desired speed, with a slope far from it too."""
    return 1 / (1 + ((speed - _DESIRED_SPEED) / 4) ** 2)


def headway_system() -> ControlAffineSDE:
    """Return the car and its lead.

    dx_1 = (-F_r(x_1) + u)/M dt + sigma_1 dW, dx_2 = 0, dx_3 = (x_2 - x_1) dt.

    Source: thesis Sec. 4.3.1.
    """
    return ControlAffineSDE(
        states=(x_1, x_2, x_3),
        inputs=(u,),
        drift=[own_acceleration(x_1), 0, x_2 - x_1],
        input_matrix=[1 / M, 0, 0],
        diffusion=[sigma_1, 0, 0],
        parameters={**CAR, sigma_1: 1.0},
    )


def cruise(
    name: str,
    *,
    system: ControlAffineSDE,
    speed: sp.Symbol,
    rate: float,
    slack_weight: float,
    **rest: Any,
) -> SafetyProblem:
    """Build what both problems share: the bounds of the force, and the desired speed as goal.

    Args:
        name: of the problem.
        system: plant and model.
        speed: symbol of the car's speed.
        rate: wanted decay rate of V, in 1/s.
        slack_weight: w_d of the goal, whose weight of u^2 is 2/M^2.
        **rest: other attributes of `SafetyProblem`.
    """
    clf = CLF(
        (speed - _DESIRED_SPEED) ** 2,
        rate,
        input_weight=2 / M**2,
        slack_weight=positive("slack_weight", slack_weight),
    )
    return SafetyProblem(
        name=name,
        plant=system,
        model=system,
        inputs=(Variable(u, -_MOST_FORCE, _MOST_FORCE, "N"),),
        nominal=clf.min_norm(system),
        clf=clf,
        filter="scbf",
        **rest,
    )


def acc(*, tau: float = 1.8, rate: float = 5.0, slack_weight: float = 0.02) -> SafetyProblem:
    """Build the problem of following a slower car at a time headway.

    Args:
        tau: shortest allowed headway, in s.
        rate: wanted decay rate of V, in 1/s.
        slack_weight: w_d of the goal, whose weight of u^2 is 2/M^2.

    Source: thesis Sec. 4.3.1.
    """
    headway = positive("tau", tau)
    return cruise(
        "ACC",
        system=headway_system(),
        speed=x_1,
        rate=rate,
        slack_weight=slack_weight,
        reward=near_desired_speed(x_1),
        barriers=(Barrier(x_3 - headway * x_1),),
        states=(
            Variable(x_1, 0.0, 50.0, "m/s"),
            Variable(x_2, 0.0, 50.0, "m/s"),
            Variable(x_3, 0.0, 1000.0, "m"),
        ),
        sensors=(
            Channel("own_speed", x_1, 0.1),
            Channel("relative_speed", x_2 - x_1, 0.25),
            Channel("gap", x_3, 0.5),
        ),
        starts={"thesis": Start.at((15.0, LEAD_SPEED, 150.0))},
        dt=0.05,
        horizon=100.0,
        noise=("sigma_1",),
        gains=(1.0,),
        plane=("x_1", "x_3"),
        scene="road",
        sampling=SamplingDomain(
            region=((10.0, 25.0), (15.0, 25.0), (20.0, 200.0)), inputs=((-4000.0,), (4000.0,))
        ),
        backup=BackupFunction(
            braking_backup,
            {
                "speed": x_1,
                "lead": x_2,
                "distance": x_3 - headway * x_1,
                "headway": headway,
                "drag": drag,
                "mass": M,
            },
        ),
    )


class ACC(SystemEnv):
    """A car that wants to drive faster than the one ahead is to keep a time headway.

    ## Description
    The lead drives at 20 m/s and the desired speed is 22 m/s: the gap grows while the car
    accelerates, then closes, and the car has to give up the desired speed.

    ## Equations
        dx_1 = (u - F_r)/M dt + sigma_1 dW
        dx_2 = 0
        dx_3 = (x_2 - x_1) dt

    with the drag $F_r = f_0 + f_1 x_1 + f_2 x_1^2$, $f_0 = .1$ N, $f_1 = 5$ N s/m, $f_2 = .25$ N
    s^2/m^2, and the mass $M = 1650$ kg.

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `x_1` | own speed | m/s | [0, 50] |
    | `x_2` | speed of the lead | m/s | [0, 50] |
    | `x_3` | gap | m | [0, 1000] |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `u` | force at the wheels | N | [-.3 M g, .3 M g] = [-4855.95, 4855.95] |

    ## Observation
    The states.

    ## Barrier
    $$h = x_3 - tau x_1$$

    with $tau = 1.8$ s, of relative degree 1. It is unbounded above, so $h/sup h$ gives no bound on
    the probability of staying safe. Gain 1. Default filter: `scbf`.

    ## Noise
    `sigma_1` = 1 m/s/sqrt(s). Only this channel of the three-dimensional Wiener process in the
    thesis acts.

    ## Mismatch
    None.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: a radar: the relative
    speed $x_2 - x_1$ with a standard deviation of .25 m/s, and the gap with .5 m; the own speed
    with .1 m/s.

    ## Backup
    `brake`: full braking until the car is slower than its lead, then it keeps its speed. The
    terminal set is in closed form, without noise: with noise there is no guarantee.

    ## Reward
    $$1/(1 + ((x_1 - 22)/4)^2)$$

    at each step, in (0, 1].

    ## Nominal controller
    Minimum-norm controller from the control Lyapunov function (CLF) $V = (x_1 - 22)^2$: the
    condition $A V + 5 V <= d$ at the cost $2 u^2/M^2 + .02 d^2$. With the weights and the condition
    of the thesis (1/2 each, $A V <= d$) u stays near 0.

    ## Start
    `thesis`: $(15, 20, 150)$.

    ## Episode end
    Terminated outside the workspace, hence at a crash or a stop; truncated after 100 s = 2000
    steps.

    ## Arguments
    `tau=1.8`, the headway in s; `rate=5.0` and `slack_weight=0.02` of the goal; for all others see
    `SystemEnv`.

    ## Source
    Thesis Sec. 4.3.1. It does not give tau, and its trace in the generator of V has the two factors
    of the diffusion in the wrong order.
    """

    problem_factory = staticmethod(acc)
