"""An entry point that lets a program's filter decide on one state."""

from __future__ import annotations

import numpy as np

from safe_envs.engine.slots import Input, State, decide


def decided(x: State, u: Input, data: np.ndarray, work: np.ndarray) -> tuple:
    return decide(x, u, data, work)
