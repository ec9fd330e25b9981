"""A kinematic bicycle in a lane, in a crosswind, and longer than its designer believes.

    safe-envs evaluate --system examples/bicycle.py:problem --filter none --filter hocbf

The model is that of R. Rajamani, "Vehicle Dynamics and Control", Springer (2012), Sec. 2.2, about
the rear axle; its input is the curvature tan(delta), in which it is affine.
"""

import math

import sympy as sp

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem, define_problem

s, y, psi, v, curvature, acceleration = sp.symbols("s y psi v tan_delta a", real=True)
length = sp.Symbol("L", positive=True)
wind = sp.Symbol("wind", nonnegative=True)

bicycle = ControlAffineSDE(
    states=(s, y, psi, v),
    inputs=(curvature, acceleration),
    drift=[v * sp.cos(psi), v * sp.sin(psi), 0, 0],
    input_matrix=[[0, 0], [0, 0], [v / length, 0], [0, 1]],
    diffusion=[0, wind, 0, 0],
    parameters={length: 3.0, wind: 0.1},
)


def problem(*, width: float = 3.5) -> SafetyProblem:
    """State the problem; the nominal controller follows a course that crosses the lane's edges.

    Args:
        width: Width of the lane in m.
    """
    course = 0.7 * width * sp.sin(s / 10)
    return define_problem(
        bicycle,
        [Barrier(width / 2 - y, "left"), Barrier(width / 2 + y, "right")],
        input_bounds=[(-math.tan(0.5), math.tan(0.5)), (-3.0, 2.0)],
        start=[0.0, (-0.5, 0.5), (-0.05, 0.05), (9.0, 11.0)],
        dt=0.02,
        horizon=10.0,
        name="Bicycle",
        model=bicycle.with_parameters(L=2.5),
        nominal=[0.1 * (course - y) - psi, 10 - v],
        reward=sp.exp(-((course - y) ** 2)),
        workspace={s: (-50.0, 1000.0), y: (-10.0, 10.0), psi: (-1.5, 1.5), v: (1.0, 30.0)},
        units={s: "m", y: "m", psi: "rad", v: "m/s", acceleration: "m/s^2"},
        gains=(1.0, 2.0),
        plane=("s", "y"),
    )
