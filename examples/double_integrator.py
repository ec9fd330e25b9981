"""A point mass in the plane that must avoid a round obstacle on its way to a goal behind it.

safe-envs evaluate --system examples/double_integrator.py:problem --filter none --filter hocbf
"""

import sympy as sp

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem, define_problem

x, y, v_x, v_y, a_x, a_y, sigma = sp.symbols("x y v_x v_y a_x a_y sigma", real=True)

point = ControlAffineSDE(
    states=(x, y, v_x, v_y),
    inputs=(a_x, a_y),
    drift=[v_x, v_y, 0, 0],
    input_matrix=[[0, 0], [0, 0], [1, 0], [0, 1]],
    diffusion=[[0, 0], [0, 0], [sigma, 0], [0, sigma]],
    parameters={sigma: 0.0},
)


def problem(*, radius: float = 1.0) -> SafetyProblem:
    """State the problem, with the obstacle at the origin and the goal at (3, 0).

    Args:
        radius: Radius of the obstacle in m.
    """
    obstacle = Barrier(x**2 + y**2 - radius**2, "obstacle")
    to_goal = (x - 3) ** 2 + y**2
    return define_problem(
        point,
        obstacle,
        input_bounds=(-2.0, 2.0),
        start=[(-4.0, -3.0), (-1.0, 1.0), 0.0, 0.0],
        dt=0.05,
        horizon=15.0,
        name="DoubleIntegrator",
        nominal=[-0.5 * (x - 3) - 1.2 * v_x, -0.5 * y - 1.2 * v_y],
        reward=1 / (1 + to_goal),
        workspace={x: (-6.0, 6.0), y: (-6.0, 6.0), v_x: (-8.0, 8.0), v_y: (-8.0, 8.0)},
        units={x: "m", y: "m", v_x: "m/s", v_y: "m/s", a_x: "m/s^2", a_y: "m/s^2"},
        gains=(2.0, 2.0),
        goal=sp.Float(0.04) - to_goal,
        plane=("x", "y"),
    )
