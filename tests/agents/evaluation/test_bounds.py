"""Bounds beside measured rates: of continuous control and of the env's own steps, or why none."""

from __future__ import annotations

import gc
import math
import weakref
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem, define_problem
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.bounds import (
    FilteredPolicy,
    closed_loop_bound,
    compute_closed_loop,
    together,
)
from safe_envs.agents.evaluation.rows import BoundSummary, PosteriorSummary
from safe_envs.errors import ConfigurationError
from safe_envs.problem.signals import Variable
from safe_envs.problem.starts import Start
from safe_envs.values import closed_loop
from safe_envs.values.promise_filter import PromiseSettings, promise_filter_for, why_not_of_plant
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings, save_table
from safe_envs.wrappers import parse_conditions
from tests.conftest import problem_of
from tests.oracles.carts import cart, cart_problem, v

SCALAR = "safe_envs/Scalar-v0"


def test_bounds_of_continuous_control_are_the_closed_forms_or_say_why_not():
    options = {"start": [0.3, 0.4]}
    names = ["none", "scbf", "szcbf", "cbf"]
    given = {"filters": names, "options": options, "episodes": 20}
    bare, scbf, szcbf, cbf = evaluate("CubicSDEDisk-v0", **given).rows
    # h = .75, c = 1, A h >= -.08 at worst, over 1 s; and with A h + 2 h >= 0 everywhere.
    assert scbf.continuous_bound == pytest.approx(0.75 - 0.08, abs=1e-4)
    assert "by up to 0.08" in scbf.continuous_note
    assert szcbf.continuous_bound == pytest.approx(0.75 * math.exp(-2.0), abs=1e-4)
    # Leaving the workspace ends an episode, so that h = 1 - x is at most 4 over x >= -3; A h >= 0
    # can be met everywhere.
    options = {"horizon": 1.0, "start": [0.0]}
    (scalar,) = evaluate("Scalar-v0", filters=["scbf"], options=options, episodes=50).rows
    assert (scalar.continuous_bound, scalar.withheld) == (pytest.approx(0.25), None)
    (mismatch,) = evaluate("DubinsDisk-v0", filters=["hocbf"], episodes=2).rows
    (unasked,) = evaluate("Scalar-v0", filters=["scbf"], episodes=2, bounds=False).rows
    for row, fragment in (
        (bare, "no filter"),
        (cbf, "ignores the noise"),
        (mismatch, "differs from the plant in v"),
        (unasked, "not asked for"),
    ):
        assert row.continuous_bound is None
        assert fragment in row.continuous_note
    # None of these has a table of the env's own steps.
    notes = {row.filter: row.held_note for row in (bare, scbf)}
    assert [row.held_bound for row in (bare, scbf, unasked)] == [None] * 3
    assert "no filter" in notes["none"]
    assert "no table of the env's own step" in notes["scbf"]


def test_a_bound_is_the_mean_over_the_starts():
    given = {"filters": ["szcbf"], "episodes": 32}
    found = evaluate("CubicSDEDisk-v0", num_envs=7, record=True, **given)
    (row,), (x, y) = found.rows, found.trajectories["szcbf"].states[0].T
    h, factor = 1 - x**2 - y**2, math.exp(-2.0)
    assert row.continuous_bound == pytest.approx(h.mean() * factor, rel=1e-3)
    error = h.std(ddof=1) / math.sqrt(32) * factor
    assert row.continuous_error == pytest.approx(error, rel=1e-3)


def test_a_bound_that_cannot_be_computed_does_not_end_an_evaluation():
    x, u = sp.symbols("x u", real=True)
    # There is no value at x < -.5, which C holds.
    system = ControlAffineSDE((x,), (u,), [-sp.sqrt(x + 0.5)], [1], [sp.Rational(1, 100)])
    problem = SafetyProblem(
        "Root",
        plant=system,
        model=system,
        barriers=(Barrier(1 - x**2),),
        states=(Variable(x, -2.0, 2.0),),
        inputs=(Variable(u, -3.0, 3.0),),
        reward=sp.Integer(0),
        nominal=(sp.Integer(1),),
        starts={"middle": Start.at((0.5,))},
        dt=0.05,
        horizon=0.2,
    )
    (row,) = evaluate(problem, filters=["scbf"], episodes=5).rows
    assert (row.safe, row.continuous_bound) == (5, None)
    assert "finite value" in row.continuous_note


@pytest.fixture(scope="module")
def falling():
    x, v, u, sigma = sp.symbols("x v u sigma", real=True)
    system = ControlAffineSDE.from_rate(
        (x, v), (u,), [v, u], diffusion=[0, sigma], parameters={sigma: 0.1}
    )
    return define_problem(
        system,
        [1.0 * x, 1 - 0.5 * x],
        input_bounds=(-5.0, 5.0),
        start=[(-0.2, 1.0), (-3.0, 1.0)],
        dt=0.05,
        horizon=0.1,
        nominal=0,
        gains=(2.0, 2.0),
    )


@pytest.mark.parametrize(
    ("name", "p"),
    [("scbf", 0.0), ("szcbf:alpha=1,1", 1.0), ("hocbf:alpha=3,1", 3.0), ("ecbf:poles=-4,-2", 2.0)],
)
def test_starts_outside_the_kept_sets_are_counted(falling, name, p):
    given = {"filters": name, "episodes": 30, "num_envs": 7, "bounds": False}
    answer = evaluate(falling, record=True, **given)
    x, v = answer.trajectories[name].states[0].T
    h, rate = np.stack((x, 1 - 0.5 * x)), np.stack((v, -0.5 * v))
    outside = (h > 0).all(axis=0) & (rate + p * h <= 0).any(axis=0)
    assert answer.rows[0].outside_rate == np.mean(outside) > 0


def test_without_a_chain_no_start_is_outside_and_of_identifications_the_mean_counts():
    given = {"options": {"horizon": 0.1}, "episodes": 5, "bounds": False}
    rows = evaluate("Scalar-v0", filters=["none", "scbf"], **given).rows
    assert [row.outside_rate for row in rows] == [None, 0.0]
    rates = [BoundSummary(continuous_note="", outside_rate=rate) for rate in (0.25, 0.5)]
    assert together(rates).outside_rate == 0.375
    assert together([rates[0], BoundSummary()]).outside_rate is None
    robust = [replace(each, posterior_bound=PosteriorSummary(0.5, "")) for each in rates]
    assert together(robust).outside_rate == 0.375


SHORT = {"horizon": 0.3}


@pytest.fixture(scope="module")
def promised(tmp_path_factory):
    """Makes names of promise filters with a coarse table in a file, which may be a wrong one."""

    def made(options=SHORT, p=0.9, wrong=False):
        place = tmp_path_factory.mktemp("tables") / "table.npz"
        settings = ValueSettings(knowledge="plant", cells=(200,), inputs=9)
        table = solve(problem_of(SCALAR, **options), settings)
        if wrong:
            # It says 1 everywhere in C, under a checksum that fits.
            lower = (table.upper > 0.0).astype(np.float32)
            table = replace(table, lower=lower, upper=table.upper * 0 + 1)
        save_table(table, place)
        return f"promise:p={p}:table={place}"

    return made


def test_a_promise_filter_is_a_row_with_its_own_bound(promised):
    name, told = promised(), []
    given = {"options": SHORT, "bounds": True, "progress": told.append}
    found = evaluate(SCALAR, "nominal", ["none", name, "scbf"], episodes=100, **given)
    row, scbf = found.rows[1:]
    assert row.held_bound == pytest.approx(0.9, abs=1e-3)
    assert (row.held_word, row.continuous_bound, row.continuous_word) == ("computed", None, "none")
    again = evaluate(SCALAR, "nominal", name, episodes=100, num_envs=7, options=SHORT)
    assert again.rows == [row]
    # Equal values at all starts.
    assert row.held_error == 0.0
    assert row.ci_high >= row.held_bound
    assert row.outside_rate is row.learning is None
    # Nominal control stays below the limit for so short a time: nothing is to be done.
    assert 0.0 <= row.intervention_rate < scbf.intervention_rate
    assert (found.timing.rows[1].engine, found.config["filters"][1]["spec"]) == ("numpy", name)
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)
    # Outside C it is 0, and between control instants there is none.
    for more, fragment in (
        ({"options": {**SHORT, "start": [1.5]}}, "no start"),
        ({"monitoring": "continuous"}, "not of the time between"),
    ):
        (row,) = evaluate(SCALAR, filters=name, episodes=10, **{**given, **more}).rows
        assert row.held_bound is None
        assert fragment in row.held_note


def test_a_bound_is_withheld_where_the_table_lets_p_k_fall(promised):
    options, found = {"horizon": 0.3, "noise": 4.0}, []
    for wrong in (False, True):
        name = promised(options, 0.95, wrong)
        found += evaluate(SCALAR, filters=name, options=options, episodes=200).rows
    assert (found[0].held_bound is None, found[0].withheld) == (False, None)
    assert found[1].held_bound is None
    assert "the table is wrong" in found[1].withheld


def test_filters_of_one_table_share_it_and_a_named_file_is_read_again(promised, tmp_path):
    problem = problem_of(SCALAR, **SHORT)
    settings = PromiseSettings.of_text(promised())
    first = promise_filter_for(problem, settings)
    told = []
    second = promise_filter_for(problem, replace(settings, probability=0.5), progress=told.append)
    assert first.look_ahead is second.look_ahead
    assert told == [1.0]
    place = weakref.ref(first.look_ahead)
    del first, second
    gc.collect()
    assert place() is None
    with pytest.raises(ConfigurationError, match="Scalar"):
        promise_filter_for(problem_of(SCALAR, **SHORT, noise=0.1), settings)


def test_the_guarantee_is_of_the_plant_where_the_table_covers_it():
    # The plant's speed is 1, the model's another one.
    problem = problem_of("safe_envs/DubinsDisk-v0")
    true, believed = (s.parameter_values["v"] for s in (problem.plant, problem.model))
    assert true != believed
    plain = PromiseSettings(0.9)
    covering = PromiseSettings(0.9, (("v", min(true, believed), max(true, believed)),))
    missing = PromiseSettings(0.9, (("v", true + 0.1, true + 0.2),))
    for settings, knowledge, fragment in (
        (plain, "plant", ""),
        (plain, "model", "from which the plant differs"),
        (covering, "model", ""),
        (covering, "plant", ""),
        (missing, "model", f"the plant has v = {true:g}, outside"),
        (missing, "plant", f"the plant has v = {true:g}, outside"),
    ):
        reason = why_not_of_plant(problem, settings, knowledge)
        assert fragment in reason
        assert bool(reason) == bool(fragment)


def guarded(problem, filters="backup", **given):
    return evaluate(problem, filters=filters, **{"episodes": 100, **given}).rows


def test_a_backup_filter_is_safe_from_the_share_of_starts_that_its_bound_is():
    wide = cart_problem(start=[(-0.5, 0.9), (0.0, 2.0)])
    bare, row = guarded(wide, ["none", "backup"])
    assert bare.safety_rate == 0.0
    assert row.held_word == "computed"
    assert "brake" in row.held_note
    assert 0.3 < row.held_bound < 0.95
    assert row.safety_rate == row.held_bound
    # Whatever the batches are.
    (again,) = guarded(wide, num_envs=7)
    assert again.held_bound == row.held_bound
    (inside,) = guarded(cart_problem(), policy="random")
    assert (inside.safety_rate, inside.held_bound, inside.infeasible_rate) == (1.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("options", "given", "fragment"),
    [
        ({"noise": 0.05}, {}, "noise"),
        (
            {"model": replace(cart(), drift=sp.Matrix([v, sp.Float(0.01)]))},
            {},
            "plant differs",
        ),
        ({"start": [0.9, 2.0]}, {}, "no backup law"),
    ],
)
def test_without_its_assumptions_a_backup_filter_has_no_bound_but_a_reason(
    options, given, fragment
):
    (row,) = guarded(cart_problem(**options), **given)
    assert row.held_bound is None
    assert fragment in row.held_note


def test_with_knowledge_of_the_plant_a_wrong_model_does_no_harm():
    problem = cart_problem(model=replace(cart(), input_matrix=sp.Matrix([0, 2])))
    (known,) = guarded(problem, knowledge="plant")
    (believed,) = guarded(problem, knowledge="model")
    assert (known.safety_rate, known.held_bound) == (1.0, 1.0)
    assert believed.safety_rate < 0.1


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SAFE_ENVS_CACHE", str(tmp_path))
    monkeypatch.setattr(closed_loop, "CELLS", {1: 400, 2: 400})


LOOP = {"horizon": 0.1, "noise": 1.0}


def loop_of(text="scbf", policy="nominal", env="Scalar", **given):
    problem = problem_of(f"safe_envs/{env}-v0", **LOOP)
    parts = parse_conditions(text, problem) if text else ()
    return FilteredPolicy(problem, parts, "model", policy, **{"closed_loop": True, **given})


@pytest.mark.usefixtures("own_cache")
def test_closed_loops_have_certified_bounds_where_they_are_asked_for():
    told = []
    given = {"filters": ["none", "scbf"], "options": LOOP, "episodes": 100}
    found = evaluate("Scalar-v0", closed_loop=True, progress=told.append, **given)
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)
    for row in found.rows:
        assert row.held_word == "certified"
        assert 0.3 < row.held_bound <= row.ci_high
        assert "401 cells" in row.held_note
    # A table that is kept changes nothing for those who do not ask for it.
    assert [row.held_bound for row in evaluate("Scalar-v0", **given).rows] == [None, None]


@pytest.mark.usefixtures("own_cache")
def test_a_closed_loop_has_its_bound_at_the_starts_and_that_of_every_policy_is_lower():
    own, starts = compute_closed_loop(loop_of()), np.array([[0.5], [0.9], [9.0]])
    bound = closed_loop_bound(loop_of())
    assert (bound.at(starts) == own.start_bounds((starts[:, 0],))).all()
    assert bound.at(starts)[0] > bound.at(starts)[2] == 0.0
    assert (bound.at(np.repeat(starts[:1], 5, axis=0)) == bound.at(starts)[0]).all()
    assert bound.at(np.zeros((0, 1))).shape == (0,)
    # A promise filter has a table of its own.
    promise = replace(loop_of(), parts=PromiseSettings(0.9))
    assert compute_closed_loop(promise) is closed_loop_bound(promise) is None
    # Policies without a formula have that of every policy.
    tables = [compute_closed_loop(loop_of(policy=name)) for name in ("random", "")]
    assert tables[0] is tables[1]
    every = closed_loop_bound(loop_of(policy="random"))
    assert "every policy" in every.note
    starts = np.linspace(-0.9, 0.9, 9)[:, None]
    assert (every.at(starts) <= own.start_bounds((starts[:, 0],)) + 1e-6).all()


@pytest.mark.parametrize(
    ("given", "fragment"),
    [
        ({"text": "", "policy": "random"}, "'random'"),
        ({"text": "", "policy": ""}, "the policy"),
        ({"objective": "clf"}, "nearest"),
        ({"text": "srcbf"}, "srcbf"),
        ({"env": "StochasticDubins", "text": ""}, "3 states"),
    ],
)
@pytest.mark.usefixtures("own_cache")
def test_why_a_closed_loop_has_no_table_is_said_where_it_was_asked_for(given, fragment):
    asked = loop_of(**given)
    assert compute_closed_loop(asked) is None
    assert fragment in closed_loop_bound(asked).why_none
    assert closed_loop_bound(loop_of(closed_loop=False, **given)) is None
