"""Adaptive cruise control with a minimum distance (ACCGap)."""

from __future__ import annotations

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.registered import SystemEnv
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.backup import BackupFunction
from safe_envs.problem.measurement import Channel
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Feature, Variable
from safe_envs.problem.starts import SamplingDomain, Start
from safe_envs.systems.acc import (
    CAR,
    LEAD_SPEED,
    M,
    cruise,
    drag,
    near_desired_speed,
    own_acceleration,
    sigma_1,
    u,
)
from safe_envs.systems.backup_laws import braking_backup
from safe_envs.systems.common import positive

v, z, v_f, sigma_2 = sp.symbols("v z v_f sigma_2", real=True)

_CLOSENESS = sp.exp(-z / 50)


def gap_system() -> ControlAffineSDE:
    """Return the car and its gap.

    dv = (-F_r(v) + u)/M dt + sigma_1 dW_1, dz = (v_f - v) dt + sigma_2 dW_2.

    Source: thesis Sec. 6.3.2.
    """
    return ControlAffineSDE(
        states=(v, z),
        inputs=(u,),
        drift=[own_acceleration(v), v_f - v],
        input_matrix=[1 / M, 0],
        diffusion=[[sigma_1, 0], [0, sigma_2]],
        parameters={**CAR, v_f: LEAD_SPEED, sigma_1: 0.5, sigma_2: 0.5},
    )


def acc_gap(
    *, distance: float = 10.0, power: int = 5, rate: float = 1.0, slack_weight: float = 2.0
) -> SafetyProblem:
    """Build the problem of following a slower car at a minimum distance.

    Args:
        distance: D, the shortest allowed gap, in m.
        power: exponent of h = (z - D)^power: odd, so that h is negative below D.
        rate: wanted decay rate of V, in 1/s.
        slack_weight: w_d of the goal, whose weight of u^2 is 2/M^2.

    Raises:
        ConfigurationError: the power is not a positive odd integer.

    Source: thesis Sec. 6.3.2.
    """
    if not isinstance(power, int) or power < 1 or power % 2 == 0:
        raise ConfigurationError(
            f"power = {shown(power)}; give an odd whole number from 1, so that h changes its sign"
            " at the distance"
        )
    gap = positive("distance", distance)
    return cruise(
        "ACCGap",
        system=gap_system(),
        speed=v,
        rate=rate,
        slack_weight=slack_weight,
        reward=near_desired_speed(v) * _CLOSENESS,
        barriers=(Barrier((z - gap) ** power),),
        states=(Variable(v, 0.0, 50.0, "m/s"), Variable(z, 0.0, 500.0, "m")),
        features=(
            Feature("v", v, 0.0, 50.0),
            Feature("z", z, 0.0, 500.0),
            Feature("closeness", _CLOSENESS, 0.0, 1.0),
        ),
        sensors=(Channel("own_speed", v, 0.1), Channel("gap", z, 0.5)),
        starts={"thesis": Start.at((10.0, 15.0))},
        dt=0.01,
        horizon=30.0,
        noise=("sigma_1", "sigma_2"),
        gains=(1.0, 1.0),
        plane=("v", "z"),
        scene="road",
        sampling=SamplingDomain(region=((8.0, 24.0), (10.0, 32.0)), inputs=((-4000.0,), (4000.0,))),
        backup=BackupFunction(
            braking_backup,
            {"speed": v, "lead": v_f, "distance": z - gap, "headway": 0.0, "drag": drag, "mass": M},
        ),
    )


class ACCGap(SystemEnv):
    """A car that wants to drive faster than the one ahead is to keep a minimum distance.

    ## Description
    The car of `ACC`, with the speed of the lead as a parameter and noise in the gap too. It starts
    5 m from the edge of the safe set.

    ## Equations
        dv = (u - F_r)/M dt + sigma_1 dW_1
        dz = (v_f - v) dt + sigma_2 dW_2

    with $F_r$ and $M$ as in `ACC` and $v_f = 20$ m/s.

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `v` | own speed | m/s | [0, 50] |
    | `z` | gap | m | [0, 500] |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `u` | force at the wheels | N | [-.3 M g, .3 M g] = [-4855.95, 4855.95] |

    ## Observation
    The states, and the closeness $exp(-z/50)$, which distinguishes small gaps where long ones also
    occur.

    ## Barrier
    $$h = (z - D)^5$$

    with $D = 10$ m, of relative degree 2 and unbounded above. Its derivatives vanish at the edge of
    the safe set, and so does all that a condition can require there; $z - D$ (`power` 1) is the
    plain alternative. Gains 1 and 1. Default filter: `scbf`.

    ## Noise
    `sigma_1` = .5 m/s/sqrt(s), `sigma_2` = .5 m/sqrt(s).

    ## Mismatch
    None.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: the own speed with a
    standard deviation of .1 m/s, and the distance with .5 m.

    ## Backup
    `brake`: full braking until the car is slower than its lead, then it keeps its speed. The
    terminal set is in closed form, without noise: with noise there is no guarantee.

    ## Reward
    $$exp(-z/50)/(1 + ((v - 22)/4)^2)$$

    at each step, in (0, 1]: other cars cut into a long gap. The first factor rewards a short gap;
    without it nothing would lead an agent to the edge of the safe set, since in the long run it
    drives as fast as the lead at any gap.

    ## Nominal controller
    Minimum-norm controller from the control Lyapunov function (CLF) $V = (v - 22)^2$: the condition
    $A V + V <= d$ at the cost $2 u^2/M^2 + 2 d^2$. The weights are not from the thesis; with them
    the car reaches the speed within the episode.

    ## Start
    `thesis`: $(10, 15)$.

    ## Episode end
    Terminated outside the workspace, hence at a crash or a stop; truncated after 30 s = 3000 steps.

    ## Arguments
    `distance=10.0` in m and `power=5`, an odd exponent, of the barrier; `rate=1.0` and
    `slack_weight=2.0` of the goal; for all others see `SystemEnv`.

    ## Source
    Thesis Sec. 6.3.2, which does not give $v_f$. Its $b_1$ lacks the noise term and its $b_2$ has
    wrong coefficients; here both are derived.
    """

    problem_factory = staticmethod(acc_gap)
