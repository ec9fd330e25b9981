"""Values of temporal specifications, against quadrature, the values of safety, and simulation."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.wrappers.value.look_ahead import LookAhead
from safe_envs.wrappers.value.settings import ValueSettings
from safe_envs.wrappers.value.solve import solve

from .walks import POINTS, STEPS, WITHIN, exact_values, labels_of, walk

QUADRATURE = 2e-3
"""Error of the quadrature: one in the place of the points by half a width."""

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
    return table, LookAhead(table, problem)


@pytest.mark.parametrize("leaving", ["violation", "safe"])
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("text", TEXTS)
def test_envelopes_hold_the_values_and_are_close(text, moves, leaving):
    problem = walk(moves=moves)
    table, look_ahead = table_of(problem, text, leaving)
    automaton = look_ahead.automaton
    exact = exact_values(automaton, moves=moves, leaving=leaving)
    rows = np.flatnonzero(WITHIN)[::7]
    gap = 0.0
    for k in (0, 1, 5, STEPS - 1):
        edge = -0.8 + 0.02 * k
        states = (POINTS[rows], *([np.full(len(rows), edge)] if moves else []))
        at = np.full(len(rows), k)
        if k == 0:
            a = look_ahead.first_states(states)
            begun = automaton.step(0, automaton.initial, labels_of(automaton, 0, moves))
            np.testing.assert_array_equal(a, begun[rows])
        else:
            # Of any state before, as far as the trace may have had it.
            before = np.random.default_rng(k).choice(reachable(automaton, k - 1), len(rows))
            a = look_ahead.next_states(at, states, before)
        value = exact[k, rows, a]
        lower = look_ahead.scanned(at, states, a).max(axis=1)
        upper = look_ahead.largest(at, states, a)
        assert (lower <= value + QUADRATURE).all()
        assert (value <= upper + QUADRATURE).all()
        assert (look_ahead.values(at, states, a) <= value + QUADRATURE).all()
        assert (look_ahead.values(at, states, a) <= lower + 1e-6).all()
        gap = max(gap, float((upper - lower).max()))
    assert gap < 0.1
    assert (table.lower <= table.upper).all()


def reachable(automaton, k):
    """Return the states of an automaton that some trace has after instant k, and goes on from."""
    goal = 1 << automaton.atoms.index("goal") if "goal" in automaton.atoms else 0
    labels = [i for i in range(automaton.transitions.shape[2]) if not i & goal]
    found = {automaton.initial}
    for instant in range(k + 1):
        found = {int(automaton.step(instant, a, i)) for a in found for i in labels}
    return sorted(found)
