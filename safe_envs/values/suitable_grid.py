"""A grid that suits a problem."""

from __future__ import annotations

import math

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.values.cells import Sets, hull_of, with_margin, workspace_of
from safe_envs.values.grid import Axis, Grid
from safe_envs.values.images import Step
from safe_envs.values.input_search import scanned_inputs
from safe_envs.values.product_states import ProductStates, keeps_safe
from safe_envs.values.reduction import ReducedProblem
from safe_envs.values.tables import ValueSettings

_CELLS = {1: 1000, 2: 1_000_000, 3: 500_000, 4: 600_000}
"""Cells of a problem whose noise is not divided into boxes."""

_LESS = 0.95
"""How the number of cells falls with that of the images of a cell."""

_FILLED = 0.95
"""Of the memory, since narrow cells are added at the ends of the axes."""

_SAMPLES = 512
_BYTES = 8
"""Of both tables for a cell and an instant."""


def suitable_grid(small: ReducedProblem, settings: ValueSettings, sets: Sets, step: Step) -> Grid:
    """Return a grid over the safe part of the workspace, or all of it where that counts.

    Coordinates that a step changes little get narrow cells, since a cell's width acts like a
    disturbance of the step.

    Args:
        small: the problem.
        settings: what is asked for.
        sets: of the problem.
        step: of the problem.

    Raises:
        ConfigurationError: The numbers of cells do not fit the problem or the memory.
    """
    n = len(small.coordinates)
    states, everywhere = 1, False
    if small.automaton is not None:
        states = len(ProductStates(small.automaton).live)
        # What lies outside of the grid is lost, or else the grid has to cover the workspace.
        everywhere = settings.leaving != "violation" or not keeps_safe(small.automaton)
    hull = workspace_of(small) if everywhere else hull_of(small, sets)
    ends = [(float(edges[0]), float(edges[-1])) for edges in hull]
    if settings.cells is not None and len(settings.cells) != n:
        names = ", ".join(str(c.symbol) for c in small.coordinates)
        raise ConfigurationError(
            f"cells = {'x'.join(map(str, settings.cells))}; {small.problem.name} has the"
            f" coordinates {names}: give a number for each"
        )
    working = _working(small, settings, step)
    most = int(settings.memory / 2 / states / (_BYTES * (small.steps + 1) + working))
    counts = settings.cells or _counts(
        small, ends, step, min(_usual(small, step), int(_FILLED * most))
    )
    _require_room(math.prod(counts), most, small, settings)
    cut = [_cut(edges, count) for edges, count in zip(hull, counts, strict=True)]
    if settings.leaving == "safe":
        cut = with_margin(small, cut, step)
    grid = Grid(
        tuple(Axis(edges, c.period) for c, edges in zip(small.coordinates, cut, strict=True))
    )
    _require_room(grid.cells, 2 * most, small, settings)
    return grid


def _require_room(cells: int, most: int, small: ReducedProblem, settings: ValueSettings) -> None:
    if cells > most:
        raise ConfigurationError(
            f"{cells} cells at {small.steps + 1} instants do not fit"
            f" {settings.memory / 1e9:.3g} GB of memory; take at most {most} cells, or more memory"
        )


def _working(small: ReducedProblem, settings: ValueSettings, step: Step) -> int:
    """Return the bytes for each cell that the computation takes besides the tables."""
    n, m = len(small.coordinates), len(small.inputs)
    tried = len(scanned_inputs(small.box, settings.inputs).values)
    images = 1 if step.is_affine else 2 * tried
    return 8 * (2 * n * step.scenarios * (images * len(step.noise.weights) + m) + tried)


def _cut(hull: np.ndarray, count: int) -> np.ndarray:
    """Return edges of cells of one size, and those of the narrow intervals at the ends."""
    low, high = _wide(hull)
    return np.unique(np.concatenate([hull, np.linspace(low, high, count + 1)]))


def _wide(hull: np.ndarray) -> tuple[float, float]:
    widest = int(np.diff(hull).argmax())
    return float(hull[widest]), float(hull[widest + 1])


def _usual(small: ReducedProblem, step: Step) -> int:
    """Return a number of cells that takes less than a minute or so."""
    boxes = len(step.noise.weights) * step.scenarios
    if not step.is_affine:
        boxes *= len(scanned_inputs(small.box, None).values)
    n = len(small.coordinates)
    return _CELLS[n] if n == 1 else int(_CELLS[n] / boxes**_LESS)


def _counts(
    small: ReducedProblem, ends: list[tuple[float, float]], step: Step, cells: int
) -> tuple[int, ...]:
    n = len(ends)
    rng = np.random.default_rng(0)
    points = tuple(low + (high - low) * rng.random(_SAMPLES) for low, high in ends)
    box = np.array(small.box)
    corners = np.stack([box, box[:, ::-1]])[None, :, :, :1].repeat(2, axis=-1)
    found = step.images(points, points, corners)
    middle = found.images.mean(axis=-1)
    weights = step.noise.weights / step.noise.weights.sum()
    wanted = []
    for i, (low, high) in enumerate(ends):
        moved = np.abs(middle[..., i] - points[i][:, None, None, None])
        moved = float((moved @ weights).mean()) + step.blur[i]
        reach = np.abs(found.effects[:, :, i]).max(axis=-1) @ np.abs(box).max(axis=1)
        moved += 0.5 * float(reach.mean())
        wanted.append(math.sqrt((high - low) / max(moved, 1e-3 * (high - low))))
    scale = (cells / math.prod(wanted)) ** (1 / n)
    return tuple(max(8, round(scale * each)) for each in wanted)
