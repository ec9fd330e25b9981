"""Returns that can be had at a price on becoming unsafe, by dynamic programming.

With a price c that is paid once, at the first control instant outside the safe set C, and with
V_k(x) the largest expected return from x at instant k after a violation,

    J_k(x) = max_u E[r(x', u, t_{k+1}) + 1{x' in C} J_{k+1}(x') + 1{x' not in C} (V_{k+1}(x') - c)],

where an episode that has ended is worth 0 from then on. For the policies whose chance of a
violation is v and whose mean return is R, R - c v <= J_0(c), the mean over the starts; so R <=
J_0(c) + c v for every price c. The least of these lines is concave in v: it is the upper concave
envelope of what can be had, also by policies that draw lots between others.

Values between nodes are interpolated: the lines are computed, not proved. On a coarse grid cubic
polynomials, along one or two axes, make the largest values a little too large, since inputs are
chosen where they overshoot; linear interpolation, along three axes, acts like further noise and
makes values too small.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.wrappers.value.cell_sets import Sets, hull_of
from safe_envs.wrappers.value.node_grid import NodeGrid
from safe_envs.wrappers.value.priced_steps import PricedStep, Steps
from safe_envs.wrappers.value.priced_values import FrontierSettings, PricedValues
from safe_envs.wrappers.value.rewarded import rewarded
from safe_envs.wrappers.value.scanned_inputs import scanned_inputs
from safe_envs.wrappers.value.starts import draw_starts
from safe_envs.wrappers.value.sweeps import threads

_NODES = {1: (1001,), 2: (130, 110), 3: (44, 44, 40)}
_WHOLE = {1: (1001,), 2: (100, 100), 3: (36, 36, 32)}
_INPUTS = {1: 21, 2: 7}
_FEW_INPUTS = 3
_LEAST_PRICE, _LARGEST_PRICE = 0.01, 30.0
"""In parts of the largest difference of two returns."""

_ENTRIES = 3_000_000
"""Of points that are looked at at once."""

_BYTES = 1e9
"""Of the tables that policies need, unless cells are asked for."""

_MOST_BYTES = 4e9
"""Of the same tables, whatever is asked for."""

_STARTS = 20_000

Progress = Callable[[float], None]


def price_violations(
    problem: SafetyProblem,
    settings: FrontierSettings | None = None,
    progress: Progress | None = None,
) -> PricedValues:
    """Compute the largest returns at several prices of a violation.

    Args:
        problem: whose plant is controlled.
        settings: what is asked for.
        progress: called with the part of the work that is done.

    Returns:
        The values, and what their policies need.

    Raises:
        ConfigurationError: There are too many coordinates, what happens depends on time, or the
            tables do not fit the memory.
    """
    return _Frontier(problem, settings or FrontierSettings()).run(progress)


class _Part(NamedTuple):
    """Some nodes, and a control period from them."""

    rows: np.ndarray
    points: list[np.ndarray]
    steps: Steps


class _Frontier:
    def __init__(self, problem: SafetyProblem, settings: FrontierSettings) -> None:
        self._begun = time.perf_counter()
        self._settings = settings
        self._given = given = rewarded(problem)
        small = given.small
        self._inputs = scanned_inputs(small.box, _INPUTS.get(len(small.box), _FEW_INPUTS)).values
        self._step = PricedStep(given, self._inputs, settings.leaving)
        self._safe_grid, self._whole_grid = self._grids()
        nodes = _around(self._safe_grid, self._step)
        self._known = np.full(self._safe_grid.size, -1)
        self._known[nodes] = np.arange(len(nodes))
        self._nodes = nodes

    def _grids(self) -> tuple[NodeGrid, NodeGrid]:
        small, settings = self._given.small, self._settings
        n = len(small.coordinates)
        turning = [bool(c.period) for c in small.coordinates]
        hull = hull_of(small, Sets(small, "violation"))
        ends = [(float(edges[0]), float(edges[-1])) for edges in hull]
        if settings.cells is not None and len(settings.cells) != n:
            names = ", ".join(map(str, small.symbols))
            raise ConfigurationError(
                f"cells = {'x'.join(map(str, settings.cells))}; {small.problem.name} has the"
                f" coordinates {names}: give a number for each"
            )
        counts = np.array(settings.cells or _NODES[n])
        needed = 4.0 * math.prod(counts.tolist()) * small.steps * max(settings.policies, 1)
        if settings.cells is None and needed > _BYTES:
            counts = np.maximum((counts * (_BYTES / needed) ** (1 / n)).astype(int), 8)
        elif needed > _MOST_BYTES:
            raise ConfigurationError(
                f"cells = {'x'.join(map(str, settings.cells or ()))} take"
                f" {needed / 1e9:.3g} GB at {small.steps} steps; give fewer: at most"
                f" {_MOST_BYTES / 1e9:g} GB are taken"
            )
        whole = [
            (-0.5 * c.period, 0.5 * c.period) if c.period else (c.low, c.high)
            for c in small.coordinates
        ]
        around = _WHOLE[n] if settings.cells is None else counts
        return (
            NodeGrid.over(ends, counts.tolist(), turning),
            NodeGrid.over(whole, [int(c) for c in around], turning),
        )

    def run(self, progress: Progress | None) -> PricedValues:
        small, settings = self._given.small, self._settings
        with ThreadPoolExecutor(threads(), "safe_envs_frontier") as pool:
            safe, whole = self._safe_parts(pool), self._violated_parts(pool)
            prices = self._prices(safe, whole)
            kind = np.uint8 if len(self._inputs) <= 256 else np.uint16
            kept = _spread(settings.prices, settings.policies)
            safe_values = np.zeros((small.steps, len(self._nodes), len(kept)), np.float32)
            violated_values = np.zeros((small.steps, self._whole_grid.size), np.float32)
            violated_choice = np.zeros((small.steps, self._whole_grid.size), kind)
            ahead = np.zeros((len(self._nodes), settings.prices), np.float32)
            after = np.zeros((self._whole_grid.size, 1), np.float32)
            for k in range(small.steps - 1, -1, -1):
                safe_values[k], violated_values[k] = ahead[:, kept], after[:, 0]
                work = [pool.submit(self._best, part, k, ahead, after, prices) for part in safe] + [
                    pool.submit(self._best, part, k, None, after, None) for part in whole
                ]
                ahead, after = np.empty_like(ahead), np.empty_like(after)
                for i, (part, done) in enumerate(zip(safe + whole, work, strict=True)):
                    values, choice = done.result()
                    if i < len(safe):
                        ahead[part.rows] = values
                    else:
                        after[part.rows], violated_choice[k, part.rows] = values, choice[:, 0]
                if progress:
                    progress((small.steps - k) / small.steps)
        found = PricedValues(
            self._given,
            settings,
            prices,
            np.zeros(0),
            self._inputs,
            self._safe_grid,
            self._whole_grid,
            self._known,
            self._step,
            kept,
            ahead,
            after,
            safe_values,
            violated_values,
            violated_choice,
            0.0,
        )
        means = found.at_starts(draw_starts(small.problem, _STARTS, 0)).mean(axis=0)
        return replace(found, values=means, seconds=time.perf_counter() - self._begun)

    def _best(
        self, part: _Part, k: int, ahead: Any, after: np.ndarray, prices: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest values of some nodes, and the inputs that attain them."""
        steps = part.steps
        reward = self._step.rewards(part.points, k) if self._moves else steps.reward
        shape = reward.shape
        gain = reward.astype(np.float32)[:, :, None]
        if steps.violated is not None:
            gain = gain + (steps.violated @ after).reshape(*shape, 1)
        if prices is not None:
            gain = gain + (steps.safe @ ahead).reshape(*shape, -1)
            if steps.exits.any():
                gain -= (steps.exits[:, :, None] * prices).astype(np.float32)
        best = gain[0].copy()
        choice = np.zeros(best.shape, np.uint16)
        for u in range(1, len(gain)):
            better = gain[u] > best
            np.copyto(best, gain[u], where=better)
            choice[better] = u
        if prices is not None:
            _limit(best, prices.astype(np.float32))
        return best, choice

    @property
    def _moves(self) -> bool:
        return self._given.depends_on_time

    def _prices(self, safe: Sequence[_Part], whole: Sequence[_Part]) -> np.ndarray:
        rewards = [part.steps.reward for part in (*safe, *whole)]
        spread = max(float(r.max()) for r in rewards) - min(float(r.min()) for r in rewards)
        scale = (spread or 1.0) * self._given.small.steps
        further = np.geomspace(_LEAST_PRICE, _LARGEST_PRICE, self._settings.prices - 1)
        return np.concatenate([[0.0], scale * further])

    def _safe_parts(self, pool: ThreadPoolExecutor) -> list[_Part]:
        found = []
        points = self._safe_grid.points(self._nodes)
        near = np.concatenate(
            [
                self._step.near_edge([c[part] for c in points])
                for part in _pieces(len(self._nodes), self._size(16))
            ]
        )
        for is_near in (False, True):
            rows = np.flatnonzero(near == is_near)
            size = self._size(64 if is_near else 16)
            for part in _pieces(len(rows), size):
                own = rows[part]
                q = [c[own] for c in points]
                found.append((own, q, pool.submit(self._steps, q, is_near)))
        return [_Part(own, q, done.result()) for own, q, done in found]

    def _steps(self, q: list[np.ndarray], near: bool) -> Steps:
        return self._step.steps(q, near, self._safe_grid, self._known, self._whole_grid)

    def _violated_parts(self, pool: ThreadPoolExecutor) -> list[_Part]:
        points = self._whole_grid.points(np.arange(self._whole_grid.size))
        found = []
        for part in _pieces(self._whole_grid.size, self._size(16)):
            q = [c[part] for c in points]
            done = pool.submit(self._step.violated_steps, q, self._whole_grid)
            found.append((np.arange(part.start, part.stop), q, done))
        return [_Part(own, q, done.result()) for own, q, done in found]

    def _size(self, noises: int) -> int:
        return max(1, _ENTRIES // (noises * len(self._inputs) * 2 ** len(self._safe_grid.counts)))


def _limit(values: np.ndarray, prices: np.ndarray) -> None:
    """Remove what interpolation overshoots: a price costs between nothing and itself."""
    for i in range(1, len(prices)):
        before = values[:, i - 1]
        np.clip(values[:, i], before - (prices[i] - prices[i - 1]), before, out=values[:, i])


def _spread(prices: int, policies: int) -> np.ndarray:
    """Return which prices' policies are kept: the first, the last, and some between."""
    return np.unique(np.linspace(0, prices - 1, min(policies, prices)).round().astype(int))


def _pieces(count: int, size: int) -> list[slice]:
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


def _around(grid: NodeGrid, step: PricedStep) -> np.ndarray:
    """Return the nodes that are safe, and those next to them."""
    safe = step.is_safe(grid.points(np.arange(grid.size)))
    if not safe.any():
        raise ConfigurationError(
            "no node of the grid of returns is safe: the safe set is too small or too narrow for"
            " it; give more cells"
        )
    return np.flatnonzero(grid.around_marked(safe))
