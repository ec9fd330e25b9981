"""A reduced problem on a grid, with all that proofs about it need."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.wrappers.value.grid import Grid
from safe_envs.wrappers.value.proved_sets import ProvedSets
from safe_envs.wrappers.value.proved_smoothing import ProvedSmoothing
from safe_envs.wrappers.value.proved_steps import ProvedImages, ProvedWeights
from safe_envs.wrappers.value.reduction import ReducedProblem
from safe_envs.wrappers.value.step_images import Step
from safe_envs.wrappers.value.windows import Bordered, Groups, Windows

_WIDEST = 2.0
"""Standard deviation in periods beyond which noise on a periodic axis is not bounded here."""

_AT_ONCE = 2_000_000


class ProvedChain:
    """Lower bounds of expected values on the cells of a grid, for certain.

    Args:
        small: the problem.
        leaving: see `ValueSettings`.
        grid: of its coordinates.
        refined: see `ProvedSmoothing`.

    Attributes:
        grid: the grid.
        step: of the problem.
        steps: control periods of an episode.
        box: (low, high) of each input.
        sets: what the cells lie in.

    Raises:
        ConfigurationError: Nothing can be proved of such a problem.
    """

    def __init__(self, small: ReducedProblem, leaving: str, grid: Grid, refined: int = 1) -> None:
        _require_provable(small, grid)
        self.grid, self.step, self.box = grid, Step(small), small.box
        self.steps = small.steps
        for axis, blur in zip(grid.axes, self.step.blur, strict=True):
            if axis.period and blur > _WIDEST * axis.period:
                raise ConfigurationError(
                    f"{small.problem.name} has noise of {blur:g} along a coordinate of period"
                    f" {axis.period:g}; tables are checked up to {_WIDEST:g} periods"
                )
        self.sets = ProvedSets(small, leaving, grid, self.step.blur)
        self._smoothing = ProvedSmoothing(grid, self.step.blur, refined)
        self._weights = ProvedWeights(self.step.noise)

    def ahead(self, values: np.ndarray, counts: np.ndarray, sign: int) -> Bordered:
        """Return lower bounds of expected values at means, for `bounds`.

        Args:
            values: on the cells of the grid, in [0, 1].
            counts: which cells count, bool (cells,).
            sign: 1, or -1 for bounds of the negative values.
        """
        given = np.where(counts, sign * values.astype(np.float64), 0.0)
        outside = 0.0 if sign > 0 else -self._smoothing.beyond
        return Bordered(self._smoothing.means, self._smoothing.smoothed(given), outside)

    def images(
        self, ends: tuple[Sequence[np.ndarray], Sequence[np.ndarray]], inputs: np.ndarray
    ) -> ProvedImages:
        """Return where boxes of coordinates go.

        Args:
            ends: least and largest coordinates, n arrays (B,) each.
            inputs: boxes of inputs, shape (U, m, 2), or (B, U, m, 2) with others for each box.
        """
        return ProvedImages(self.step, self._smoothing.means, ends, inputs, self.sets.widening)

    def bounds(
        self, ahead: Bordered, images: ProvedImages, numbers: np.ndarray, chosen: np.ndarray
    ) -> np.ndarray:
        """Return lower bounds of expected values after a step, shape (B,).

        Args:
            ahead: see the method of this name.
            images: of boxes.
            numbers: numbers of the boxes, shape (B,).
            chosen: number of the input of each, shape (B,).
        """
        found = np.empty(len(numbers))
        size = max(1, _AT_ONCE // int(np.prod(images.shape)))
        for first in range(0, len(numbers), size):
            part = slice(first, first + size)
            windows = images.windows(numbers[part], chosen[part])
            found[part] = self.of_groups(ahead, self.groups(windows), images.shape)
        return found

    def groups(self, windows: Windows) -> Groups:
        """Return windows in groups, for `of_groups`."""
        return Groups(self._smoothing.means, windows)

    def of_groups(self, ahead: Bordered, groups: Groups, shape: tuple[int, int]) -> np.ndarray:
        """Return lower bounds of expected values for the windows of boxes; see `bounds`."""
        values = groups.least(ahead).reshape(-1, *shape)
        return self._weights.expected(values) - self.sets.lost


def _require_provable(small: ReducedProblem, grid: Grid) -> None:
    name = small.problem.name
    if small.automaton is not None:
        raise ConfigurationError(
            f"the table is of the specification {small.specification!r}; only tables of staying"
            " safe are checked"
        )
    if small.known:
        symbols = ", ".join(map(str, small.known))
        raise ConfigurationError(
            f"{name} has states that are known in advance ({symbols}); they are computed in"
            " floating point, and tables over them are not checked"
        )
    if len(grid.axes) != len(small.coordinates):
        raise ConfigurationError(f"the grid has other coordinates than {name}")
    for axis, c in zip(grid.axes, small.coordinates, strict=True):
        off = abs(axis.edges[0] + 0.5 * c.period) + abs(axis.edges[-1] - 0.5 * c.period)
        if axis.period != c.period or (c.period and off > 4.0 * np.spacing(c.period)):
            raise ConfigurationError(f"the grid has another period of {c.symbol} than {name}")
