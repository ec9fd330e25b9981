"""Adaptive cruise control: with a time headway (ACC) and with a minimum distance (ACCGap)."""

from __future__ import annotations

from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.env import SystemEnv
from safe_envs.errors import ConfigurationError, shown
from safe_envs.problem.barrier import Barrier
from safe_envs.problem.clf import CLF
from safe_envs.problem.initial_distribution import Start
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.sampling_domain import SamplingDomain
from safe_envs.problem.signals import Feature, Variable
from safe_envs.systems._common import positive

u = sp.Symbol("u", real=True)
x_1, x_2, x_3 = sp.symbols("x_1 x_2 x_3", real=True)
v, z, v_f = sp.symbols("v z v_f", real=True)
f_0, f_1, f_2, M, sigma_1, sigma_2 = sp.symbols("f_0 f_1 f_2 M sigma_1 sigma_2", real=True)

_CAR = {f_0: 0.1, f_1: 5.0, f_2: 0.25, M: 1650.0}
WEIGHT = _CAR[M] * 9.81
"""M g, in N."""
_MOST_FORCE = 0.3 * WEIGHT
_DESIRED_SPEED = 22
_LEAD_SPEED = 20.0
_CLOSENESS = sp.exp(-z / 50)


def own_acceleration(speed: sp.Symbol) -> sp.Expr:
    """-F_r/M without any force of the engine, with the drag F_r = f_0 + f_1 v + f_2 v^2.

    Source: thesis Sec. 4.3.1.
    """
    return -(f_0 + f_1 * speed + f_2 * speed**2) / M


def near_desired_speed(speed: sp.Symbol) -> sp.Expr:
    """1/(1 + ((v - 22)/4)^2): 1 at the desired speed, with a slope that is felt from far away."""
    return 1 / (1 + ((speed - _DESIRED_SPEED) / 4) ** 2)


def headway_system() -> ControlAffineSDE:
    """The car and its lead: dx_1 = (-F_r(x_1) + u)/M dt + sigma_1 dW, dx_2 = 0, dx_3 = (x_2 - x_1)
    dt.

    Source: thesis Sec. 4.3.1.
    """
    return ControlAffineSDE(
        states=(x_1, x_2, x_3),
        inputs=(u,),
        drift=[own_acceleration(x_1), 0, x_2 - x_1],
        input_matrix=[1 / M, 0, 0],
        diffusion=[sigma_1, 0, 0],
        parameters={**_CAR, sigma_1: 1.0},
    )


def gap_system() -> ControlAffineSDE:
    """The car and its gap: dv = (-F_r(v) + u)/M dt + sigma_1 dW_1, dz = (v_f - v) dt + sigma_2
    dW_2.

    Source: thesis Sec. 6.3.2.
    """
    return ControlAffineSDE(
        states=(v, z),
        inputs=(u,),
        drift=[own_acceleration(v), v_f - v],
        input_matrix=[1 / M, 0],
        diffusion=[[sigma_1, 0], [0, sigma_2]],
        parameters={**_CAR, v_f: _LEAD_SPEED, sigma_1: 0.5, sigma_2: 0.5},
    )


def _cruise(
    name: str,
    *,
    system: ControlAffineSDE,
    speed: sp.Symbol,
    rate: float,
    slack_weight: float,
    **rest: Any,
) -> SafetyProblem:
    """What both problems have in common: the force's box, and the goal of driving at the desired
    speed."""
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
    """Following a slower car at a time headway.

    Args:
        tau: shortest allowed headway, in s.
        rate: wanted decay rate of V, in 1/s.
        slack_weight: w_d of the goal, whose weight of u^2 is 2/M^2.

    Source: thesis Sec. 4.3.1.
    """
    return _cruise(
        "ACC",
        system=headway_system(),
        speed=x_1,
        rate=rate,
        slack_weight=slack_weight,
        reward=near_desired_speed(x_1),
        barriers=(Barrier(x_3 - positive("tau", tau) * x_1),),
        states=(
            Variable(x_1, 0.0, 50.0, "m/s"),
            Variable(x_2, 0.0, 50.0, "m/s"),
            Variable(x_3, 0.0, 1000.0, "m"),
        ),
        starts={"thesis": Start.at((15.0, _LEAD_SPEED, 150.0))},
        dt=0.05,
        horizon=100.0,
        noise=("sigma_1",),
        gains=(1.0,),
        plane=("x_1", "x_3"),
        scene="road",
        explored=SamplingDomain(
            region=((10.0, 25.0), (15.0, 25.0), (20.0, 200.0)), inputs=((-4000.0,), (4000.0,))
        ),
    )


def acc_gap(
    *, distance: float = 10.0, power: int = 5, rate: float = 1.0, slack_weight: float = 2.0
) -> SafetyProblem:
    """Following a slower car at a minimum distance.

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
    return _cruise(
        "ACCGap",
        system=gap_system(),
        speed=v,
        rate=rate,
        slack_weight=slack_weight,
        reward=near_desired_speed(v) * _CLOSENESS,
        barriers=(Barrier((z - positive("distance", distance)) ** power),),
        states=(Variable(v, 0.0, 50.0, "m/s"), Variable(z, 0.0, 500.0, "m")),
        features=(
            Feature("v", v, 0.0, 50.0),
            Feature("z", z, 0.0, 500.0),
            Feature("closeness", _CLOSENESS, 0.0, 1.0),
        ),
        starts={"thesis": Start.at((10.0, 15.0))},
        dt=0.01,
        horizon=30.0,
        noise=("sigma_1", "sigma_2"),
        gains=(1.0, 1.0),
        plane=("v", "z"),
        scene="road",
        explored=SamplingDomain(region=((8.0, 24.0), (10.0, 32.0)), inputs=((-4000.0,), (4000.0,))),
    )


class ACC(SystemEnv):
    """A car that wants to drive faster than the one ahead is to keep a time headway.

    ## Description The lead drives at 20 m/s and the desired speed is 22 m/s: the gap grows while
    the car accelerates, then closes, and the desired speed has to be given up.

    ## Equations dx_1 = (u - F_r)/M dt + sigma_1 dW, dx_2 = 0, dx_3 = (x_2 - x_1) dt, with the drag
    F_r = f_0 + f_1 x_1 + f_2 x_1^2; f_0 = .1 N, f_1 = 5 N s/m, f_2 = .25 N s^2/m^2, M = 1650 kg

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `x_1` | own speed | m/s | [0, 50] |
    | `x_2` | speed of the lead | m/s | [0, 50] |
    | `x_3` | gap | m | [0, 1000] |

    ## Inputs
    | symbol | meaning | unit | box |
    |---|---|---|---|
    | `u` | force at the wheels | N | [-.3 M g, .3 M g] = [-4855.95, 4855.95] |

    ## Observation
    The states.

    ## Barrier h = x_3 - tau x_1 with tau = 1.8 s, of relative degree 1. It is unbounded above, so
    that h/sup h is no bound on the probability of staying safe. Gain 1. Natural filter: `scbf`.

    ## Noise `sigma_1` = 1 m/s/sqrt(s). Of the printed three-dimensional Wiener process only this
    channel acts.

    ## Mismatch
    None.

    ## Reward
    1/(1 + ((x_1 - 22)/4)^2) a step, in (0, 1].

    ## Nominal controller Min-norm CLF law of V = (x_1 - 22)^2: AV + 5 V <= d, at the cost 2 u^2/M^2
    + .02 d^2. With the weights and the condition of the print (1/2 each, AV <= d) u stays near 0.

    ## Start
    `thesis`: (15, 20, 150).

    ## Episode end
    Terminated outside the workspace, so at a crash or a stop; truncated after 100 s = 2000 steps.

    ## Arguments `tau=1.8`, the headway in s; `rate=5.0` and `slack_weight=0.02` of the goal; for
    all others see `SystemEnv`.

    ## Source Thesis Sec. 4.3.1. The print does not give tau; and it has tr(Sigma' Sigma V_xx) where
    tr(Sigma Sigma' V_xx) is meant.
    """

    problem_factory = staticmethod(acc)


class ACCGap(SystemEnv):
    """A car that wants to drive faster than the one ahead is to keep a minimum distance.

    ## Description The car of `ACC` with the lead's speed as a parameter and noise in the gap too.
    It starts 5 m from the edge.

    ## Equations dv = (u - F_r)/M dt + sigma_1 dW_1, dz = (v_f - v) dt + sigma_2 dW_2, with F_r and
    M as in `ACC` and v_f = 20 m/s

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `v` | own speed | m/s | [0, 50] |
    | `z` | gap | m | [0, 500] |

    ## Inputs
    | symbol | meaning | unit | box |
    |---|---|---|---|
    | `u` | force at the wheels | N | [-.3 M g, .3 M g] = [-4855.95, 4855.95] |

    ## Observation
    The states, and the closeness exp(-z/50), which tells small gaps apart when long ones are about.

    ## Barrier h = (z - D)^5 with D = 10 m, of relative degree 2 and unbounded above. Its
    derivatives vanish at the edge, and with them what a condition can ask for; z - D (`power` 1) is
    the plain alternative. Gains 1 and 1. Natural filter: `scbf`.

    ## Noise
    `sigma_1` = .5 m/s/sqrt(s), `sigma_2` = .5 m/sqrt(s).

    ## Mismatch
    None.

    ## Reward exp(-z/50)/(1 + ((v - 22)/4)^2) a step, in (0, 1]: others cut into a long gap. Without
    the second factor nothing would pull an agent towards the edge, since in the long run it drives
    as fast as the lead at any gap.

    ## Nominal controller Min-norm CLF law of V = (v - 22)^2: AV + V <= d, at the cost 2 u^2/M^2 + 2
    d^2. The weights are chosen by us, so that the speed is reached within the episode.

    ## Start
    `thesis`: (10, 15).

    ## Episode end
    Terminated outside the workspace, so at a crash or a stop; truncated after 30 s = 3000 steps.

    ## Arguments `distance=10.0` in m and `power=5`, an odd exponent, of the barrier; `rate=1.0` and
    `slack_weight=2.0` of the goal; for all others see `SystemEnv`.

    ## Source Thesis Sec. 6.3.2, which does not give v_f. Its b_1 lacks the noise term and its b_2
    has wrong coefficients; here both are derived.
    """

    problem_factory = staticmethod(acc_gap)
