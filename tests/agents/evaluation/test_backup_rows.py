"""The backup filter in evaluations: rates, its bound, and both engines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError
from safe_envs.agents import make_policy
from safe_envs.agents.evaluation.bounds import COMPUTED_PLANS, STATED, BackupBound
from safe_envs.agents.evaluation.compiled_episodes import CompiledEpisodes
from safe_envs.agents.evaluation.episodes import play
from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.evaluation.resolve import ResolvedEvaluation
from safe_envs.agents.evaluation.spec import EvaluationSpec
from safe_envs.agents.rare_events.estimate import estimate_rare
from safe_envs.agents.sweeps.spec import Sweep, read_sweep
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.problem.backup import BackupLaw
from safe_envs.proofs.backup_filter import BackupFilter
from safe_envs.wrappers import SafetyFilterVectorWrapper
from tests.agents.evaluation.test_compiled_episodes import assert_alike, joined
from tests.oracles.carts import DT, STRONGEST, cart, cart_problem, v, x

WIDE = {"start": [(-0.5, 0.9), (0.0, 2.0)]}
TWO = (1 - x, 1 + x)

SLOW = sp.Min(STRONGEST * DT - sp.Abs(v), *TWO, *(b.subs(x, x + v * DT / 2) for b in TWO))
STOPS = (
    BackupLaw("stop", (-v / DT,), terminal=SLOW),
    BackupLaw("wait", (-v / DT + 5 * sp.Max(0, sp.Abs(v) - STRONGEST * DT),), terminal=SLOW),
)
"""Laws that stop within a period where the cart is slow."""


def rows(problem, filters=("backup",), **settings):
    return evaluate(problem, filters=list(filters), **{"episodes": 200, **settings}).rows


def test_it_is_safe_where_it_says_and_its_bound_is_the_share_of_such_starts():
    unfiltered, guarded = rows(cart_problem(**WIDE), ("none", "backup"), policy="nominal")
    assert unfiltered.safety_rate == 0.0
    assert (guarded.held_word, guarded.held_note) == (
        "computed",
        COMPUTED_PLANS + STATED.format("brake"),
    )
    assert 0.3 < guarded.held_bound < 0.95
    assert guarded.safety_rate == guarded.held_bound
    assert "plans" in guarded.continuous_note
    inside = rows(cart_problem(), policy="random")[0]
    assert (inside.safety_rate, inside.held_bound, inside.infeasible_rate) == (1.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"noise": 0.05}, "noise"),
        ({"model": replace(cart(), drift=sp.Matrix([v, sp.Float(0.01)]))}, "plant differs"),
    ],
)
def test_without_its_assumptions_there_is_no_bound_but_a_reason(options, words):
    found = rows(cart_problem(**options))[0]
    assert found.held_bound is None
    assert words in found.held_note


def test_with_knowledge_of_the_plant_a_wrong_model_does_no_harm():
    wrong = replace(cart(), input_matrix=sp.Matrix([0, 2]))
    known = rows(cart_problem(model=wrong), knowledge="plant")[0]
    believed = rows(cart_problem(model=wrong), knowledge="model")[0]
    assert (known.safety_rate, known.held_bound) == (1.0, 1.0)
    assert believed.safety_rate < 0.1


def test_where_no_law_keeps_any_start_there_is_no_bound():
    found = rows(cart_problem(start=[0.9, 2.0]), episodes=3)[0]
    assert found.held_bound is None
    assert "no backup law" in found.held_note
    assert found.infeasible_rate > 0.0


@pytest.mark.parametrize("options", [{}, {"noise": 0.2}, {"laws": STOPS, "barriers": TWO}])
def test_a_program_plays_the_episodes_of_numpy(options):
    problem = cart_problem(**{**WIDE, "horizon": 1.5, **options})
    actor, guard = make_policy("random", problem), BackupFilter.for_problem(problem)
    env = SafetyFilterVectorWrapper(SafeVectorEnv(problem, 8), "backup")
    program = CompiledEpisodes(problem, actor, guard, False)
    expected = list(play(env, actor, range(24), 3))
    found = list(program.play(program.program.plain(), range(24), 3, 1, lambda _: []))
    assert_alike(found, expected)
    columns, _ = joined(expected)
    for name in ("interventions", "infeasible", "slack", "first_violation"):
        assert len(set(columns[name])) > 1, name


def test_its_settings_are_part_of_the_result():
    resolved = ResolvedEvaluation(EvaluationSpec(cart_problem(), filters=["backup:horizon=3"]))
    resolved.learn(lambda: None)
    assert resolved.config()["filters"] == [
        {"name": "backup:horizon=3", "spec": "backup:horizon=3.0"}
    ]
    with pytest.raises(ConfigurationError, match="states no backup"):
        ResolvedEvaluation(EvaluationSpec("safe_envs/Scalar-v0", filters=["backup"]))
    with pytest.raises(ConfigurationError, match="takes the input nearest"):
        ResolvedEvaluation(EvaluationSpec(cart_problem(), filters=["backup"], objective="clf"))


def test_rare_failures_behind_it_can_be_estimated():
    problem = cart_problem(noise=0.1, start=[-0.5, 0.0], horizon=2.0)
    found = estimate_rare(
        problem, filters=["backup"], particles=30, repetitions=10, engine="numpy", policy="nominal"
    )
    assert 0.0 < found.rows[0].probability < 1.0


def test_sweeps_take_it(tmp_path):
    file = tmp_path / "sweep.yml"
    file.write_text("fixed: {env: DubinsDisk-v0, episodes: 2}\ngrid: {filter: [backup, hocbf]}\n")
    sweep = read_sweep(file)
    assert isinstance(sweep, Sweep)
    assert [cell.settings["filter"] for cell in sweep.cells] == ["backup", "hocbf"]


def test_a_batch_of_the_bound_is_that_of_each_start():
    problem = cart_problem(**WIDE)
    resolved = ResolvedEvaluation(EvaluationSpec(problem, filters=["backup"]))
    resolved.learn(lambda: None)
    bound = BackupBound(resolved.filters["backup"][0], problem, "model")
    starts = np.column_stack([np.linspace(-1, 1.2, 12), np.linspace(0, STRONGEST, 12)])
    assert [bound.at(start[None])[0] for start in starts] == bound.at(starts).tolist()
