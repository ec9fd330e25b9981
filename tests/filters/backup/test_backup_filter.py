"""Decisions of the backup filter: one state and batches, several laws, the last resort, errors."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, InvalidInputError, SystemDefinitionError
from safe_envs.problem.backup import Backup, BackupLaw
from safe_envs.proofs.backup_filter import BackupFilter
from tests.oracles.carts import (
    BRAKE,
    DT,
    PULL,
    STRONGEST,
    a,
    backup,
    cart,
    cart_filter,
    cart_problem,
    drawn,
    settings,
    v,
    x,
)

BOUNDS = (-STRONGEST, STRONGEST)


def walls(laws=(BRAKE, PULL)):
    """-1 <= x <= 1; to brake at one wall may lead to the other."""
    far = tuple(
        replace(law, terminal=sp.Min(law.terminal, (1 + x) - 3 * v**2 / 2 - v**2))
        if law is BRAKE
        else replace(law, terminal=sp.Min(law.terminal, (1 - x) - 3 * v**2 / 2 - v**2))
        for law in laws
    )
    return BackupFilter(cart(), (1 - x, 1 + x), Backup(far, 4.0), BOUNDS, DT)


@pytest.mark.parametrize("guard", [cart_filter(), walls(), walls((PULL,))])
def test_one_state_is_decided_as_in_a_batch(guard):
    states, proposed = drawn(150, seed=7)
    together = guard.filter(states, proposed)
    assert len(np.unique(together.active)) == len(np.unique(together.feasible)) == 2
    for i, (state, u) in enumerate(zip(states, proposed, strict=True)):
        alone = guard.filter(state, u)
        for name in ("action", "margin", "slack", "barrier"):
            np.testing.assert_allclose(
                getattr(alone, name), getattr(together, name)[i], atol=1e-12, err_msg=name
            )
        for name in ("active", "feasible", "cause"):
            assert np.array_equal(getattr(alone, name), getattr(together, name)[i]), name
        components = guard.decide_floats(state.tolist(), u.tolist())
        np.testing.assert_allclose(components.action, together.action[i], atol=1e-12)
        assert components.feasible == together.feasible[i]


def test_batches_of_any_shape():
    states, proposed = drawn(12)
    flat = cart_filter().filter(states, proposed)
    shaped = cart_filter().filter(states.reshape(3, 4, 2), proposed.reshape(3, 4, 1))
    for part, other in zip(flat, shaped, strict=True):
        assert np.array_equal(part, np.reshape(other, np.shape(part)))
    assert shaped.action.shape == (3, 4, 1)
    assert shaped.feasible.shape == shaped.cause.shape == (3, 4)


def test_more_states_than_are_simulated_at_once():
    states, proposed = drawn(5000)
    together = cart_filter().filter(states, proposed)
    half = cart_filter().filter(states[2500:], proposed[2500:])
    assert np.array_equal(together.action[2500:], half.action)


def test_a_proposal_that_is_allowed_passes_to_the_last_bit():
    found = cart_filter().filter([-1.0, 0.1], [0.123456789])
    assert found.action.tolist() == [0.123456789]
    assert (found.active.tolist(), found.cause, found.slack.tolist()) == ([False], -1, [0.0])
    assert found.margin[0] == pytest.approx(1.0 + 1.0 - 0.1 * 0.1 - 0.5 * 0.1**2 * 0.1234, abs=0.01)


def test_a_proposal_beyond_its_bounds_is_clipped():
    found = cart_filter().filter([-1.0, 0.1], [7.0])
    assert found.action.tolist() == [STRONGEST]
    assert found.proposed.tolist() == [7.0]


def test_the_cause_is_the_barrier_that_the_proposal_violates():
    guard = walls()
    assert guard.filter([0.9, 0.3], [STRONGEST]).cause == 0
    assert guard.filter([-0.9, -0.3], [-STRONGEST]).cause == 1


def test_several_laws_keep_more_than_each_of_them():
    states, proposed = drawn(5000, seed=8)
    both, brake, pull = (
        guard.filter(states, proposed) for guard in (walls(), walls((BRAKE,)), walls((PULL,)))
    )
    assert (both.feasible >= (brake.feasible | pull.feasible)).all()
    assert both.feasible.sum() > max(brake.feasible.sum(), pull.feasible.sum())
    # Of the segments from both laws, that one is taken which comes nearer to the proposal.
    sure = brake.feasible & pull.feasible
    away = [np.abs(found.action - proposed)[sure, 0] for found in (both, brake, pull)]
    assert (away[0] <= np.minimum(away[1], away[2]) + 2 * STRONGEST / 64).all()


def test_where_nothing_keeps_safe_the_best_plan_is_followed_and_told():
    found = cart_filter().filter([0.9, 2.0], [STRONGEST])
    assert not found.feasible
    assert found.action.tolist() == [-STRONGEST]
    k = np.arange(1, 40) * DT
    peak = (0.9 + 2.0 * k - STRONGEST * k**2 / 2).max()
    assert found.slack[0] == pytest.approx(peak - 1.0, abs=1e-12)


def test_too_short_a_horizon_is_told_without_a_slack():
    found = cart_filter(horizon=0.2).filter([-9.0, 3.0], [0.0])
    assert (found.feasible, found.cause, found.slack.tolist()) == (False, -1, [0.0])


def test_a_law_without_a_value_does_not_become_an_action():
    law = BackupLaw("root", (sp.sqrt(x),), terminal=sp.Min(-v, 1 - x))
    guard = BackupFilter(cart(), 1 - x, backup(laws=(law,)), BOUNDS, DT)
    for found in (guard.filter([-1.0, 0.5], [0.1]), guard.filter([[-1.0, 0.5]] * 2, [[0.1]] * 2)):
        assert np.isfinite(found.action).all()
        assert not np.any(found.feasible)


def test_a_plan_that_overflows_is_not_allowed():
    grows = replace(cart(), drift=sp.Matrix([v, sp.exp(sp.exp(v))]))
    guard = BackupFilter(grows, 1 - x, backup(), BOUNDS, DT)
    for found in (guard.filter([-1.0, 7.0], [0.1]), guard.filter([[-1.0, 7.0]] * 2, [[0.1]] * 2)):
        assert not np.any(found.feasible)
        assert np.isfinite(found.action).all()


def test_states_that_plans_do_not_need_are_not_simulated():
    y = sp.Symbol("y", real=True)
    wider = replace(
        cart(),
        states=(y, x, v),
        drift=sp.Matrix([v**2, v, 0]),
        input_matrix=sp.Matrix([x, 0, 1]),
        diffusion=sp.zeros(3, 1),
    )
    guard = BackupFilter(wider, 1 - x, backup(), BOUNDS, DT)
    states, proposed = drawn(200)
    wide = np.column_stack([np.full(200, 5.0), states])
    assert len(guard.plans.part(tuple(wide.T))) == 2
    assert np.array_equal(
        guard.filter(wide, proposed).action, cart_filter().filter(states, proposed).action
    )


def test_with_noise_plans_are_of_the_mean_and_promise_nothing():
    problem = cart_problem(noise=0.1)
    guard = BackupFilter.for_problem(problem)
    assert guard.filter([-1.0, 0.1], [0.2]).action.tolist() == [0.2]
    assert guard.filter([0.9, 0.5], [1.0]).action[0] < 0.5
    assert "noise" in guard.why_not(problem.plant)
    assert BackupFilter.for_problem(cart_problem()).why_not(cart()) == ""
    assert "differs" in BackupFilter.for_problem(cart_problem()).why_not(
        replace(cart(), drift=sp.Matrix([v, 1]))
    )


def test_knowledge_says_whose_plans_are_simulated():
    weak = replace(cart(), input_matrix=sp.Matrix([0, sp.Rational(1, 2)]))
    problem = cart_problem(model=weak)
    state = [0.6, 0.9]
    assert BackupFilter.for_problem(problem, knowledge="plant").filter(state, [0.0]).feasible
    assert not BackupFilter.for_problem(problem, knowledge="model").filter(state, [0.0]).feasible


def test_copies_and_pickles_decide_alike():
    guard = cart_filter()
    states, proposed = drawn(50)
    for other in (copy.deepcopy(guard), pickle.loads(pickle.dumps(guard))):
        assert np.array_equal(
            other.filter(states, proposed).action, guard.filter(states, proposed).action
        )


def test_for_a_problem_it_takes_text():
    found = BackupFilter.for_problem(cart_problem(), "backup:horizon=2:margin=0.1")
    assert found.settings == settings(horizon=2.0, margin=0.1)
    assert found.plans.periods == 20


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: BackupFilter.for_problem(cart()), SystemDefinitionError, "SafetyProblem"),
        (
            lambda: BackupFilter.for_problem(cart_problem(backup=None)),
            ConfigurationError,
            "states no backup.*BackupLaw.*hocbf",
        ),
        (
            lambda: BackupFilter.for_problem(cart_problem().configured(rate_limit=(-1, 1))),
            ConfigurationError,
            "rate_limit",
        ),
        (
            lambda: BackupFilter.for_problem(cart_problem(), knowledge="all"),
            ConfigurationError,
            "knowledge",
        ),
        (
            lambda: BackupFilter(cart(), 1 - x, BRAKE, BOUNDS, DT),
            SystemDefinitionError,
            "give a Backup",
        ),
        (
            lambda: BackupFilter(cart(), 1 - x, backup(), (-np.inf, 1.0), DT),
            ConfigurationError,
            "bounds of a",
        ),
        (lambda: BackupFilter(cart(), 1 - x, backup(), BOUNDS, 0.0), ConfigurationError, "dt"),
        (
            lambda: BackupFilter(cart(), 1 - sp.Symbol("q"), backup(), BOUNDS, DT),
            SystemDefinitionError,
            "q",
        ),
        (
            lambda: cart_filter(settings=settings(horizon=1e5)),
            ConfigurationError,
            "1000000 control periods",
        ),
        (
            lambda: BackupFilter(
                cart(), 1 - x, backup(laws=(BackupLaw("b", (a,), terminal=v),)), BOUNDS, DT
            ),
            SystemDefinitionError,
            "b",
        ),
    ],
)
def test_what_cannot_be_made_is_refused(make, error, words):
    with pytest.raises(error, match=words):
        make()


@pytest.mark.parametrize(
    ("state", "u"), [([0.0], [0.0]), ([0.0, np.nan], [0.0]), ([0.0, 0.0], [np.inf])]
)
def test_states_and_inputs_that_are_none_are_refused(state, u):
    with pytest.raises(InvalidInputError):
        cart_filter().filter(state, u)


def test_another_problem_is_refused():
    guard = BackupFilter.for_problem(cart_problem())
    guard.require_problem(cart_problem())
    for options, what in (
        ({"box": (-1, 1)}, "input bounds"),
        ({"dt": 0.05}, "control period"),
        ({"barriers": 2 - x}, "barriers"),
    ):
        with pytest.raises(ConfigurationError, match=what):
            guard.require_problem(cart_problem(**options))
    with pytest.raises(ConfigurationError, match="system"):
        guard.require_problem(cart_problem(noise=0.1))
