"""Functions that are generated for each program that plays paths: declarations.

See also `safe_envs.compiled.slots`.
"""

from __future__ import annotations

import numpy as np

from safe_envs.compiled.slots import State


def state_in(row: np.ndarray) -> State:
    """Return the state that an array holds."""
    raise NotImplementedError


def tilt_direction(x: State, barriers: tuple[float, ...], data: np.ndarray) -> tuple[float, ...]:
    """Return the direction in which the smallest barrier rises fastest; see `TiltedNoiseEnv`.

    It has an entry for each noise channel, and a single one, 0, without noise.
    """
    raise NotImplementedError


def lowest_relative(
    x: State,
    before: tuple[float, ...],
    after: tuple[float, ...],
    units: np.ndarray,
    uniforms: np.ndarray,
    first: int,
    data: np.ndarray,
) -> float:
    """Return the smallest h that counts in a control period, relative to the units of the barriers.

    Args:
        x: state at its beginning.
        before: barriers there.
        after: barriers at its end.
        units: of the barriers.
        uniforms: numbers in [0, 1); from `first` on there is one for each barrier, if any is used.
        first: where those of this period begin.
        data: numbers of the program.
    """
    raise NotImplementedError
