"""Scalar unstable system with noise, at the edge of a half-line."""

from __future__ import annotations

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.registered import SystemEnv
from safe_envs.problem.measurement import Channel
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.problem.starts import Start
from safe_envs.systems.common import positive, uniform_box

x, u, sigma = sp.symbols("x u sigma", real=True)


def scalar_system() -> ControlAffineSDE:
    """Return the system dx = (x + u) dt + sigma dW.

    Source: thesis Sec. 4.2.2.
    """
    return ControlAffineSDE(
        states=(x,),
        inputs=(u,),
        drift=[x],
        input_matrix=[1],
        diffusion=[sigma],
        parameters={sigma: 0.2},
    )


def scalar(*, limit: float = 1.0) -> SafetyProblem:
    """Build the problem of the half-line below a limit.

    Args:
        limit: the edge of the safe set.

    Source: thesis Sec. 4.2.2.
    """
    system = scalar_system()
    edge = positive("limit", limit)
    return SafetyProblem(
        name="Scalar",
        plant=system,
        model=system,
        barriers=(Barrier(edge - x),),
        states=(Variable(x, -3 * edge, 2 * edge),),
        inputs=(Variable(u, -10.0, 10.0, "1/s"),),
        reward=sp.exp(-((2 * (x / edge - 1)) ** 2)),
        nominal=(-x + edge - x,),
        sensors=(Channel("x", x, 0.1),),
        starts={"spread": uniform_box((0.0,), (0.9 * edge,)), "origin": Start.at((0.0,))},
        dt=0.01,
        horizon=5.0,
        noise=("sigma",),
        gains=(1.0,),
        filter="scbf",
        scene="line",
    )


class Scalar(SystemEnv):
    """An unstable scalar system with noise is to stay below a limit.

    ## Description
    The smallest system on which the conditions differ: near the limit a reciprocal condition
    requires unbounded control.

    ## Equations
        dx = (x + u) dt + sigma dW

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `x` | | 1 | [-3 limit, 2 limit], limit = 1 |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `u` | | 1/s | [-10, 10] (assumed) |

    ## Observation
    The state.

    ## Barrier
    $$h = limit - x$$

    of relative degree 1 and unbounded above. Gain 1. Default filter: `scbf`.

    ## Noise
    `sigma` = .2 1/sqrt(s) (assumed).

    ## Mismatch
    None.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: $x$ with a standard
    deviation of .1.

    ## Reward
    $$exp(-(2 (x/limit - 1))^2)$$

    at each step, in (0, 1]: largest at the limit. Not from the thesis.

    ## Nominal controller
    $u = limit - 2 x$, which makes the closed loop $dx = (limit - x) dt + sigma dW$. Not from the
    thesis.

    ## Start
    `spread`: uniform in $(-.9 limit, .9 limit)$. `origin`: 0. Not from the thesis.

    ## Episode end
    Terminated outside the workspace, truncated after 5 s = 500 steps. Not from the thesis.

    ## Arguments
    `barrier={"limit": 1.0}`; for all others see `SystemEnv`.

    ## Source
    Thesis Sec. 4.2.2. `noise=0` gives its first system, the deterministic one.
    """

    problem_factory = staticmethod(scalar)
