"""What the backup filter keeps, against exact kernels, and that it never becomes infeasible."""

from __future__ import annotations

import numpy as np
import pytest

from tests.oracles.carts import (
    STRONGEST,
    cart_filter,
    drawn,
    highest,
    moved,
    settings,
)


def test_the_kept_set_is_the_kernel_of_held_inputs():
    states, proposed = drawn(20_000)
    found = cart_filter().filter(states, proposed)
    clear = np.abs(highest(states) - 1.0) > 1e-9
    kept = highest(states) <= 1.0
    assert (found.feasible == kept)[clear].all()
    assert 0.2 < kept.mean() < 0.9


def test_an_input_is_allowed_exactly_where_it_leads_into_the_kernel():
    states, proposed = drawn(20_000)
    found = cart_filter().filter(states, proposed)
    reached = moved(states, proposed)
    level = np.maximum(reached[:, 0], highest(reached))
    clear = np.abs(level - 1.0) > 1e-8
    passed = (found.action == proposed)[:, 0]
    assert (passed == (level <= 1.0))[clear].all()
    # Where it is not, the largest input that does is missed by a step of the search at most.
    changed = ~passed & found.feasible & clear
    assert changed.sum() > 500
    u = found.action[changed, 0]
    reached = moved(states[changed], found.action[changed])
    assert np.maximum(reached[:, 0], highest(reached)).max() <= 1.0
    step = (proposed[changed, 0] + STRONGEST) / 64
    beyond = moved(states[changed], (u + step)[:, None])
    assert (np.maximum(beyond[:, 0], highest(beyond)) > 1.0 - 1e-8).all()


@pytest.mark.parametrize("dt", [0.1, 0.01, 0.001])
def test_the_kept_set_approaches_that_of_continuous_control(dt):
    rng = np.random.default_rng(1)
    speed = rng.uniform(0.0, 2.0, 500)
    edge = 1.0 - speed**2 / (2 * STRONGEST)
    guard = cart_filter(dt=dt)
    # Between control instants the cart may be beyond by what it climbs in half a period.
    over = STRONGEST * dt**2 / 8
    rest = np.zeros((500, 1))
    inside = guard.filter(np.column_stack([edge - 1e-9, speed]), rest)
    outside = guard.filter(np.column_stack([edge + over + 1e-9, speed]), rest)
    stays = speed > STRONGEST * dt  # else it is in the terminal set one instant later
    assert inside.feasible.all()
    assert not outside.feasible[stays].any()


def test_from_the_kernel_nothing_makes_it_infeasible():
    """1e5 steps of random and of hostile proposals, in the env's own arithmetic."""
    states, _ = drawn(4000, seed=3)
    states = states[highest(states) <= 1.0 - 1e-9][:1000]
    guard, rng = cart_filter(), np.random.default_rng(4)
    lowest = np.inf
    for k in range(100):
        proposed = rng.uniform(-2 * STRONGEST, 2 * STRONGEST, (1000, 1))
        proposed[::2] = STRONGEST
        found = guard.filter(states, proposed)
        assert found.feasible.all(), k
        assert np.abs(found.action).max() <= STRONGEST
        states = moved(states, found.action)
        lowest = min(lowest, (1.0 - states[:, 0]).min())
    assert lowest >= 0.0
    assert (states[::2, 0] > 0.99).mean() > 0.5  # it lets them come close


def test_a_margin_holds_at_every_instant():
    states, _ = drawn(4000, seed=5)
    states = states[highest(states) <= 0.9][:500]
    guard = cart_filter(settings=settings(margin=0.05))
    for _ in range(60):
        states = moved(states, guard.filter(states, np.full((500, 1), STRONGEST)).action)
    assert 0.05 <= (1.0 - states[:, 0]).min() < 0.06


def test_a_short_horizon_keeps_less_and_stays_feasible():
    states, proposed = drawn(4000, seed=6)
    long, short = cart_filter(), cart_filter(horizon=0.5)
    at_ease = short.filter(states, proposed).feasible
    assert (long.filter(states, proposed).feasible[at_ease]).all()
    # v <= 0 after 1 + 5 periods of full braking.
    assert (states[at_ease, 1] <= 0.6 * STRONGEST + 1e-12).all()
    states = states[at_ease]
    for _ in range(40):
        found = short.filter(states, np.full((len(states), 1), STRONGEST))
        assert found.feasible.all()
        states = moved(states, found.action)
    assert states[:, 0].max() <= 1.0
