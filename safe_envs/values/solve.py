"""Envelopes of a problem's value, by dynamic programming of the env's own step.

Let S_k = 1{X_0..X_k in C} for an episode, and D the set where episodes end. With L_K <= 1_C,
L_k <= 1_C on D, and L_k(x) <= E L_{k+1}(X_{k+1} | X_k = x, u_k(x)) on C without D for some inputs
u_k, E S_{k+1} L_{k+1} >= E S_k L_k, so that these inputs keep the episode safe with probability
L_0(x_0) at least. With H_K >= 1_C, H_k >= 1_C on D, and H_k(x) >= E H_{k+1} for every input within
its bounds, no policy does so with a larger probability than H_0(x_0), not even one that remembers.

The envelopes are constant on the part in C of each cell, and 0 outside C. The value of a cell is
the least (largest) expected value over all its points: the step takes the cell into boxes, and the
least (largest) value of all cells that a box touches stands for it. Where noise is smooth along an
axis, cells at the edge of C are cut, and L counts the parts that lie wholly in C, H those that
touch it. The arithmetic is that of floating point, not
rounded outwards throughout: the envelopes are computed, not proved.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from safe_envs.errors import ConfigurationError, shown
from safe_envs.files import cache_folder, locked, make_room, mark_used, require_writable
from safe_envs.lazy_attributes import package_version
from safe_envs.problem.problem import SafetyProblem
from safe_envs.values.cells import CellSets, Sets
from safe_envs.values.grid import CELL_SLACK, ROUNDING, grid_arrays
from safe_envs.values.images import Step
from safe_envs.values.input_search import InputSearch, cell_images, scanned_inputs, threads
from safe_envs.values.products import SpecificationOperator
from safe_envs.values.reduction import ReducedProblem, reduced
from safe_envs.values.smoothing import Smoothing, rounded_down
from safe_envs.values.suitable_grid import suitable_grid
from safe_envs.values.tables import (
    FORMAT,
    ValueFileError,
    ValueSettings,
    ValueTable,
    load_table,
    require_asked,
    save_table,
)

Progress = Callable[[float], None]

_SMALL = 1_000_000
"""States, inputs and boxes of noise of a sweep for which it takes no time to try all inputs."""


def solve(
    problem: SafetyProblem, settings: ValueSettings | None = None, progress: Progress | None = None
) -> ValueTable:
    """Compute envelopes of the largest probability to stay safe, or to meet a specification.

    Args:
        problem: whose plant or model is taken.
        settings: what is asked for.
        progress: called with the part of the work that is done.

    Returns:
        The table of both envelopes.

    Raises:
        ConfigurationError: The problem has too many coordinates, or unbounded ones, or the tables
            do not fit the memory; or what is specified is no specification over its sets.
    """
    settings = settings or ValueSettings()
    small = reduced(problem, settings.knowledge, settings.intervals, settings.specification)
    return _Solver(small, settings).run(progress)


class _Solver:
    def __init__(self, small: ReducedProblem, settings: ValueSettings) -> None:
        self._reduced, self._settings = small, settings
        self._sets, self._step = Sets(small, settings.leaving), Step(small)
        self._scanned = scanned_inputs(small.box, settings.inputs)
        self._grid = suitable_grid(small, settings, self._sets, self._step)

    def run(self, progress: Progress | None) -> ValueTable:
        begun = time.perf_counter()
        small, grid = self._reduced, self._grid
        smoothing = Smoothing(grid, self._step.blur)
        # Both envelopes are smoothed side by side: threads of BLAS would be in the way.
        with (
            threadpool_limits(1, "blas"),
            ThreadPoolExecutor(threads(), "safe_envs_values") as pool,
        ):
            operator = (
                _Operator(self, smoothing, pool)
                if small.automaton is None
                else SpecificationOperator(
                    small, self._settings.leaving, grid, self._step, self._scanned, pool
                )
            )
            rows = self._rows(operator, progress)
        lower, upper = (np.stack(each[::-1]) for each in zip(*rows, strict=True))
        return ValueTable(
            small.problem.name,
            small.fingerprint,
            self._settings,
            grid,
            self._scanned.values,
            small.steps + 1 - len(rows),
            lower,
            upper,
            time.perf_counter() - begun,
        )

    def _rows(
        self, operator: _Operator | SpecificationOperator, progress: Progress | None
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return both envelopes at the instants K, K - 1, ..., down to where they stop changing."""
        steps = self._reduced.steps
        rows = [operator.last()]
        for k in range(steps - 1, -1, -1):
            rows.append(operator.applied(*rows[-1], k))
            same = all(map(np.array_equal, rows[-1], rows[-2]))
            if same and not operator.changes_before(k):
                rows.pop()
                break
            if progress:
                progress((steps - k) / steps)
        return rows


class _Operator:
    """One step backwards in time, for both envelopes."""

    def __init__(self, solver: _Solver, smoothing: Smoothing, pool: ThreadPoolExecutor) -> None:
        self._reduced, self._grid, self._step = solver._reduced, solver._grid, solver._step
        self._sets, self._pool, self._smoothing = solver._sets, pool, smoothing
        self._scanned = solver._scanned
        slack = ROUNDING if self._reduced.noise else CELL_SLACK
        means = grid_arrays(smoothing.means, slack, smoothing.parts)
        self._moves = self._step.depends_on_time
        self.is_constant = not (self._moves or self._sets.depend_on_time)
        self._cells, self._parts = self._classified(self._reduced.steps)
        everywhere = np.arange(self._grid.cells)
        self._numbers = np.flatnonzero(self._cells.touches) if self.is_constant else everywhere
        self._imaged_at = -1
        weights = self._step.noise.weights
        self._search = InputSearch(self._scanned, weights, means, pool, len(self._numbers))
        self._work = len(self._numbers) * len(self._scanned.values) * len(weights)
        self._turn = 0

    def last(self) -> tuple[np.ndarray, np.ndarray]:
        """Return both envelopes at the instant K."""
        found = self.cells(self._reduced.steps).touches.astype(np.float32)
        return found, found

    def changes_before(self, k: int) -> bool:
        """Return whether steps to instants before k are others than that to k."""
        del k
        return not self.is_constant

    def cells(self, k: int) -> CellSets:
        """Return what the cells lie in at a control instant."""
        if self._sets.depend_on_time:
            self._cells, self._parts = self._classified(k)
        return self._cells

    def _classified(self, k: int) -> tuple[CellSets, CellSets]:
        """Return what the cells and their parts lie in at a control instant."""
        cells = self._sets.of_cells(self._grid, k)
        fine = self._smoothing.fine
        return cells, cells if fine.shape == self._grid.shape else self._sets.of_cells(fine, k)

    def applied(
        self, lower: np.ndarray, upper: np.ndarray, k: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return both envelopes at the instant k.

        Args:
            lower: lower envelope at the next instant.
            upper: upper one.
            k: the instant.
        """
        ahead = self._parts
        cells = self.cells(k)
        if self._imaged_at < 0 or self._moves:
            instant = k * self._reduced.substeps
            self._images = cell_images(
                self._step, self._grid, self._numbers, self._scanned, instant
            )
            self._imaged_at = k
        if not self.is_constant:
            self._search.forget()
        here = CellSets(*(each[self._numbers] for each in cells))
        # Values do not rise backwards in time: those of the next instant are the best to be had.
        ahead_of = lower if self.is_constant else np.where(lower > 0.0, lower, 1.0)
        found = ahead_of[self._numbers].astype(np.float64)
        if self._work < _SMALL:
            found[:] = np.inf  # All inputs are tried.
        around = [
            self._pool.submit(self._around, *given)
            for given in ((lower, ahead.inside), (-upper, ahead.touches))
        ]
        rest = -(self._step.noise.rest + self._smoothing.beyond)
        going, may_go = here.touches & ~here.ends, here.touches & ~here.may_end
        single, boxed = self._images
        self._search.lower(self._turn, single, around[0].result(), going, found)
        bounds = self._search.upper(boxed, around[1].result(), rest, may_go)
        self._turn += 1
        new_lower = (cells.touches & cells.ends).astype(np.float32)
        new_upper = (cells.touches & cells.may_end).astype(np.float32)
        new_lower[self._numbers[going]] = rounded_down(np.clip(found[going], 0.0, 1.0))
        new_upper[self._numbers[may_go]] = 0.0 - rounded_down(-np.clip(bounds[may_go], 0.0, 1.0))
        return new_lower, new_upper

    def _around(self, values: np.ndarray, counts: np.ndarray) -> np.ndarray:
        return self._smoothing.least_around(self._smoothing.smoothed(values, counts))


FOLDER = "values"
"""Name of their folder in the user's cache."""

_LOG = logging.getLogger("safe_envs")


def table_for(
    problem: SafetyProblem,
    settings: ValueSettings | None = None,
    progress: Progress | None = None,
    file: Path | str | None = None,
) -> ValueTable:
    """Return the table of a problem: one that is kept, or else a new one, which is then kept.

    Two processes do not compute the same: the second one waits. An interrupted computation leaves
    nothing behind.

    Args:
        problem: whose values are asked for.
        settings: what is asked for.
        progress: called with the part of the work that is done.
        file: to read the table from; it is written if there is none.

    Raises:
        ConfigurationError: The file holds something else, or cannot be read or written; or see
            `solve`.
    """
    settings = settings or ValueSettings()
    if file is not None:
        return _of_file(Path(file), problem, settings, progress)
    folder = cache_folder(FOLDER)
    if folder is None:
        return solve(problem, settings, progress)
    fingerprint = _fingerprint(problem, settings)
    place = folder / f"{_key(fingerprint, settings)}.npz"
    table = _kept(place, fingerprint, settings)
    if table is not None:
        return table
    with ExitStack() as stack:
        with suppress(ConfigurationError):  # The disk may be full.
            stack.enter_context(locked(place.with_suffix(".lock"), "", lambda: _tell(problem)))
        table = _kept(place, fingerprint, settings)
        if table is None:
            table = solve(problem, settings, progress)
            _keep(table, place)
    return table


def table_key(problem: SafetyProblem, settings: ValueSettings) -> str:
    """Return 64 hexadecimal digits, which are the same for what has the same table.

    Args:
        problem: whose values are asked for.
        settings: what is asked for.

    Raises:
        ConfigurationError: No grid takes the problem.
    """
    return _key(_fingerprint(problem, settings), settings)


def _of_file(
    file: Path, problem: SafetyProblem, settings: ValueSettings, progress: Progress | None
) -> ValueTable:
    # os.path takes any text for a path, also one that is too long to be one.
    if os.path.lexists(file):
        table = load_table(file, problem)
        require_asked(file, table, settings)
        return table
    require_writable(file)
    table = table_for(problem, settings, progress)
    save_table(table, file)
    return table


def _fingerprint(problem: SafetyProblem, settings: ValueSettings) -> str:
    given = (settings.knowledge, settings.intervals, settings.specification)
    return reduced(problem, *given).fingerprint


def _key(fingerprint: str, settings: ValueSettings) -> str:
    """Return the name of a table; another version of the package may compute another one."""
    described = [FORMAT, package_version(), fingerprint, settings.as_dict()]
    return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()


def _kept(place: Path, fingerprint: str, settings: ValueSettings) -> ValueTable | None:
    """Return the table of a file, marked as used; None where there is none, or none to rely on."""
    if not place.is_file():
        return None
    try:
        table = load_table(place)
        require_asked(place, table, settings)
    except ValueFileError as error:
        _LOG.warning("%s; it is computed again", error)
        return None
    if table.fingerprint != fingerprint:
        return None
    mark_used(place)
    return table


def _keep(table: ValueTable, place: Path) -> None:
    try:
        save_table(table, place)
    except ConfigurationError as error:
        _LOG.warning("the table is not kept: %s", error)
    make_room()


def _tell(problem: SafetyProblem) -> None:
    _LOG.warning("another process computes the values of %s: it is waited for", shown(problem.name))
