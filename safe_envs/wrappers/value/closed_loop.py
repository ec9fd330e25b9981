"""What one controller attains, at least: a certified lower envelope of a closed loop.

Let u_k be any inputs, chosen without knowing the noise of their step, that lie in U(Z) whenever the
state is in the cell Z. If L_k <= 1_C and L_k <= Q^u L_(k+1) on each cell Z for *all* u of U(Z),
proposition 2 of the page on values holds along them, and they are safe with probability L_0(x_0) at
least. U(Z) is an interval that holds what the policy proposes, and the filter makes of it, anywhere
in Z; it is cut into parts, of which the worst counts. The table is computed with proved bounds, and
rounded down as it is stored: there is nothing to be taken off it.

Roundings of observations and actions to single precision are in U(Z), and so are the filter's.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from safe_envs.dynamics.codegen import Components
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.conditions.base import Condition
from safe_envs.wrappers.value.cell_sets import Sets
from safe_envs.wrappers.value.executed_inputs import ExecutedInputs, require_one_input
from safe_envs.wrappers.value.grid import Grid
from safe_envs.wrappers.value.proved_chain import ProvedChain
from safe_envs.wrappers.value.proved_steps import ProvedImages
from safe_envs.wrappers.value.reduction import ReducedProblem, reduced
from safe_envs.wrappers.value.settings import ValueSettings
from safe_envs.wrappers.value.smoothing import rounded_down
from safe_envs.wrappers.value.starts import draw_starts, sampling_margin
from safe_envs.wrappers.value.step_images import Step
from safe_envs.wrappers.value.suitable_grid import suitable_grid
from safe_envs.wrappers.value.windows import Bordered

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
