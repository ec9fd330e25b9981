"""The systems of the thesis and variations, one file each, and their registration."""

from __future__ import annotations

MODULES = {
    "DubinsDisk": "dubins",
    "DubinsObstacle": "dubins_obstacle",
    "DubinsObstacles": "dubins_obstacles",
    "DubinsReach": "dubins_reach",
    "StochasticDubins": "stochastic_dubins",
    "QuadrotorAltitude": "quadrotor_altitude",
    "Quadrotor": "quadrotor",
    "QuadrotorLimits": "quadrotor_limits",
    "ACC": "acc",
    "ACCGap": "acc_gap",
    "Pendulum": "pendulum",
    "CubicSDE": "cubic",
    "CubicSDEDisk": "cubic",
    "Scalar": "scalar",
}
"""The module of each env class."""

ENV_IDS = tuple(f"safe_envs/{name}-v0" for name in MODULES)
"""Every registered id."""

CUSTOM_ID = "safe_envs/Custom-v0"
"""The id that takes any system, as its argument `system`; see `safe_envs.envs.registered`."""


def register_all() -> None:
    """Register every id with Gymnasium; the systems themselves are imported when an env is made."""
    from safe_envs.envs.spec import register_system

    register_system(
        CUSTOM_ID, "safe_envs.envs.registered:Custom", "safe_envs.envs.registered:CustomVector"
    )
    for name, module in MODULES.items():
        register_system(
            f"safe_envs/{name}-v0",
            f"safe_envs.systems.{module}:{name}",
            f"safe_envs.systems.vectors:{name}Vector",
        )
