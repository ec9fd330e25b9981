"""Gymnasium's Pendulum-v1 behind a filter: it may swing up, and over the top, but only slowly.

    safe-envs evaluate Pendulum-v1 --filter-spec examples/pendulum_v1.py:spec

The barrier bounds the energy: at the top (theta = 0) the rate is to stay below 2 rad/s. A motor
that does nothing keeps the energy, so that some torque meets the condition everywhere, weak as the
motor is.
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
    """The observation is (cos theta, sin theta, rate)."""
    return np.stack(
        [np.arctan2(observation[..., 1], observation[..., 0]), observation[..., 2]], axis=-1
    )


spec = FilterSpec(
    model=pendulum,
    barriers=4 - rate**2 + 30 * (1 - sp.cos(theta)),
    state_fn=state,
    filter="cbf:alpha=2:sampling_margin=15",
    nominal=2 * sp.tanh(3 * rate),  # swings it up for ever
)
