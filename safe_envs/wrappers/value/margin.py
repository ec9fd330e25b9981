"""Cells beyond the workspace, for values of episodes that end there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.value.grid import Axis, Grid
from safe_envs.wrappers.value.reduction import ReducedProblem
from safe_envs.wrappers.value.smoothing import REACH
from safe_envs.wrappers.value.step_images import Step

_ALONG_EACH = {1: 256, 2: 32, 3: 10, 4: 6}
"""Cells along each axis for which it is found where the step leads."""

_GROWTH = 1.5
_FARTHEST = 1e4
"""Extents of the workspace that a step may lead away at most."""


def with_margin(small: ReducedProblem, edges: Sequence[np.ndarray], step: Step) -> list[np.ndarray]:
    """Return edges of cells that reach as far as a step leads, and wider ones the farther they are.

    Args:
        small: the problem.
        edges: along each axis, of the states from which episodes go on.
        step: of the problem.

    Raises:
        ConfigurationError: A step may lead anywhere, for all that is known.
    """
    found = []
    low, high = _ends(small, edges, step)
    for i, (c, own) in enumerate(zip(small.coordinates, edges, strict=True)):
        extent = float(own[-1] - own[0])
        reach = REACH * step.blur[i]
        below, above = float(own[0] - low[i] + reach), float(high[i] + reach - own[-1])
        if c.period:
            found.append(own)
            continue
        if not max(below, above) < _FARTHEST * extent:
            raise ConfigurationError(
                f"a step of {small.problem.name} may lead {c.symbol} very far out of the workspace,"
                " so that no grid can cover it; take leaving = 'violation', or a shorter control"
                " period"
            )
        width = float(np.median(np.diff(own)))
        found.append(
            np.concatenate(
                [own[0] - _beyond(below, width)[::-1], own, own[-1] + _beyond(above, width)]
            )
        )
    return found


def _beyond(margin: float, width: float) -> np.ndarray:
    """Return distances up to a margin at least; each is larger than the one before by more."""
    found, distance = [], 0.0
    while distance < margin:
        distance += width
        width *= _GROWTH
        found.append(distance)
    return np.array(found)


def _ends(
    small: ReducedProblem, edges: Sequence[np.ndarray], step: Step
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest coordinates to which a step leads, but for its blur."""
    count = _ALONG_EACH[len(edges)]
    grid = Grid(tuple(Axis(np.linspace(own[0], own[-1], count + 1)) for own in edges))
    corners = grid.corners(np.arange(grid.cells))
    inputs = np.array(small.box)[None, None]
    low, high = np.full(len(edges), np.inf), np.full(len(edges), -np.inf)
    for k in range(small.steps if step.depends_on_time else 1):
        images, effects = step.images(*corners, inputs, k * small.substeps)
        products = effects[..., :, None] * inputs[:, :, None, :, None, :]
        below = products.min(axis=(-1, -2)).sum(axis=-1)[:, None, :, None]
        above = products.max(axis=(-1, -2)).sum(axis=-1)[:, None, :, None]
        low = np.minimum(low, (images[..., 0] + below).min(axis=(0, 1, 2, 3)))
        high = np.maximum(high, (images[..., 1] + above).max(axis=(0, 1, 2, 3)))
    return low, high
