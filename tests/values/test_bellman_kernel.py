"""The kernels, compiled and plain, and their twin for arrays give the same numbers."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Program, is_available
from safe_envs.values import bellman_arrays
from safe_envs.values.bellman_kernel import expected_values, sweep_lower, sweep_upper
from safe_envs.values.expected_value_kernel import AXES
from safe_envs.values.grid import Axis, Grid, grid_arrays
from safe_envs.values.input_search import scanned_inputs

ENTRIES = (expected_values, sweep_lower, sweep_upper)
PROGRAM = Program("dynamic programs", ENTRIES, Source(""))
KINDS = ["plain", *["compiled"] * is_available()]


def functions(kind):
    return getattr(PROGRAM, kind)()


class Case:
    """Random images on a random grid."""

    def __init__(self, n, *, periodic, inputs=3, states=5, seed=0, several=False):
        rng = self.rng = np.random.default_rng([n, seed])
        axes = []
        for i in range(n):
            edges = np.sort(rng.uniform(-1, 1, rng.integers(3, 8)))
            edges[0], edges[-1] = -1.0, 1.0
            axes.append(Axis(edges, 2.0 if periodic and i % 2 == 0 else 0.0))
        self.grid = Grid(tuple(axes))
        m, self.count = 2, states
        scanned = scanned_inputs([(-1.0, 0.5), (0.0, 1.0)], inputs)
        self.inputs, self.neighbours = scanned.boxes, scanned.neighbours
        tried, scenarios, boxes = self.inputs.shape[1], 2, 3
        shape = (states, tried if several else 1, scenarios, boxes, n)
        low = rng.uniform(-2.2, 1.6, shape)
        self.images = np.stack([low, low + rng.choice([0, 0.1, 0.6, 2.5], shape)], axis=-1)
        effect = rng.uniform(-0.5, 0.5, (states, scenarios, n, m))
        self.effects = np.stack([effect, effect + rng.uniform(0, 0.2, effect.shape)], axis=-1)
        self.weights = rng.dirichlet(np.ones(boxes))
        self.tables = rng.random((2, self.grid.cells)).astype(np.float32)
        self.layers = rng.integers(0, 2, states)
        blocks = [int(b) for b in rng.integers(1, 3, n)]
        self.arrays = grid_arrays(self.grid, blocks=blocks)

    def expected(self, run, inputs):
        found = np.empty((self.count, inputs.shape[1]))
        run(
            0,
            self.count,
            self.images,
            self.effects,
            inputs,
            self.weights,
            self.layers,
            self.tables,
            -0.25,
            *self.arrays,
            np.zeros(2 * AXES),
            found,
        )
        return found

    def lower(self, run, turn, best, found):
        best, found = best.copy(), found.copy()
        run(
            0,
            self.count,
            turn,
            self.images,
            self.effects,
            self.inputs,
            self.weights,
            self.tables,
            0.0,
            self.neighbours,
            *self.arrays,
            np.zeros(2 * AXES),
            best,
            found,
        )
        return best, found

    def upper(self, run, tables, known, leader, rival):
        found = np.zeros(self.count)
        run(
            0,
            self.count,
            self.images,
            self.effects,
            self.inputs,
            self.weights,
            -tables,
            -0.01,
            *self.arrays,
            np.zeros(2 * AXES),
            known,
            leader,
            rival,
            found,
        )
        return found


def by_definition(case, a, u, layer):
    """Return the bound of a state under an input box, cell by cell."""
    worst = np.inf
    for r in range(case.images.shape[2]):
        total = 0.0
        for w, weight in enumerate(case.weights):
            chosen, leaves, misses = [], False, False
            for i, axis in enumerate(case.grid.axes):
                low, high = case.images[a, u if case.images.shape[1] > 1 else 0, r, w, i]
                for j in range(2):
                    ends = [b * c for b in case.effects[a, r, i, j] for c in case.inputs[0, u, j]]
                    low, high = low + min(ends), high + max(ends)
                block = case.arrays.counts[4 * AXES + i]
                if axis.period:
                    turns = [axis.period * t for t in range(-6, 7)]
                    touched = [
                        c
                        for c in range(axis.count)
                        if any(
                            axis.edges[c] + t <= high and axis.edges[c + 1] + t > low for t in turns
                        )
                    ]
                else:
                    leaves |= low < axis.edges[0] or high >= axis.edges[-1]
                    misses |= high < axis.edges[0] or low >= axis.edges[-1]
                    touched = [
                        c
                        for c in range(axis.count)
                        if axis.edges[c] <= high and axis.edges[c + 1] > low
                    ]
                del block
                chosen.append(touched)
            cells = [np.ravel_multi_index(c, case.grid.shape) for c in itertools.product(*chosen)]
            value = case.tables[layer][cells].min() if cells and not misses else 0.0
            if leaves and not misses:
                value = min(value, 0.0)
            total += weight * value
        worst = min(worst, total)
    return worst


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("periodic", [False, True])
def test_bounds_of_one_cell_an_entry_are_those_by_definition(n, periodic):
    case = Case(n, periodic=periodic, several=n == 2, states=3)
    case.arrays = grid_arrays(case.grid)
    found = case.expected(bellman_arrays.expected_values, case.inputs)
    for a in range(case.count):
        for v in range(case.inputs.shape[1]):
            wanted = by_definition(case, a, v, case.layers[a]) - 0.25
            assert found[a, v] == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("several", [False, True])
def test_expected_values(kind, n, periodic, several):
    case = Case(n, periodic=periodic, several=several)
    own = case.inputs + case.rng.uniform(-0.1, 0.1, (case.count, *case.inputs.shape[1:]))
    own.sort(axis=-1)
    for inputs in (case.inputs, own):
        found = case.expected(functions(kind)["expected_values"], inputs)
        wanted = case.expected(bellman_arrays.expected_values, inputs)
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_infinite_images_touch_everything(kind):
    case = Case(2, periodic=True)
    case.images[..., 0], case.images[..., 1] = -np.inf, np.inf
    for run in (functions(kind)["expected_values"], bellman_arrays.expected_values):
        with np.errstate(invalid="ignore"):
            assert (case.expected(run, case.inputs) <= 1e-6 - 0.25).all()
            case.tables = -np.ones_like(case.tables)
            np.testing.assert_allclose(case.expected(run, case.inputs), -1.25, rtol=1e-6)
            case.tables = -case.tables


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [1, 3])
def test_sweeps_for_lower_envelopes(kind, n):
    case = Case(n, periodic=True)
    case.tables = case.tables[:1]
    best = np.zeros(case.count, dtype=np.int64)
    best[-1] = -1
    inf = np.full(case.count, np.inf)
    twin = case.lower(bellman_arrays.sweep_lower, 0, best, inf)
    own = case.lower(functions(kind)["sweep_lower"], 0, best, inf)
    np.testing.assert_allclose(own[1], twin[1], rtol=1e-6)
    assert own[1][-1] == np.inf
    # With less to be won fewer inputs are tried, and none of them is better than the best.
    for turn in range(1, 20):
        _, found = case.lower(functions(kind)["sweep_lower"], turn, best, np.zeros(case.count))
        assert (found[:-1] <= twin[1][:-1] + 1e-7).all()


@pytest.mark.parametrize("kind", KINDS)
def test_sweeps_for_upper_envelopes(kind):
    case = Case(2, periodic=False, inputs=4, states=9)
    tables = case.tables[:1]
    tried = case.inputs.shape[1]
    known = np.full((case.count, tried), 2.0)
    leader, rival = np.zeros(case.count, dtype=np.int64), np.full(case.count, 2.0)
    twin = known.copy()
    for factor in (1.0, 0.9, 0.9, 0.5, 0.1):
        # Values that fall from sweep to sweep.
        tables = tables * np.float32(factor) * case.rng.uniform(0.5, 1, tables.shape).astype("f4")
        found = case.upper(functions(kind)["sweep_upper"], tables, known, leader, rival)
        wanted = case.upper(bellman_arrays.sweep_upper, tables, twin, leader.copy(), rival.copy())
        np.testing.assert_allclose(found, wanted, rtol=1e-6)
        assert (known >= twin - 1e-7).all()
