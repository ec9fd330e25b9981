"""Gymnasium's Pendulum-v1 behind a filter that limits the speed at the top.

    safe-envs evaluate Pendulum-v1 --filter-spec examples/pendulum_v1.py:spec

The barrier bounds the energy: at the top (theta = 0) the rate must stay below 2 rad/s. Without
torque the energy is constant, so some torque meets the condition everywhere, weak as the motor is.
"""

import numpy as np
import sympy as sp

from safe_envs import ControlAffineSDE
from safe_envs.wrappers import FilterSpec

theta, rate, torque = sp.symbols("theta rate torque", real=True)

pendulum = ControlAffineSDE(
    states=(theta, rate),
    inputs=(torque,),
    drift=[rate, 15 * sp.sin(theta)],
    input_matrix=[0, 3],
    diffusion=[0, 0],
)


def state(observation: np.ndarray) -> np.ndarray:
    """Return (theta, rate) from observations (cos theta, sin theta, rate)."""
    return np.stack(
        [np.arctan2(observation[..., 1], observation[..., 0]), observation[..., 2]], axis=-1
    )


spec = FilterSpec(
    model=pendulum,
    barriers=4 - rate**2 + 30 * (1 - sp.cos(theta)),
    state_fn=state,
    filter="cbf:alpha=2:sampling_margin=15",
    nominal=2 * sp.tanh(3 * rate),  # swings it up
)
