"""Values of temporal specifications, against quadrature, the values of safety, and simulation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents.policies.best import BestPolicy
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.filters.specification import SpecificationTracker
from safe_envs.registry import make_problem
from safe_envs.values.look_ahead import LookAhead, start_values
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueFileError, ValueSettings, load_table, save_table
from tests.oracles.satisfaction import measure_satisfaction
from tests.oracles.walks import (
    NOISE,
    PERIOD,
    POINTS,
    SPEED,
    STEPS,
    WITHIN,
    exact_values,
    labels_of,
    walk,
)

QUADRATURE = 2e-3
"""Error of the quadrature: one in the place of the points by half a width."""

CLOSE = 0.3
"""What the envelopes of 160 cells may differ by, where steps are 20 cells long."""

ROUNDING = 1e-6

TEXTS = [
    "always safe",
    "always safe & eventually goal",
    "safe until goal",
    "always safe & eventually (left then right)",
    "eventually (right then left) & !(safe until left)",
    "eventually[3,9] right & always[10,16] safe",
    "always (safe | right) & eventually[5,16] left",
]


def table_of(problem, text, leaving="violation", cells=160):
    """Return the table of a walk, and what reads it."""
    settings = ValueSettings(leaving=leaving, specification=text, cells=(cells,), inputs=17)
    table = solve(problem, settings)
    look_ahead = LookAhead(table, problem)
    assert look_ahead.automaton is not None
    return table, look_ahead, look_ahead.automaton


CASES = [
    *((text, False, "violation") for text in TEXTS),
    (TEXTS[1], True, "violation"),
    (TEXTS[3], True, "violation"),
    (TEXTS[1], False, "safe"),
    (TEXTS[4], True, "safe"),
]


@pytest.mark.parametrize(("text", "moves", "leaving"), CASES)
def test_envelopes_hold_the_values_and_are_close(text, moves, leaving):
    problem = walk(moves=moves)
    table, look_ahead, automaton = table_of(problem, text, leaving)
    exact = exact_values(automaton, moves=moves, leaving=leaving)
    rows = np.flatnonzero(WITHIN)[::7]
    for k in (0, 1, 5, STEPS - 1):
        states = (POINTS[rows], *([np.full(len(rows), -0.8 + 0.02 * k)] if moves else []))
        at = np.full(len(rows), k)
        if k == 0:
            a = look_ahead.first_states(states)
            begun = automaton.step(0, automaton.initial, labels_of(automaton, 0, moves))
            np.testing.assert_array_equal(a, begun[rows])
        else:
            before = np.random.default_rng(k).choice(reachable(automaton, k - 1), len(rows))
            a = look_ahead.next_states(at, states, before)
        value = exact[k, rows, a]
        lower = look_ahead.scanned(at, states, a).max(axis=1)
        upper = look_ahead.largest(at, states, a)
        assert (lower <= value + QUADRATURE).all()
        assert (value <= upper + QUADRATURE).all()
        assert (upper - lower).max() < CLOSE
        stored = look_ahead.values(at, states, a)
        assert (stored <= value + QUADRATURE).all()
        assert (stored <= lower + ROUNDING).all()
    assert (table.lower <= table.upper).all()


def test_staying_safe_as_a_specification_has_the_values_of_safety():
    problem = walk(goal=False)
    settings = ValueSettings(cells=(80,), inputs=9)
    plain = solve(problem, settings)
    table = solve(problem, dataclasses.replace(settings, specification="always safe"))
    assert table.first == plain.first
    # Any input gives a lower envelope: that of a specification tries fewer of them.
    np.testing.assert_allclose(table.lower, plain.lower, atol=1e-3)
    np.testing.assert_array_equal(table.upper, plain.upper)
    points = (np.linspace(-0.99, 0.99, 31),)
    both = [LookAhead(each, problem).start_bounds(points) for each in (plain, table)]
    np.testing.assert_allclose(both[0], both[1], atol=1e-3)


def test_values_that_rest_for_long_change_again_where_a_window_opens():
    problem = dataclasses.replace(walk(goal=False), horizon=40.0)
    table, look_ahead, automaton = table_of(problem, "eventually[2,5] left", cells=40)
    assert table.first == 0
    (lower,), (upper,) = look_ahead.start_bounds((np.array([0.5]),))
    assert 0.1 < lower < upper < 1.0
    # After the window all is settled.
    x, at = (np.array([-0.4, 0.5]),), np.array([6, 6])
    a = np.flatnonzero(automaton.verdicts[-1] != 0)[:1].repeat(2)
    verdict = automaton.verdict(6, a)
    np.testing.assert_array_equal(look_ahead.values(at, x, a), verdict > 0)


def test_the_greedy_policy_keeps_what_the_lower_envelope_says():
    problem, text, episodes = walk(moves=True), TEXTS[3], 3000
    _, look_ahead, automaton = table_of(problem, text, cells=100)
    rng = np.random.default_rng(0)
    x = [np.zeros(episodes), np.full(episodes, -0.8)]
    a = look_ahead.first_states(tuple(x))
    lower, upper = (bound[0] for bound in look_ahead.start_bounds(tuple(c[:1] for c in x)))
    tracker = SpecificationTracker(problem, text, episodes)
    tracker.begin(tuple(x), np.ones(episodes, dtype=bool))
    going, lost = np.ones(episodes, dtype=bool), np.zeros(episodes, dtype=bool)
    for k in range(STEPS):
        u, _ = look_ahead.best_input(np.full(episodes, k), tuple(x), a)
        noise = NOISE * np.sqrt(PERIOD) * rng.standard_normal(episodes)
        x[0] = np.where(going, x[0] + PERIOD * u[:, 0] + noise, x[0])
        x[1] = np.where(going, x[1] + PERIOD * SPEED, x[1])
        moved = tuple(c[going] for c in x)
        a[going] = look_ahead.next_states(np.full(going.sum(), k + 1), moved, a[going])
        tracker.advance(tuple(x))
        np.testing.assert_array_equal(a[going], tracker.states[going])
        lost |= going & (np.abs(x[0]) > 1.0)
        going &= (np.abs(x[0]) <= 1.0) & (x[0] < 0.7)
    rate = (automaton.accepting[a] & ~lost).mean()
    doubt = 4.0 * np.sqrt(0.25 / episodes)
    assert 0.1 < lower < upper
    assert lower - doubt < rate < upper + doubt


def test_a_table_of_other_regions_is_refused(tmp_path):
    problem = walk()
    table, _, _ = table_of(problem, TEXTS[3], cells=20)
    save_table(table, tmp_path / "table.npz")
    assert load_table(tmp_path / "table.npz", problem).states == table.states == 3
    wider = {**problem.regions, "left": problem.regions["left"] + 0.01}
    with pytest.raises(ValueFileError, match="earlier version"):
        load_table(tmp_path / "table.npz", dataclasses.replace(problem, regions=wider))
    with pytest.raises(ConfigurationError, match="another problem"):
        LookAhead(table, dataclasses.replace(problem, regions=wider))


@pytest.mark.parametrize(
    ("text", "fragment"),
    [("eventually nowhere", "nowhere"), ("always (safe", "13"), ("eventually[0,99] left", "99")],
)
def test_what_is_no_specification_of_the_problem_is_refused(text, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        solve(walk(), ValueSettings(specification=text))


@pytest.mark.oracle
def test_greedy_episodes_of_dubins_reach_lie_between_the_envelopes():
    problem, text = make_problem("safe_envs/DubinsReach-v0"), "always safe & eventually goal"
    settings = ValueSettings(knowledge="plant", cells=(100, 100, 64), specification=text)
    policy = BestPolicy(problem, settings)
    bounds = start_values(policy.look_ahead, problem)
    low, high = measure_satisfaction(SafeVectorEnv(problem, 1000), policy, text, 4000).interval(
        0.9999
    )
    assert bounds.lower <= high
    assert low <= bounds.upper


def reachable(automaton, k):
    """Return the states of an automaton that some trace has after instant k, and goes on from."""
    goal = 1 << automaton.atoms.index("goal") if "goal" in automaton.atoms else 0
    labels = [i for i in range(automaton.transitions.shape[2]) if not i & goal]
    found = {automaton.initial}
    for instant in range(k + 1):
        found = {int(automaton.step(instant, a, i)) for a in found for i in labels}
    return sorted(found)
