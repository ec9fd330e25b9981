"""What one controller attains, at least: a certified lower envelope of a closed loop.

Let u_k be any inputs, chosen without knowing the noise of their step, that lie in U(Z) whenever the
state is in the cell Z. If L_k <= 1_C and L_k <= Q^u L_(k+1) on each cell Z for *all* u of U(Z),
proposition 2 of the page on values holds along them, and they are safe with probability L_0(x_0) at
least. U(Z) is an interval that holds what the policy proposes, and the filter makes of it, anywhere
in Z; it is cut into parts, of which the worst counts. The table is computed with proved bounds, and
rounded down as it is stored: there is nothing to be taken off it.

Roundings of observations and actions to single precision are in U(Z), and so are the filter's.

With one input and one constraint a u + b >= 0 the filter executes the input of the bounds next to
the proposed one that meets it, or, where none does, the one that comes closest. With t = -b/a that
is max(u, t) for a > 0 and min(u, t) for a < 0, cut to the bounds. Both are monotone in u and in t,
so that their ends on a box come from the ends of u and of t.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
import weakref
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.arrays import checksum, reading, write_arrays
from safe_envs.dynamics.codegen import Components
from safe_envs.enclosures.intervals import Interval, IntervalArithmetic, interval_function, negative
from safe_envs.errors import ConfigurationError, shown
from safe_envs.files import cache_folder, locked, make_room, mark_used
from safe_envs.filters.conditions.base import Condition, with_parts
from safe_envs.lazy_attributes import package_version
from safe_envs.problem.problem import SafetyProblem
from safe_envs.problem.signals import TIME
from safe_envs.values.cells import Sets
from safe_envs.values.grid import Grid
from safe_envs.values.images import Step
from safe_envs.values.look_ahead import draw_starts, sampling_margin
from safe_envs.values.proved import ProvedChain, ProvedImages
from safe_envs.values.reduction import ReducedProblem, reduced
from safe_envs.values.smoothing import rounded_down
from safe_envs.values.suitable_grid import suitable_grid
from safe_envs.values.tables import ValueFileError, ValueSettings
from safe_envs.values.windows import Bordered

_SINGLE = 2.0**-23
"""Of a number: rounding of observations and actions to single precision, with room."""

_EXECUTED = 1e-6
"""Of the width of the input bounds: rounding of actions and of the filter."""

POLICIES = ("any", "nominal", "zero")

Ends = tuple[np.ndarray, np.ndarray]


class ExecutedInputs:
    """Which inputs a policy under a filter may execute, from boxes of the plant's states.

    Args:
        problem: with one input.
        condition: of the filter, on a problem with one barrier; None without a filter.
        policy: "any", "nominal" for the problem's own controller, or "zero".
        knowledge: of the filter, "model" or "plant".

    Attributes:
        described: all that determines the inputs, as JSON-able data.

    Raises:
        ConfigurationError: Such a closed loop is not bounded.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        condition: Condition | None,
        policy: str,
        knowledge: str = "model",
    ) -> None:
        if policy not in POLICIES:
            raise ConfigurationError(f"policy = {policy!r}; allowed: {', '.join(POLICIES)}")
        require_one_input(problem)
        self._low, self._high = map(float, problem.input_bounds[0])
        states = problem.plant.states
        self._law = self._features = self._constraint = None
        law, features, constraint = [], [], []
        if policy != "any":
            given = problem.nominal[0] if policy == "nominal" else 0
            law = _known([problem.model.numeric(sp.sympify(given))])
            features = _known([f.expression for f in problem.features])
            self._features = interval_function(states, features)
            self._law = interval_function([f.symbol for f in problem.features], law)
        if condition is not None:
            constraint = _constraint(problem, condition, knowledge)
            self._constraint = interval_function(states, constraint)
        self.described = [
            [list(map(sp.srepr, each)) for each in (states, features, law, constraint)],
            [sp.srepr(f.symbol) for f in problem.features],
            [self._low, self._high, _SINGLE, _EXECUTED],
        ]

    def of_boxes(self, low: Sequence[np.ndarray], high: Sequence[np.ndarray]) -> Ends:
        """Return the ends of the executed inputs, arrays (B,).

        Args:
            low: least states, n arrays (B,).
            high: largest states.
        """
        boxes = [Interval(a, b) for a, b in zip(low, high, strict=True)]
        first, last = np.full(len(low[0]), self._low), np.full(len(low[0]), self._high)
        if self._law is not None and self._features is not None:
            seen = [
                Interval(f.low - _SINGLE * np.abs(f.low), f.high + _SINGLE * np.abs(f.high))
                for f in self._features(boxes)
            ]
            proposed = self._law(seen)[0]
            first = self._cut(first * 0.0 + proposed.low)
            last = self._cut(last * 0.0 + proposed.high)
        if self._constraint is not None:
            first, last = self._filtered(first, last, *self._constraint(boxes))
        slack = _EXECUTED * (self._high - self._low)
        return self._cut(first - slack), self._cut(last + slack)

    def _cut(self, values: np.ndarray) -> np.ndarray:
        return np.clip(values, self._low, self._high)

    def _filtered(self, first: np.ndarray, last: np.ndarray, a: Interval, b: Interval) -> Ends:
        ops = IntervalArithmetic()
        zero = np.zeros(len(first))
        a, b = (Interval(zero + c.low, zero + c.high) for c in (a, b))
        with np.errstate(all="ignore"):
            edge = ops.multiply(negative(b), ops.reciprocal(a))
            met = ops.add(ops.multiply(a, Interval(first, last)), b).low >= 0.0
        rising = self._cut(np.maximum(first, edge.low)), self._cut(np.maximum(last, edge.high))
        falling = self._cut(np.minimum(first, edge.low)), self._cut(np.minimum(last, edge.high))
        found = [np.full(len(first), end) for end in (self._low, self._high)]
        for i in range(2):
            # What comes last takes precedence: an input that meets the constraint is kept.
            found[i] = np.where(a.low > 0.0, rising[i], found[i])
            found[i] = np.where(a.high < 0.0, falling[i], found[i])
            found[i] = np.where(met, (first, last)[i], found[i])
        return found[0], found[1]


def require_one_input(problem: SafetyProblem) -> None:
    """Check that what a filter executes in a problem is known here; raise ConfigurationError."""
    if len(problem.inputs) != 1:
        raise ConfigurationError(
            f"{problem.name} has {len(problem.inputs)} inputs; closed loops of one are bounded"
        )


def _constraint(problem: SafetyProblem, condition: Condition, knowledge: str) -> list[sp.Expr]:
    """Return a and b of the constraint a u + b >= 0."""
    if len(problem.barriers) == 1:
        problem, _ = with_parts(problem, (condition,))
    if len(problem.barriers) != 1:
        raise ConfigurationError(
            f"{problem.name} has {len(problem.barriers)} barriers; closed loops with one are"
            " bounded"
        )
    if condition.corrects_model:
        raise ConfigurationError(f"{condition.name} is learned; conditions of formulas are bounded")
    system = problem.plant if knowledge == "plant" else problem.model
    found = condition.constraint(system, problem.barriers[0])
    parts = (found.demand, found.change, found.uncertainty, found.terms)
    if found.domain or found.alternatives or any(part is not None for part in parts):
        raise ConfigurationError(
            f"the constraint of {condition.name} is not of the form a u + b >= 0 with known a and"
            " b, or has a margin of first order; its closed loop is not bounded"
        )
    return _known([system.numeric(e) for e in (found.coefficient[0], found.offset)])


def _known(expressions: Sequence[sp.Expr]) -> list[sp.Expr]:
    found = [sp.sympify(e) for e in expressions]
    if any(TIME in e.free_symbols for e in found):
        raise ConfigurationError("a controller that depends on the time is not bounded")
    return found


_PARTS = 4
"""Of the interval of the inputs of a cell."""

_REFINED = 2
"""Parts of a cell of the means along each axis."""

_STARTS = 20_000
_AT_ONCE = 4_000_000
_STARTS_AT_ONCE = 20_000

_LEAVING = "violation"  # Leaving the workspace is one: a lower bound may count it so.

CELLS = {1: 20_000, 2: 1_000_000}
"""Of a table where no numbers are asked for, by the number of states."""

_WORK = 100_000_000
"""Cells times instants of such a table: a minute or so."""


@dataclass(frozen=True, eq=False)
class ClosedLoopTable:
    """A certified lower envelope of one controller's safety.

    Attributes:
        grid: of the states.
        lower: shape (K + 1, cells), float32; of `ClosedLoop.table` the first instants.
        chain: of the problem on this grid.
        executed: inputs of the controller.
        parts: into which their intervals are cut.
        seconds: that the computation took.
    """

    grid: Grid
    lower: np.ndarray
    chain: ProvedChain
    executed: ExecutedInputs
    parts: int
    seconds: float

    def start_bounds(self, x: Components) -> np.ndarray:
        """Return certified lower bounds of the probability of a safe episode from starts, (B,).

        Args:
            x: n components of the states, (B,).
        """
        states = [np.asarray(c, dtype=np.float64) for c in x]
        count = len(states[0])
        ahead = self.chain.ahead(self.lower[1], self.chain.sets.inside, 1)
        found = [
            self._of_starts(ahead, [c[first : first + _STARTS_AT_ONCE] for c in states])
            for first in range(0, count, _STARTS_AT_ONCE)
        ]
        return np.concatenate([np.zeros(0), *found])

    def _of_starts(self, ahead: Bordered, states: list[np.ndarray]) -> np.ndarray:
        inside = self.chain.sets.read(states, states)[0]
        images = _images(self.chain, self.executed, self.parts, (states, states))
        found = np.full(len(states[0]), np.inf)
        for part in range(self.parts):
            chosen = np.full(len(found), part)
            bound = self.chain.bounds(ahead, images, np.arange(len(found)), chosen)
            found = np.minimum(found, bound)
        return np.where(inside, found, 0.0).clip(0.0, 1.0)

    def mean_over_starts(self, problem: SafetyProblem, seed: int = 0) -> float:
        """Return a lower bound of the probability of a safe episode from the problem's starts.

        It is certified where all episodes begin in one state; where starts are drawn, it holds with
        99.99 % for the draw.

        Args:
            problem: with the starts.
            seed: of the starts that are drawn.
        """
        found = self.start_bounds(draw_starts(problem, _STARTS, seed))
        return max(0.0, float(found.mean()) - sampling_margin(found))


class ClosedLoop:
    """A controller in a problem, of which a table may be computed, or read again.

    Args:
        problem: with one input, whose coordinates are its states.
        condition: of the filter, a formula; None without a filter.
        policy: "any" for whatever may be proposed, or "nominal" or "zero".
        knowledge: of the filter, "model" or "plant".

    Attributes:
        problem: as given.
        small: the problem as a chain.
        executed: inputs of the controller.

    Raises:
        ConfigurationError: Such a closed loop is not bounded.
    """

    def __init__(
        self,
        problem: SafetyProblem,
        condition: Condition | None,
        policy: str = "any",
        knowledge: str = "model",
    ) -> None:
        self.executed = ExecutedInputs(problem, condition, policy, knowledge)
        self.problem, self.small = problem, _chain_of_states(problem)

    def fingerprint(self) -> str:
        """Return the SHA-256, in hexadecimal digits, of all that determines the closed loop."""
        described = [self.small.fingerprint, self.executed.described, _LEAVING]
        return hashlib.sha256(json.dumps(described).encode()).hexdigest()

    def grid(self, cells: tuple[int, ...] | None = None) -> Grid:
        """Return the grid of a table.

        Args:
            cells: along each state; None for numbers that suit the problem.

        Raises:
            ConfigurationError: They do not fit the problem or the memory, or none suit it.
        """
        small = self.small
        given = ValueSettings(knowledge="plant", leaving=_LEAVING, cells=cells)
        sets, step = Sets(small, _LEAVING), Step(small)
        if cells is None:
            require_few_states(self.problem)
            wanted = min(CELLS[len(small.coordinates)], _WORK // small.steps)
            usual = suitable_grid(small, given, sets, step)
            scale = (wanted / usual.cells) ** (1 / len(usual.axes))
            given = replace(given, cells=tuple(max(8, round(scale * c)) for c in usual.shape))
        return suitable_grid(small, given, sets, step)

    def chain(self, grid: Grid) -> ProvedChain:
        """Return the chain on a grid, with all that proofs about it need."""
        return ProvedChain(self.small, _LEAVING, grid, _REFINED)

    def table(
        self,
        grid: Grid,
        parts: int | None = None,
        progress: Callable[[float], None] | None = None,
        kept: int = 2,
    ) -> ClosedLoopTable:
        """Compute a table; see `closed_loop_table`.

        Args:
            grid: of the states.
            parts: of the intervals of inputs.
            progress: called with the part of the work that is done.
            kept: first instants to keep; bounds of starts need two.

        Returns:
            The table.
        """
        begun = time.perf_counter()
        chain = self.chain(grid)
        parts = parts or (_PARTS if chain.step.noise.low.size else 1)
        lower = _lower(chain, self.executed, parts, kept, progress)
        seconds = time.perf_counter() - begun
        return ClosedLoopTable(grid, lower, chain, self.executed, parts, seconds)


def require_few_states(problem: SafetyProblem) -> None:
    """Check that tables of a problem's closed loops take minutes; raise ConfigurationError."""
    require_one_input(problem)
    n = problem.plant.n
    if n not in CELLS:
        raise ConfigurationError(
            f"{problem.name} has {n} states; closed loops of at most {max(CELLS)} are bounded"
        )


def closed_loop_table(
    problem: SafetyProblem,
    condition: Condition | None,
    policy: str = "any",
    cells: tuple[int, ...] | None = None,
    parts: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> ClosedLoopTable:
    """Compute what a policy under a filter attains at least, on the env's own held input.

    Args:
        problem: with one input, whose coordinates are its states.
        condition: of the filter, which knows the model; None without a filter.
        policy: "any" for whatever may be proposed, or "nominal" or "zero".
        cells: along each state; None for numbers that suit the problem.
        parts: into which the interval of the inputs of each cell is cut; None for a few where noise
            is divided into boxes, and one where that gains nothing.
        progress: called with the part of the work that is done.

    Returns:
        The table, with bounds of starts.

    Raises:
        ConfigurationError: Such a closed loop is not bounded.
    """
    loop = ClosedLoop(problem, condition, policy)
    return loop.table(loop.grid(cells), parts, progress, loop.small.steps + 1)


def _chain_of_states(problem: SafetyProblem) -> ReducedProblem:
    small = reduced(replace(problem, frame=None), "plant")
    if tuple(c.expression for c in small.coordinates) != tuple(problem.plant.states):
        raise ConfigurationError(
            f"not all states of {problem.name} are coordinates of a grid; closed loops of all"
            " states are bounded"
        )
    return small


def _lower(
    chain: ProvedChain,
    executed: ExecutedInputs,
    parts: int,
    kept: int,
    progress: Callable[[float], None] | None,
) -> np.ndarray:
    """Return the first instants of the envelope, shape (kept, cells)."""
    sets, steps = chain.sets, chain.steps
    numbers = np.flatnonzero(sets.touches & ~sets.ends)
    images = _images(chain, executed, parts, sets.corners(numbers))
    size = max(1, _AT_ONCE // (parts * int(np.prod(images.shape))))
    blocks = [slice(i, min(i + size, len(numbers))) for i in range(0, len(numbers), size)]
    # The input of a cell is that of all instants, and so are its windows.
    groups = [
        [
            chain.groups(images.windows(np.arange(b.start, b.stop), np.full(b.stop - b.start, p)))
            for p in range(parts)
        ]
        for b in blocks
    ]
    lower = np.zeros((kept, chain.grid.cells), dtype=np.float32)
    values = sets.touches.astype(np.float32)
    for k in range(steps, -1, -1):
        if k < steps:
            ahead = chain.ahead(values, sets.inside, 1)
            for block, own in zip(blocks, groups, strict=True):
                bounds = [chain.of_groups(ahead, each, images.shape) for each in own]
                worst = np.minimum.reduce(bounds).clip(0.0, 1.0)
                values[numbers[block]] = rounded_down(worst)
        if k < kept:
            lower[k] = values
        if progress:
            progress((steps - k) / steps)
    return lower


def _images(
    chain: ProvedChain,
    executed: ExecutedInputs,
    parts: int,
    ends: tuple[list[np.ndarray], list[np.ndarray]],
) -> ProvedImages:
    """Return where boxes of states go under each part of their inputs."""
    low, high = executed.of_boxes(*ends)
    shares = np.arange(parts + 1) / parts
    cuts = low[:, None] + (high - low)[:, None] * shares
    # The first and the last cut are the ends, whatever the rounding.
    cuts[:, 0], cuts[:, -1] = low, high
    inputs = np.stack([cuts[:, :-1], cuts[:, 1:]], axis=-1)[:, :, None, :]
    return chain.images(ends, inputs)


FORMAT = 1
"""To be raised whenever the same closed loop gets another table."""

WRITER = "safe-envs evaluate --closed-loop"

_KIND = "closed loop"
_LOWER = "lower"
_MOST_BYTES = 200_000_000
_MOST_PARTS = 1000


def save_closed_loop(table: ClosedLoopTable, loop: ClosedLoop, path: Path) -> None:
    """Write the first instants of a table into a file, whole or not at all.

    Args:
        table: of the closed loop.
        loop: the closed loop.
        path: of the file.

    Raises:
        ConfigurationError: It cannot be written there, or is too large to be read.
    """
    arrays = _edges(table.grid) | {_LOWER: table.lower[:2].astype("<f4", copy=False)}
    header = {
        "format": FORMAT,
        "kind": _KIND,
        "problem": loop.problem.name,
        "fingerprint": loop.fingerprint(),
        "parts": int(table.parts),
        "seconds": float(table.seconds),
    }
    header["sha256"] = checksum(header, arrays)
    write_arrays(path, header, arrays, _MOST_BYTES // 2)


def load_closed_loop(path: Path, loop: ClosedLoop, grid: Grid) -> ClosedLoopTable:
    """Read the first instants of a table.

    Args:
        path: of the file.
        loop: whose table it has to hold.
        grid: on which it has to be, edge by edge.

    Raises:
        ValueFileError: The file is missing, no such file, altered, or of another closed loop.
    """
    with reading(path, WRITER, ValueFileError, _MOST_BYTES) as file:
        header = dict(file.header)
        arrays = file.arrays()
        return _table(header, arrays, loop, grid)


def _table(
    header: dict[str, Any], arrays: dict[str, np.ndarray], loop: ClosedLoop, grid: Grid
) -> ClosedLoopTable:
    """Return what was read as a table; raise one of the errors of damaged files otherwise."""
    if (header["kind"], header["format"]) != (_KIND, FORMAT):
        raise ValueError("it holds something else")
    if header.pop("sha256") != checksum(header, arrays):
        raise ValueError("its content does not match its checksum")
    if header["fingerprint"] != loop.fingerprint():
        raise ValueError("it is of another closed loop")
    lower, parts, seconds = arrays.pop(_LOWER), header["parts"], float(header["seconds"])
    expected = _edges(grid)
    if arrays.keys() != expected.keys() or any(
        not np.array_equal(arrays[name], edges) for name, edges in expected.items()
    ):
        raise ValueError("it is on another grid")
    if type(parts) is not int or not 1 <= parts <= _MOST_PARTS:
        raise ValueError("its number of parts is none")
    if lower.dtype != np.float32 or lower.shape != (2, grid.cells):
        raise ValueError("its envelope is none of this grid")
    # NaN is not <= 1.
    if not (lower.min() >= 0 and lower.max() <= 1):
        raise ValueError("its values are not between 0 and 1")
    return ClosedLoopTable(grid, lower, loop.chain(grid), loop.executed, parts, seconds)


def _edges(grid: Grid) -> dict[str, np.ndarray]:
    return {f"edges_{i}": axis.edges.astype("<f8") for i, axis in enumerate(grid.axes)}


FOLDER = "closed-loops"
"""Name of their folder in the user's cache."""

_LOG = logging.getLogger("safe_envs")

_IN_USE: weakref.WeakValueDictionary[str, ClosedLoopTable] = weakref.WeakValueDictionary()
"""Tables of this process, by their keys."""


def closed_loop_for(
    loop: ClosedLoop, progress: Callable[[float], None] | None = None
) -> ClosedLoopTable:
    """Return the table of a closed loop: one that is kept, or else a new one, which is then kept.

    Two processes do not compute the same: the second one waits. An interrupted computation leaves
    nothing behind.

    Args:
        loop: the closed loop.
        progress: called with the part of the work that is done.

    Raises:
        ConfigurationError: No table of it takes minutes and fits into memory.
    """
    grid = loop.grid()
    key = _key(loop, grid)
    folder = cache_folder(FOLDER)
    place = None if folder is None else folder / f"{key}.npz"
    table = _kept(loop, grid, key, place)
    if table is not None:
        return table
    with ExitStack() as stack:
        if place is not None:
            with suppress(ConfigurationError):  # The disk may be full.
                stack.enter_context(locked(place.with_suffix(".lock"), "", lambda: _tell(loop)))
            table = _kept(loop, grid, key, place)
        if table is None:
            table = loop.table(grid, progress=progress)
            if place is not None:
                _keep(table, loop, place)
    _IN_USE[key] = table
    return table


def _key(loop: ClosedLoop, grid: Grid) -> str:
    """Return the name of a table; another version of the package may compute another one."""
    described = [FORMAT, package_version(), loop.fingerprint(), list(grid.shape)]
    return hashlib.sha256(json.dumps(described).encode()).hexdigest()


def _kept(loop: ClosedLoop, grid: Grid, key: str, place: Path | None) -> ClosedLoopTable | None:
    """Return a table of memory or of a file, marked as used; None where there is none."""
    table = _IN_USE.get(key)
    if table is not None or place is None or not place.is_file():
        return table
    try:
        table = load_closed_loop(place, loop, grid)
    except ValueFileError as error:
        _LOG.warning("%s; it is computed again where it is asked for", error)
        return None
    mark_used(place)
    _IN_USE[key] = table
    return table


def _keep(table: ClosedLoopTable, loop: ClosedLoop, place: Path) -> None:
    try:
        save_closed_loop(table, loop, place)
    except ConfigurationError as error:
        _LOG.warning("the table is not kept: %s", error)
    make_room()


def _tell(loop: ClosedLoop) -> None:
    name = shown(loop.problem.name)
    _LOG.warning("another process computes the closed loop of %s: it is waited for", name)
