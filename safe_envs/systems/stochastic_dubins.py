"""Dubins vehicle in a disk, with noise (StochasticDubins)."""

from __future__ import annotations

from safe_envs.dynamics.lie import generator
from safe_envs.envs.registered import SystemEnv
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.problem.starts import Start
from safe_envs.systems.common import positive
from safe_envs.systems.dubins import UNIFORMS, anywhere, disk_problem, omega, vehicle, x, y


def stochastic_dubins(*, radius: float = 3.0) -> SafetyProblem:
    """Build the problem in the disk with a vehicle whose position is noisy.

    Args:
        radius: of the safe disk, in m.

    Source: thesis Sec. 4.3.2.
    """
    r = positive("radius", radius)
    car = vehicle(2.0, noise=0.2)
    h = r**2 - x**2 - y**2
    return disk_problem(
        "StochasticDubins",
        plant=car,
        model=car,
        r=r,
        h=h,
        inputs=(Variable(omega, -10.0, 10.0, "rad/s"),),
        starts={"inward": Start(anywhere(r), UNIFORMS, generator(car, h))},
        dt=0.05,
        horizon=5.0,
        gains=(1.0, 1.0),
        filter="scbf",
    )


class StochasticDubins(SystemEnv):
    """A vehicle at constant speed, disturbed by noise, is to stay in a disk.

    ## Description
    As `DubinsDisk`, with a known speed, a larger disk and noise in the position.

    ## Equations
        dx = v cos(theta) dt + sigma_1 dW_1
        dy = v sin(theta) dt + sigma_2 dW_2
        dtheta = omega dt

    ## States
    | symbol | meaning | unit | workspace |
    |---|---|---|---|
    | `x`, `y` | position | m | [-2 r, 2 r], r = 3 m |
    | `theta` | heading | rad | unbounded |

    ## Inputs
    | symbol | meaning | unit | bounds |
    |---|---|---|---|
    | `omega` | turn rate | rad/s | [-10, 10] |

    ## Observation
    $x$, $y$, $cos(theta)$, $sin(theta)$.

    ## Barrier
    $$h = r^2 - x^2 - y^2$$

    of relative degree 2. Default filter: `scbf`, whose condition of order 2 cannot stay feasible on
    a compact set: with the default input bounds it is met in about four of five steps. Gains of the
    other conditions: 1, 1.

    ## Noise
    `sigma_1`, `sigma_2` = .2 m/sqrt(s).

    ## Mismatch
    None: plant and model have $v = 2$ m/s.

    ## Sensor
    With `measurement="default"`, in each control period, all assumed: position with a standard
    deviation of .05 m and heading with .05 rad, known modulo 2 pi.

    ## Reward
    $$(1 + d/R cos(a))/2 / (1 + 4 (d^2/R^2 - 1)^2)$$

    at each step, at most about 1, where $d$ is the distance from $(.5 r, 0)$, $R = .75 r$, and $a$
    the angle between the heading and the counterclockwise tangent. Without the factor with $a$,
    turning on the spot would pay. Not from the thesis.

    ## Nominal controller
    Turns towards a course that leads onto that circle and around it. Not from the thesis.

    ## Start
    `inward`: uniform in the disk and in heading, restricted to where $A h > 0$ for the model.
    `uniform`: without that restriction.

    ## Episode end
    Terminated outside the workspace, truncated after 5 s = 100 steps. With a control period of 50
    ms some short exits are not observed, so a safety rate is a little higher than with a shorter
    one.

    ## Arguments
    `barrier={"radius": 3.0}`, the radius r in m; for all others see `SystemEnv`.

    ## Source
    Thesis Sec. 4.3.2, Eq. (4.25).
    """

    problem_factory = staticmethod(stochastic_dubins)
