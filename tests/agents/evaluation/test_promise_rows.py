"""The promise filter in evaluations: a filter like any other, with a bound of its own."""

from __future__ import annotations

import gc
import importlib.util
import json
import weakref
from dataclasses import replace

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents.evaluation.bounds import COMPUTED_TABLE, judged
from safe_envs.agents.evaluation.evaluate import evaluate, run_evaluation
from safe_envs.agents.evaluation.notes import computed_notes
from safe_envs.agents.evaluation.resolve import ResolvedEvaluation
from safe_envs.agents.evaluation.rows import BoundSummary
from safe_envs.agents.evaluation.spec import EvaluationSpec
from safe_envs.agents.rare_events.estimate import estimate_rare
from safe_envs.errors import NotCompilableError
from safe_envs.values.promise_filter import (
    _IN_USE,
    PromiseSettings,
    promise_filter_for,
    why_not_of_plant,
)
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings, save_table
from tests.conftest import problem_of

SCALAR, SHORT = "safe_envs/Scalar-v0", {"horizon": 0.3}
NAME = "promise:p=0.9"


@pytest.fixture(scope="module")
def found():
    return evaluate(SCALAR, "nominal", ["none", NAME, "scbf"], options=SHORT, episodes=200)


def test_a_promise_filter_is_a_row_with_its_own_bound(found):
    none, row, scbf = found.rows
    assert row.filter == NAME
    assert row.held_bound == pytest.approx(0.9, abs=1e-6)
    assert (row.held_word, row.held_note) == ("computed", COMPUTED_TABLE)
    assert (row.continuous_bound, row.continuous_word) == (None, "none")
    assert row.continuous_note == PromiseSettings.only_of_steps
    # Equal values at all starts.
    assert row.held_error == 0.0
    assert row.ci_high >= row.held_bound
    assert row.outside_rate is None
    # Nominal control stays below the limit for so short a time: nothing is to be done.
    assert 0.0 <= row.intervention_rate < scbf.intervention_rate
    assert row.learning is None
    assert found.timing.rows[1].engine == "numpy"
    assert found.config["filters"][1] == {"name": NAME, "spec": NAME}
    assert (none.held_bound, none.held_note) == (None, "there is no filter")
    assert (scbf.held_bound, scbf.held_word) == (None, "none")
    assert "neither a table nor a certificate" in scbf.held_note


def test_the_bound_is_the_mean_of_p_0_over_the_starts(found):
    # Of each start no more than p, and 0 outside C: here .9 from half of them.
    options = {**SHORT, "start": [1.5]}
    (row,) = evaluate(SCALAR, "nominal", [NAME], options=options, episodes=10).rows
    assert row.held_bound is None
    assert row.held_note == "no start is in the table's safe set"
    assert row.safety_rate == 0.0


def test_a_spec_with_it_is_written_and_read():
    text = "promise:p=0.9:robust=v:1.0..2.0:leaving=safe"
    spec = EvaluationSpec("safe_envs/DubinsDisk-v0", filters=["none", text])
    again = EvaluationSpec.from_dict(json.loads(json.dumps(spec.as_dict())))
    assert again == spec
    assert again.filters == ("none", text)


def test_batches_of_any_size_give_the_same():
    rows = []
    for size in (7, 64):
        spec = EvaluationSpec(SCALAR, "random", [NAME], options=SHORT, episodes=40)
        resolved = ResolvedEvaluation(spec)
        resolved.learn(lambda: None)
        env = resolved.env(resolved.filters[NAME][0], size)
        rows.append(env.reset(seed=5)[1]["promise"][:7])
        env.close()
    np.testing.assert_array_equal(*rows)


def test_progress_counts_the_table():
    done = []
    evaluate(SCALAR, "nominal", [NAME], options={"horizon": 0.05}, episodes=5, progress=done.append)
    assert done == sorted(done)
    assert done[-1] == pytest.approx(1.0)
    assert any(0.0 < part <= 0.5 for part in done)


def test_filters_of_one_table_share_it():
    problem = problem_of(SCALAR, **SHORT)
    first = promise_filter_for(problem, PromiseSettings(0.9))
    told = []
    second = promise_filter_for(problem, PromiseSettings(0.5), progress=told.append)
    assert first.look_ahead is second.look_ahead
    assert told == [1.0]
    # The model is the plant here.
    of_plant = promise_filter_for(problem, PromiseSettings(0.9), knowledge="plant")
    assert of_plant.look_ahead is first.look_ahead
    assert first.look_ahead in _IN_USE.values()
    place = weakref.ref(first.look_ahead)
    del first, second, of_plant
    gc.collect()
    assert place() is None


def test_a_named_file_is_written_once_and_read_again(tmp_path):
    problem = problem_of(SCALAR, horizon=0.05)
    path = tmp_path / "scalar.npz"
    settings = PromiseSettings.of_text(f"promise:p=0.9:table={path}")
    first = promise_filter_for(problem, settings)
    x = (np.linspace(-0.5, 1.2, 9),)
    wanted = first.start(x)
    assert path.exists()
    del first
    gc.collect()
    np.testing.assert_array_equal(promise_filter_for(problem, settings).start(x), wanted)
    with pytest.raises(ConfigurationError, match="Scalar"):
        promise_filter_for(problem_of(SCALAR, horizon=0.05, noise=0.1), settings)


def test_what_cannot_be_had_is_refused():
    settings = {"options": SHORT, "episodes": 5}
    with pytest.raises(ConfigurationError, match=r"acts alone"):
        evaluate(SCALAR, "nominal", [f"{NAME}+scbf"], **settings)
    with pytest.raises(ConfigurationError, match="no parameter 'v'"):
        evaluate(SCALAR, "nominal", [f"{NAME}:robust=v:1..2"], **settings)
    with pytest.raises(ConfigurationError, match="use 'nearest'"):
        evaluate("safe_envs/ACC-v0", "nominal", [NAME], objective="clf", episodes=5)
    with pytest.raises(ConfigurationError, match="remembers what was kept on the whole path"):
        estimate_rare(SCALAR, "nominal", [NAME], options=SHORT, particles=100)


@pytest.mark.skipif(not importlib.util.find_spec("numba"), reason="needs Numba")
def test_the_compiled_engine_cannot_do_it():
    with pytest.raises(NotCompilableError, match=r"promise:p=0\.9 looks up a table"):
        evaluate(SCALAR, "nominal", [NAME], options=SHORT, episodes=5, engine="compiled")


def test_between_control_instants_there_is_no_bound():
    spec = EvaluationSpec(
        SCALAR, filters=[NAME], options=SHORT, episodes=5, monitoring="continuous"
    )
    (row,) = run_evaluation(spec).rows
    assert row.held_bound is None
    assert "not of the time between" in row.held_note


def test_the_guarantee_is_of_the_plant_where_the_table_covers_it():
    # The plant's speed is 1, the model's another one.
    problem = problem_of("safe_envs/DubinsDisk-v0")
    true, believed = (s.parameter_values["v"] for s in (problem.plant, problem.model))
    assert true != believed
    plain = PromiseSettings(0.9)
    covering = PromiseSettings(0.9, (("v", min(true, believed), max(true, believed)),))
    missing = PromiseSettings(0.9, (("v", true + 0.1, true + 0.2),))
    assert why_not_of_plant(problem, plain, "plant") == ""
    assert "from which the plant differs" in why_not_of_plant(problem, plain, "model")
    for knowledge in ("model", "plant"):
        assert why_not_of_plant(problem, covering, knowledge) == ""
        assert f"the plant has v = {true:g}, outside" in why_not_of_plant(
            problem, missing, knowledge
        )
    assert why_not_of_plant(problem_of(SCALAR), plain, "model") == ""


def test_a_bound_is_withheld_where_the_table_lets_p_k_fall(tmp_path):
    # The wrong one says 1 everywhere in C, under a checksum that fits.
    problem = problem_of(SCALAR, horizon=0.3, noise=4.0)
    settings = ValueSettings(knowledge="plant", cells=(100,))
    right = solve(problem, settings)
    wrong = replace(right, lower=(right.upper > 0.0).astype(np.float32), upper=right.upper * 0 + 1)
    notes = []
    for name, table in (("right", right), ("wrong", wrong)):
        save_table(table, tmp_path / name)
        text = f"promise:p=0.95:table={tmp_path / name}"
        options = {"horizon": 0.3, "noise": 4.0}
        (row,) = evaluate(SCALAR, "nominal", [text], options=options, episodes=300).rows
        notes.append((row.held_bound is None, row.withheld))
    assert notes[0] == (False, None)
    assert notes[1][0]
    assert "the table is wrong" in notes[1][1]


def test_a_bound_that_the_rate_contradicts_is_withheld():
    row = BoundSummary(held_bound=0.9, held_word="computed", held_note=COMPUTED_TABLE)
    assert judged(row, 0.9, 0.9) == row
    found = judged(row, 0.85, 0.85)
    assert (found.held_bound, found.held_word) == (None, "withheld")
    assert "ends at 85.0 %, below 90.0 %" in (found.withheld or "")
    assert "continuous time" not in (found.withheld or "")
    assert "another table" in (found.withheld or "")


def test_notes_say_that_the_bound_is_computed():
    assert computed_notes(["scbf"]) == []
    (one,) = computed_notes(["scbf", NAME])
    assert one.startswith(f"held input, comp.: the bound of {NAME} is computed, not proved")
    (several,) = computed_notes([NAME, "promise:p=0.5"])
    assert several.startswith("held input, comp.: bounds of promise filters are computed")
