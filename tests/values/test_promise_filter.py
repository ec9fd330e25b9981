"""The promise filter on a chain that is known exactly: what it keeps against a hostile policy."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, ControlAffineSDE
from safe_envs.errors import InvalidInputError
from safe_envs.problem.builder import state_problem
from safe_envs.values.promise_filter import PromiseFilter, PromiseMemory, PromiseSettings
from tests.oracles.exact_chain import SAFE, STATES, STEPS, Chain, U, X, chain_problem

EXACT, PROBLEM = Chain(), chain_problem()
V = sp.Symbol("v", real=True)
LINE = np.arange(STATES, dtype=float)
HOSTILE = np.array(
    [
        EXACT.inputs[EXACT.scanned(np.full(STATES, k), (LINE,)).argmin(axis=1), 0]
        for k in range(STEPS)
    ]
)
"""At each control instant and state, the input that does most against staying in C."""


def memory_of(p: float, envs: int, look_ahead: Chain = EXACT) -> PromiseMemory:
    return PromiseMemory(PromiseFilter(look_ahead, PromiseSettings(p), PROBLEM), envs)


def play(memory: PromiseMemory, starts: np.ndarray, seed: int = 0):
    """Return whether each episode was safe, and the mean of p_0."""
    rng, x = np.random.default_rng(seed), starts.astype(float)
    memory.begin((x,))
    begun = memory.levels.mean()
    safe = (x >= SAFE.start) & (x < SAFE.stop)
    for k in range(STEPS):
        u = HOSTILE[k, x.astype(int)]
        u = memory.decide_arrays((x,), (u,)).action[0]
        x = EXACT.moved(x, u, rng)
        memory.advance((x,), False)
        safe &= (x >= SAFE.start) & (x < SAFE.stop)
    return safe, begun


@pytest.mark.parametrize("p", [0.5, 0.9, 0.99])
def test_a_hostile_policy_leaves_what_was_asked_for(p):
    starts = np.full(6000, 15)
    safe, begun = play(memory_of(p, len(starts)), starts)
    error = 3.0 * np.sqrt(p * (1.0 - p) / len(starts))
    assert begun == pytest.approx(p)
    # The policy takes all that it is left: the filter does not do more than it has to.
    assert p - error <= safe.mean() <= p + error + 0.03


def test_a_q_that_is_half_a_percent_too_high_breaks_it():
    starts = np.full(6000, 15)
    memory = memory_of(0.9, len(starts), Chain(factor=1.005))
    safe, begun = play(memory, starts)
    assert begun == pytest.approx(0.9)
    assert safe.mean() < 0.85


def test_from_every_start_the_mean_of_p_0_is_kept():
    starts = np.repeat(np.arange(STATES), 200)
    memory = memory_of(0.999, len(starts))
    safe, begun = play(memory, starts)
    assert safe.mean() >= begun - 3.0 * np.sqrt(0.25 / len(starts))
    assert (memory.losses, memory.largest_loss < 1e-12) == (0, True)
    # Near the edge of C not even the best input has .999.
    assert 0.5 < begun < 0.9


def test_p_0_is_the_one_step_look_ahead_in_c_and_0_outside():
    x = LINE
    found = memory_of(0.9, STATES).safety_filter.start((x,))
    inside = (x >= SAFE.start) & (x < SAFE.stop)
    np.testing.assert_array_equal(found[~inside], 0.0)
    np.testing.assert_allclose(found[inside], np.minimum(EXACT.table[0, inside], 0.9), rtol=1e-12)
    assert found[inside].min() < 0.9 < EXACT.table[0].max()


def test_a_proposed_input_that_keeps_p_is_executed_exactly():
    memory = memory_of(0.9, 3)
    x, u = np.full(3, 15.0), np.array([0.123456789, -1.0, 1.0])
    memory.begin((x,))
    found = memory.decide_arrays((x,), (u,))
    np.testing.assert_array_equal(found.action[0], u)
    assert not found.active[0].any()
    assert found.feasible.all()


def test_the_input_is_the_nearest_that_keeps_p():
    # Close to the lower edge only inputs from some u* on keep p; the filter is to find u*.
    p = 0.97 * EXACT.table[0, 6]
    x = np.full(41, 6.0)
    u = np.linspace(-1.0, 1.0, 41)
    memory = memory_of(p, len(x))
    memory.begin((x,))
    found = memory.decide_arrays((x,), (u,)).action[0]
    fine = np.linspace(-1.0, 1.0, 200_001)
    q = EXACT.expected(np.array([0]), (x[:1],), fine[None, :, None])[0]
    allowed = fine[q >= p]
    nearest = allowed[np.abs(allowed[None] - u[:, None]).argmin(axis=1)]
    assert 0 < np.count_nonzero(np.abs(nearest - u) > 1e-4) < len(u)
    assert np.abs(found - nearest).max() < 0.25 / 64 + 1e-5
    assert (EXACT.expected(np.zeros(41, int), (x,), found[:, None, None])[:, 0] >= p).all()


def test_outside_c_and_after_an_exit_it_takes_the_best_input_and_says_so():
    memory = memory_of(0.9, 3)
    x = np.array([1.0, 15.0, 15.0])
    memory.begin((x,))
    assert memory.levels.tolist() == [0.0, 0.9, 0.9]
    memory.decide_arrays((x,), (np.zeros(3),))
    # The first is back in C, the second leaves it, and the third's episode ends in C.
    x = np.array([4.0, 1.0, 15.0])
    memory.advance((x,), np.array([False, False, True]))
    assert memory.levels[:2].tolist() == [0.0, 0.0]
    assert memory.levels[2] > 0.0
    x = np.array([4.0, 4.0, 4.0])
    found = memory.decide_arrays((x,), (np.full(3, -1.0),))
    assert not found.feasible.any()
    np.testing.assert_array_equal(found.action[0], 1.0)
    np.testing.assert_array_equal(memory.report()["promise"], 0.0)
    memory.advance((x,), False)
    np.testing.assert_array_equal(memory.levels, 0.0)
    np.testing.assert_array_equal(found.slack[0], 0.0)


def test_a_table_of_zeros_gives_nothing_and_no_nan():
    nothing = copy.copy(EXACT)
    nothing.table, nothing.ahead = 0.0 * EXACT.table, 0.0 * EXACT.ahead
    memory = memory_of(0.9, 2, nothing)
    x = (np.array([15.0, 3.0]),)
    memory.begin(x)
    for _ in range(3):
        found = memory.decide_arrays(x, (np.zeros(2),))
        memory.advance(x, False)
        assert np.isfinite([found.action[0], found.margin[0], memory.levels]).all()
        assert not found.feasible.any()


def test_one_state_is_a_batch_of_one():
    many, one = memory_of(0.95, 5), memory_of(0.95, 1)
    rng = np.random.default_rng(1)
    xs = rng.integers(4, 26, (6, 5)).astype(float)
    us = rng.uniform(-1.0, 1.0, (5, 5))
    many.begin((xs[0],))
    rows = []
    for k in range(5):
        found = many.decide_arrays((xs[k],), (us[k],))
        many.advance((xs[k + 1],), False)
        rows.append((found.action[0], found.feasible, found.slack[0], many.levels))
    for i in range(5):
        one.begin((xs[0, i].item(),))
        for k in range(5):
            found = one.decide_floats((xs[k, i].item(),), [us[k, i].item()])
            one.advance((xs[k + 1, i].item(),), False)
            action, feasible, slack, levels = (part[i].item() for part in rows[k])
            assert (found.action, found.feasible, found.slack) == ([action], feasible, [slack])
            assert one.levels[0] == levels
            assert type(found.feasible) is bool


def test_losses_are_counted():
    memory = memory_of(0.9, 2)
    x = (np.array([15.0, 15.0]),)
    memory.begin(x)
    memory.levels = np.array([0.9, 0.9999])
    found = memory.decide_arrays(x, (np.zeros(2),))
    top = EXACT.table[0, 15]
    assert memory.losses == 1
    assert memory.largest_loss == pytest.approx(0.9999 - top)
    np.testing.assert_allclose(found.slack[0], [0.0, 0.9999 - top], rtol=1e-9)
    np.testing.assert_allclose(memory.levels, [0.9, top])


def test_episodes_longer_than_the_table_are_refused():
    with pytest.raises(ConfigurationError, match=r"have 41 steps, and the table.*only 40"):
        PromiseFilter(EXACT, PromiseSettings(0.9), chain_problem(STEPS + 1))
    PromiseFilter(EXACT, PromiseSettings(0.9), chain_problem(STEPS - 1))


def test_beyond_the_table_nothing_is_promised():
    memory, x = memory_of(0.9, 1), np.array([15.0])
    memory.begin((x,))
    for _ in range(STEPS):
        assert memory.decide_arrays((x,), (np.zeros(1),)).feasible.all()
        memory.advance((x,), False)
    assert memory.levels[0] > 0.0
    assert not memory.decide_arrays((x,), (np.zeros(1),)).feasible.any()
    memory.advance((x,), False)
    assert (memory.levels.tolist(), memory.losses) == ([0.0], 0)


@pytest.mark.parametrize(
    "change",
    [
        {"promise": np.array([0.5, np.nan])},
        {"promise": np.array([0.5, 1.5])},
        {"promise": np.array([0.5])},
        {"instant": np.array([0, -1])},
        {"promise_ended": np.zeros(3, dtype=bool)},
    ],
)
def test_a_snapshot_of_no_promise_is_refused(change):
    memory = memory_of(0.9, 2)
    memory.begin((np.array([15.0, 15.0]),))
    with pytest.raises(InvalidInputError, match="for each of 2 envs"):
        memory.restore({**memory.snapshot(), **change})
    assert memory.levels.tolist() == [0.9, 0.9]


def test_a_copy_shares_the_table():
    memory = memory_of(0.9, 2)
    twin = copy.deepcopy(memory)
    assert twin.safety_filter is memory.safety_filter
    memory.begin((np.array([15.0, 15.0]),))
    assert twin.levels.tolist() == [0.0, 0.0]


class Plane:
    """Two inputs: q falls with their sum, so that inputs below a line are allowed."""

    steps = 1
    inputs = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-2, 2, 9)), -1).reshape(-1, 2)

    def values(self, k, x):
        return np.ones(len(k))

    def expected(self, k, x, u):
        return np.clip(0.6 - 0.1 * (u[..., 0] + u[..., 1]), 0.0, 1.0)

    def scanned(self, k, x):
        return self.expected(k, x, np.broadcast_to(self.inputs, (len(k), *self.inputs.shape)))

    def best_input(self, k, x):
        return np.broadcast_to(self.inputs[0], (len(k), 2)), self.scanned(k, x).max(axis=1)

    def sufficient(self, k, x, u, levels):
        return self.expected(k, x, u[:, None, :])[:, 0], np.full(len(u), np.inf)


def test_two_inputs_move_in_the_euclidean_distance():
    problem = state_problem(
        ControlAffineSDE((X,), (U, V), [0], [[1, 1]], [[0]]),
        1 - X**2,
        box=[(-1.0, 1.0), (-2.0, 2.0)],
        start=[0.0],
        dt=1.0,
        horizon=1.0,
    )
    chosen = PromiseFilter(Plane(), PromiseSettings(0.6), problem)
    rng = np.random.default_rng(0)
    u = tuple(rng.uniform(-1.0, 1.0, (2, 200)) * [[1.0], [2.0]])
    zeros = np.zeros(200)
    found = chosen.choose(zeros.astype(int), np.full(200, 0.6), (zeros,), u)
    # Allowed is u1 + u2 <= 0: the distance to that line is the least that can be had.
    distance = np.hypot(*np.subtract(found.action, u))
    least = np.maximum(u[0] + u[1], 0.0) / np.sqrt(2.0)
    np.testing.assert_array_equal(found.replaced, u[0] + u[1] > 0.0)
    assert (np.sum(found.action, axis=0) <= 1e-9).all()
    assert (distance >= least - 1e-9).all()
    assert (distance - least).max() < 0.25
    assert (np.abs(found.action[0]) <= 1.0).all()


class Peak(Plane):
    """One input, of which only a few values near 0.3125 are any good."""

    inputs = np.linspace(-1.0, 1.0, 33)[:, None]

    def expected(self, k, x, u):
        return np.clip(0.9 - 5.0 * np.abs(u[..., 0] - 0.3125), 0.0, 1.0)


def test_all_scanned_inputs_are_looked_at_before_anything_is_lost():
    # Of every fourth input none is allowed.
    chosen = PromiseFilter(Peak(), PromiseSettings(0.85), chain_problem(1))
    assert not (chosen.look_ahead.expected(0, 0, np.linspace(-1, 1, 9)[:, None]) >= 0.85).any()
    u, levels = np.array([-1.0, 0.5, 0.3130]), np.full(3, 0.85)
    x = (np.full(3, 15.0),)
    found = chosen.choose(np.zeros(3, dtype=int), levels, x, (u,))
    np.testing.assert_array_equal(found.level, levels)
    np.testing.assert_allclose(found.action[0], [0.3025, 0.3225, 0.3130], atol=1e-3)
    assert (found.expected >= 0.85).all()
    # More than the best one has is lowered to that.
    found = chosen.choose(np.zeros(3, dtype=int), np.full(3, 0.95), x, (u,))
    np.testing.assert_allclose(found.level, 0.9)
    np.testing.assert_allclose(found.action[0], 0.3125)
