"""With several inputs, only what has to change is changed."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.agents import make_policy
from safe_envs.agents.evaluation.compiled_episodes import CompiledEpisodes
from safe_envs.agents.evaluation.episodes import play
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.proofs.backup_filter import BackupFilter
from safe_envs.proofs.backup_search import DIFFERENCE, LEFT, aims
from safe_envs.wrappers import SafetyFilterVectorWrapper
from tests.agents.evaluation.test_compiled_episodes import assert_alike
from tests.oracles.carts import STRONGEST, cart_filter, table_problem


@pytest.fixture(scope="module")
def guard():
    return BackupFilter.for_problem(table_problem())


def drawn(count):
    rng = np.random.default_rng(2)
    states = np.column_stack(
        [rng.uniform(lo, hi, count) for lo, hi in ((-1, 1), (0, 1.5), (-1, 0), (-1, 1))]
    )
    return states, rng.uniform(-STRONGEST, STRONGEST, (count, 2))


def test_the_input_along_the_wall_is_left_as_it_was(guard):
    states, proposed = drawn(2000)
    proposed[:, 0] = STRONGEST
    found = guard.filter(states, proposed)
    alone = cart_filter().filter(states[:, :2], proposed[:, :1])
    changed = found.feasible & found.active[:, 0]
    assert changed.sum() > 100
    along = np.abs(found.action - proposed)[changed, 1]
    assert np.median(along) < 1e-9
    # Where the instant of the peak changes on the way, the slopes are of another one.
    assert (along > 0.1).mean() < 0.1
    # And the other one is about as near as that of the cart on its own.
    lost = (alone.action - found.action)[changed, 0]
    assert np.abs(lost).max() < 2 * STRONGEST / 8
    assert np.mean(lost) < 2 * STRONGEST / 64


def test_nothing_is_executed_that_was_not_verified(guard):
    states, proposed = drawn(500)
    found = guard.filter(states, proposed)
    again = guard.filter(states, found.action)
    assert np.array_equal(again.feasible, found.feasible)
    assert not again.active[found.feasible].any()
    np.testing.assert_allclose(
        again.margin[found.feasible], found.margin[found.feasible], atol=1e-12
    )


def test_one_state_is_decided_as_in_a_batch(guard):
    states, proposed = drawn(60)
    together = guard.filter(states, proposed)
    assert together.active.any()
    for i in range(60):
        alone = guard.filter(states[i], proposed[i])
        np.testing.assert_allclose(alone.action, together.action[i], atol=1e-9)


def test_the_aim_keeps_the_linear_model_and_the_bounds(guard):
    states, proposed = drawn(200)
    plans, floor = guard.plans, guard.floor
    x = plans.part(tuple(states.T))
    (begin,) = plans.inputs(x)
    aim = np.array(aims(plans, 0, x, (begin, tuple(proposed.T)), floor))
    assert np.abs(aim).max() <= STRONGEST
    # Nothing but the wall is near, and no plan's distance to it depends on the other input.
    np.testing.assert_allclose(aim[1], proposed[:, 1], atol=1e-9)
    changed = aim[0] < proposed[:, 0] - 1e-9
    assert 5 < changed.sum() < 195
    slope = DIFFERENCE * 2 * STRONGEST
    moved = (begin[0] + slope, begin[1])
    low, higher = (plans.whole(0, x, u)[1][0] for u in (begin, moved))
    model = low + (higher - low) / slope * (aim[0] - begin[0])
    least = floor + LEFT * np.maximum(low - floor, 0.0)
    inside = changed & (low > floor)
    np.testing.assert_allclose(model[inside], least[inside], atol=1e-6)


def test_a_program_plays_the_episodes_of_numpy():
    problem = table_problem(horizon=1.5)
    actor, guard = make_policy("nominal", problem), BackupFilter.for_problem(problem)
    env = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 4), "backup")
    program = CompiledEpisodes(problem, actor, guard, False)
    expected = list(play(env, actor, range(8), 3))
    found = list(program.play(program.program.plain(), range(8), 3, 1, lambda _: []))
    assert sum(batch.results.interventions.sum() for batch in expected) > 8
    assert_alike(found, expected, relative=1e-7)


def test_from_the_kernel_nothing_makes_it_infeasible(guard):
    rng = np.random.default_rng(3)
    env = SafetyFilterVectorWrapper(SafeVectorEnv(table_problem(horizon=10.0), 100), guard)
    env.reset(seed=0)
    for k in range(60):
        proposed = rng.uniform(-1.0, 1.0, (100, 2))
        proposed[::2] = np.sign(proposed[::2])
        info = env.step(proposed)[-1]
        assert info["feasible"].all(), k
        assert (info["barrier"] > 0.0).all()
