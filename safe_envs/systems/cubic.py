"""Cubic planar system: safe in a parabola (CubicSDE) and in a disk (CubicSDEDisk)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.registered import SystemEnv
from safe_envs.problem.clf import CLF
from safe_envs.problem.measurement import Channel
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.problem.starts import SamplingDomain, Start
from safe_envs.systems.common import in_disk, positive, uniform_box, uniforms

x_1, x_2, u = sp.symbols("x_1 x_2 u", real=True)
a, k, sigma_1, sigma_2 = sp.symbols("a k sigma_1 sigma_2", real=True)


def cubic(diffusion: Any, noise: Mapping[sp.Symbol, float]) -> ControlAffineSDE:
    """Return the system with a given diffusion.

    dx_1 = (-a x_1 - x_2) dt + ..., dx_2 = (x_1^3 + x_2 u) dt + ..., with a = .6.

    Args:
        diffusion: sigma, 2 x d.
        noise: value of each parameter of it.

    Source: thesis Sec. 5.4.2 and 6.3.1. The thesis writes d of the states' derivatives where d of
        the states is meant.
    """
    return ControlAffineSDE(
        states=(x_1, x_2),
        inputs=(u,),
        drift=[-a * x_1 - x_2, x_1**3],
        input_matrix=[0, x_2],
        diffusion=diffusion,
        parameters={a: 0.6, **noise},
    )


def _problem(name: str, *, system: ControlAffineSDE, **rest: Any) -> SafetyProblem:
    """Build what both problems share."""
    return SafetyProblem(
        name=name,
        plant=system,
        model=system,
        inputs=(Variable(u, -10.0, 10.0, "1/s"),),
        sensors=(Channel("x_1", x_1, 0.05), Channel("x_2", x_2, 0.05)),
        dt=0.01,
        filter="scbf",
        gains=(2.0,),
        plane=("x_1", "x_2"),
        **rest,
    )


def cubic_sde(
    *, offset: float = 1.0, rate: float = 1.0, slack_weight: float = 1.0
) -> SafetyProblem:
    """Build the problem inside a parabola, with noise that grows with x_2.

    Args:
        offset: where the parabola meets the x_1 axis.
        rate: wanted decay rate of V, in 1/s.
        slack_weight: w_d of the goal, whose weight of u^2 is 1.

    Source: thesis Sec. 5.4.2.
    """
    system = cubic(diffusion=[0, k * x_2], noise={k: 0.1})
    h = positive("offset", offset) - x_1 - x_2**2
    clf = CLF(x_1**2 + x_2**2, rate, slack_weight=positive("slack_weight", slack_weight))
    return _problem(
        "CubicSDE",
        system=system,
        reward=sp.exp(-(x_1**2) - x_2**2),
        barriers=(Barrier(h),),
        states=(Variable(x_1, -6.0, 6.0), Variable(x_2, -6.0, 6.0)),
        nominal=clf.min_norm(system),
        clf=clf,
        starts={"near-edge": uniform_box((-1.0, 0.0), (2.0, 2.0), sp.Min(h, 0.5 - h))},
        horizon=2.0,
        noise=("k",),
        sampling=SamplingDomain(region=((-1.0, 1.0), (-1.0, 1.0)), inputs=((-1.0,), (1.0,))),
    )


def cubic_sde_disk(*, radius: float = 1.0) -> SafetyProblem:
    """Build the problem in a disk, with additive noise.

    Args:
        radius: of the safe disk.

    Source: thesis Sec. 6.3.1.
    """
    r = positive("radius", radius)
    system = cubic(diffusion=[[sigma_1, 0], [0, sigma_2]], noise={sigma_1: 0.2, sigma_2: 0.2})
    h = r**2 - x_1**2 - x_2**2
    area, angle = uniforms(2)
    return _problem(
        "CubicSDEDisk",
        system=system,
        reward=sp.exp(-4 * (h / r**2) ** 2),
        barriers=(Barrier(h),),
        states=(Variable(x_1, -2 * r, 2 * r), Variable(x_2, -2 * r, 2 * r)),
        nominal=(sp.Integer(0),),
        starts={
            "uniform": Start(in_disk(r, area, angle), (area, angle)),
            "thesis-1": Start.at((-0.1, 0.7)),
            "thesis-2": Start.at((-0.1, 0.8)),
        },
        horizon=1.0,
        noise=("sigma_1", "sigma_2"),
        sampling=SamplingDomain(region=((-r, r), (-r, r)), inputs=((-1.0,), (1.0,))),
    )


class CubicSDE(SystemEnv):
    """A cubic planar system, whose noise and control vanish together, is to stay in a parabola.

    ## Description
    The state starts near the edge of the safe set, and the goal is the origin. Where $x_2 = 0$ the
    input has no effect.

    ## Equations
        dx_1 = (-a x_1 - x_2) dt
        dx_2 = (x_1^3 + x_2 u) dt + k x_2 dW

    with $a = .6$.

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `x_1`, `x_2` | | 1 | [-6, 6] |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `u` | | 1/s | [-10, 10] |

    ## Observation
    The states.

    ## Barrier
    $$h = offset - x_1 - x_2^2$$

    with offset 1, of relative degree 1. The safe set is unbounded and so is $h$, so $h/sup h$ gives
    no bound on the probability of staying safe. The condition cannot be met at $x_2 = 0$, $x_1 <
    0$. Gain 2. Default filter: `scbf`.

    ## Noise
    `k` = .1 1/sqrt(s).

    ## Mismatch
    None by default. The thesis takes the diffusion as unknown: `model={"k": 0.0}` is a designer who
    neglects it.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: both states with a
    standard deviation of .05.

    ## Reward
    $$exp(-x_1^2 - x_2^2)$$

    at each step, in (0, 1].

    ## Nominal controller
    Minimum-norm controller from the control Lyapunov function (CLF) $V = x_1^2 + x_2^2$: the
    condition $A V + V <= d$ at the cost $u^2 + d^2$.

    ## Start
    `near-edge`: uniform where $0 < h < .5$ in the rectangle from $(-3, -2)$ to $(1, 2)$.

    ## Episode end
    Terminated outside the workspace, truncated after 2 s = 200 steps.

    ## Arguments
    `offset=1.0` of the barrier; `rate=1.0` and `slack_weight=1.0` of the goal; for all others see
    `SystemEnv`.

    ## Source
    Thesis Sec. 5.4.2, which prints the differential of the derivatives of the states in place of
    that of the states, and calls the safe set compact.
    """

    problem_factory = staticmethod(cubic_sde)


class CubicSDEDisk(SystemEnv):
    """A cubic planar system with additive noise is to stay in a disk.

    ## Description
    The drift of `CubicSDE` with constant noise in both states. The effect of the input is
    proportional to $x_2$; the noise acts everywhere.

    ## Equations
        dx_1 = (-a x_1 - x_2) dt + sigma_1 dW_1
        dx_2 = (x_1^3 + x_2 u) dt + sigma_2 dW_2

    with $a = .6$.

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `x_1`, `x_2` | | 1 | [-2 r, 2 r], r = 1 |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `u` | | 1/s | [-10, 10] |

    ## Observation
    The states.

    ## Barrier
    $$h = r^2 - x_1^2 - x_2^2$$

    of relative degree 1, with $sup h = r^2$. The bound $h/sup h$ of the thesis does not apply: at
    $x_2 = 0$, $abs(x_1) < .258$ the condition cannot be met ($A h = -.08$ at the origin). Gain 2.
    Default filter: `scbf`.

    ## Noise
    `sigma_1`, `sigma_2` = .2 1/sqrt(s).

    ## Mismatch
    None by default.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: both states with a
    standard deviation of .05.

    ## Reward
    $$exp(-4 (h/r^2)^2)$$

    at each step, in (0, 1]: largest at the edge of the safe set. Not from the thesis.

    ## Nominal controller
    0, as in the thesis.

    ## Start
    `uniform` in the disk. `thesis-1`: $(-.1, .7)$. `thesis-2`: $(-.1, .8)$.

    ## Episode end
    Terminated outside the workspace, truncated after 1 s = 100 steps.

    ## Arguments
    `barrier={"radius": 1.0}`, r; for all others see `SystemEnv`.

    ## Source
    Thesis Sec. 6.3.1, whose $A h$ has $x_1 x_2$ in place of $2 x_1 x_2$, and $sigma_2^2$ twice.
    """

    problem_factory = staticmethod(cubic_sde_disk)
