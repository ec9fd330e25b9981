"""Inverted pendulum whose noise grows with the angle."""

from __future__ import annotations

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.envs.registered import SystemEnv
from safe_envs.problem.backup import Backup, BackupLaw
from safe_envs.problem.measurement import Channel
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.problem.starts import SamplingDomain, Start
from safe_envs.systems.common import positive, uniform_box

theta, thetadot, u = sp.symbols("theta thetadot u", real=True)
m, ell, g, sigma = sp.symbols("m l g sigma", real=True)

P = sp.ImmutableMatrix([[sp.sqrt(3), 1], [1, sp.sqrt(3)]])
"""Weights of the safe ellipse."""

_TARGET = sp.Rational(2, 5)

_UPRIGHT = BackupLaw(
    "upright",
    (-15 * theta - 16 * thetadot,),
    equilibrium={theta: 0, thetadot: 0},
    extent={theta: 0.4, thetadot: 0.4},
)
"""The law brings the pendulum back without leaving the ellipse on the way."""


def inverted_pendulum() -> ControlAffineSDE:
    """Return the pendulum.

    dtheta = thetadot dt + sigma theta dW, dthetadot = (g/l sin(theta) + u/(m l^2)) dt.

    Source: thesis Sec. 5.4.1.
    """
    return ControlAffineSDE(
        states=(theta, thetadot),
        inputs=(u,),
        drift=[thetadot, g / ell * sp.sin(theta)],
        input_matrix=[0, 1 / (m * ell**2)],
        diffusion=[sigma * theta, 0],
        parameters={m: 1.0, ell: 0.7, g: 10.0, sigma: 0.1},
    )


def pendulum(*, level: float = 0.2) -> SafetyProblem:
    """Build the problem of an upright pendulum in an ellipse.

    Args:
        level: c of h = c - x' P x.

    Source: thesis Sec. 5.4.1.
    """
    c = positive("level", level)
    state = sp.Matrix([theta, thetadot])
    h = c - sp.expand((state.T * P * state)[0, 0])
    reach = float(
        sp.sqrt(c * P.inv().row(0)[0])
    )  # largest angle, and largest speed, in the ellipse
    system = inverted_pendulum()
    return SafetyProblem(
        name="Pendulum",
        plant=system,
        model=system,
        barriers=(Barrier(h),),
        states=(Variable(theta, -1.0, 1.0, "rad"), Variable(thetadot, -3.0, 3.0, "rad/s")),
        inputs=(Variable(u, -5.0, 5.0, "N m"),),
        reward=sp.exp(-((5 * (theta - _TARGET)) ** 2)),
        nominal=(sp.Integer(0),),
        sensors=(Channel("theta", theta, 0.02), Channel("thetadot", thetadot, 0.1)),
        starts={
            "uniform": uniform_box((0.0, 0.0), (reach, reach), h),
            "near-origin": Start.at((0.1, 0.1)),
        },
        dt=0.01,
        horizon=2.0,
        noise=("sigma",),
        gains=(5.0,),
        filter="scbf",
        plane=("theta", "thetadot"),
        scene="pendulum",
        sampling=SamplingDomain(region=((-reach, reach), (-reach, reach))),
        backup=Backup((_UPRIGHT,), 1.0),
    )


class Pendulum(SystemEnv):
    """An inverted pendulum, with noise that grows with its angle, is to stay near the top.

    ## Description
    The pendulum falls over if it is left alone. The task is to lean it a little beyond the edge of
    the safe ellipse.

    ## Equations
        dtheta = thetadot dt + sigma theta dW
        dthetadot = (g/l sin(theta) + u/(m l^2)) dt

    with $m = 1$ kg, $l = .7$ m, $g = 10$ m/s^2.

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `theta` | angle from the upright | rad | [-1, 1] |
    | `thetadot` | its rate | rad/s | [-3, 3] |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `u` | torque | N m | [-5, 5] |

    ## Observation
    The states.

    ## Barrier
    $$h = c - sqrt(3) theta^2 - 2 theta thetadot - sqrt(3) thetadot^2$$

    with $c = .2$, of relative degree 1, with $sup h = c$. In the ellipse $abs(theta)$ and
    $abs(thetadot)$ stay below .416. Gain 5. Default filter: `scbf`.

    ## Noise
    `sigma` = .1 1/sqrt(s).

    ## Mismatch
    None by default. The thesis takes the diffusion as unknown: `model={"sigma": 0.0}` is a designer
    who neglects it.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: the angle with a standard
    deviation of .02 rad, and its rate with .1 rad/s.

    ## Backup
    `upright`: $u = -15 theta - 16 thetadot$. Its terminal set is proved for the numbers of the
    problem when a filter is made, without noise: with noise there is no guarantee.

    ## Reward
    $$exp(-(5 (theta - .4))^2)$$

    at each step, in (0, 1]. At rest at its maximum $h = -.08$. Not from the thesis.

    ## Nominal controller
    0, as in the thesis.

    ## Start
    `uniform` in the ellipse. `near-origin`: $(.1, .1)$.

    ## Episode end
    Terminated outside the workspace, truncated after 2 s = 200 steps.

    ## Arguments
    `barrier={"level": 0.2}`, c; for all others see `SystemEnv`.

    ## Source
    Thesis Sec. 5.4.1, which does not give m. Eq. (5.19) is malformed as a trace; its value is
    right.
    """

    problem_factory = staticmethod(pendulum)
