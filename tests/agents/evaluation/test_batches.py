"""An evaluation depends on neither the batch nor the processes, keeps little, and compares filters
on the same episodes."""

from __future__ import annotations

import errno
import json
import tracemalloc
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pyarrow.parquet as pq
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import NominalController, evaluate, make_problem
from safe_envs.agents.evaluation import episodes_file as module
from safe_envs.agents.evaluation.episodes import episode_seed
from safe_envs.agents.evaluation.evaluate import refine
from safe_envs.agents.evaluation.statistics import (
    mcnemar_p,
    paired_difference_interval,
    rate_interval,
)
from safe_envs.wrappers import HOCBF, SCBF, SafetyFilterWrapper, spec_of
from tests.conftest import problem_of

pytestmark = pytest.mark.slow

NEAR = {"noise": 0.1, "start": [2.0, 1.3, 0.3, 0.5, 1.0]}
LONG = {"noise": 0.6, "horizon": 3.0, "dt": 0.008}
SHORT = {"options": {"horizon": 0.05}, "bounds": False}


def assert_same_to_the_bit(first, second):
    texts = [json.dumps({**each.document(), "timing": None}) for each in (first, second)]
    assert texts[0] == texts[1]
    columns = [each.episode_columns() for each in (first, second)]
    for name, values in columns[0].items():
        assert values.tobytes() == columns[1][name].tobytes(), name
    assert first.config == second.config
    assert first.trajectories.keys() == second.trajectories.keys()
    for name, recorder in first.trajectories.items():
        other = second.trajectories[name]
        for one, there in (
            (recorder.barrier, other.barrier),
            (recorder.states, other.states),
            (recorder.log.table(), other.log.table()),
        ):
            assert one.tobytes() == there.tobytes()
        # The flags are the same episodes, however many come at once.
        flags = [each.safe[name][0].array for each in (first, second)]
        assert flags[0].tolist() == flags[1].tolist() == first.episodes[name][0].safe.tolist()


def test_answer_is_the_same_for_every_num_envs(env_id):
    problem = make_problem(env_id, noise=0.2)
    problem = problem.configured(horizon=6 * problem.dt)
    given = {"episodes": 5, "seed": 3, "record": True, "bounds": False}
    first, *others = (evaluate(problem, num_envs=n, **given) for n in (100, 3, 1))
    for other in others:
        assert_same_to_the_bit(first, other)
    # By the id it is the same; the defaults are the problem's own controller and filter.
    options = {"noise": 0.2, "horizon": problem.horizon}
    by_id = evaluate(env_id, NominalController, options=options, **given)
    assert [row.filter for row in by_id.rows] == ["none", problem.filter]
    assert by_id.config["problem"] == first.config["problem"]
    assert (by_id.config["env_id"], first.config["env_id"]) == (env_id, None)
    for a, b in zip(by_id.rows, first.rows, strict=True):
        assert replace(a, policy="") == replace(b, policy="")


@pytest.mark.parametrize(
    ("env_id", "policy", "filters", "options", "more"),
    [
        # Episodes that end at different times: out of the workspace, and at the goal.
        ("Scalar-v0", "random", ("none", "cbf:alpha=3"), {"noise": 0.9, "dt": 0.02}, {}),
        ("DubinsObstacle-v0", "nominal", ("none", "hocbf"), NEAR, {}),
        # More control periods than the noise is drawn ahead for, and bridges.
        ("Scalar-v0", "nominal", ("none",), LONG, {"monitoring": "continuous"}),
        # The mean of a bound over the starts goes the same way.
        ("CubicSDEDisk-v0", "random", ("scbf",), {"horizon": 0.2}, {"bounds": True}),
    ],
)
def test_long_and_ending_episodes_are_the_same_for_every_num_envs(
    env_id, policy, filters, options, more
):
    problem = make_problem(env_id, **{"horizon": 2.0, **options})
    given = {"episodes": 5, "seed": 1, "record": True, "bounds": False, **more}
    first, *others = (evaluate(problem, policy, filters, num_envs=n, **given) for n in (5, 2))
    for other in others:
        assert_same_to_the_bit(first, other)


def test_parts_of_the_work_and_files_of_episodes_change_nothing(tmp_path, monkeypatch):
    # What processes compute, without their start; with it in `make oracle`.
    here = lambda function, shared, parts, jobs: (function(shared, part) for part in parts)  # noqa: E731
    monkeypatch.setattr("safe_envs.agents.evaluation.episodes.compute_in_order", here)
    found, contents = [], set()
    given = {"options": {"horizon": 1.0, "noise": 0.8}, "episodes": 40, "bounds": False}
    for i, how in enumerate(({}, {"num_envs": 7}, {"jobs": 2}, {"keep_episodes": False})):
        place = tmp_path / f"{i}.parquet"
        found.append(evaluate("Scalar-v0", "random", episodes_out=str(place), **given, **how))
        contents.add(place.read_bytes())
    first, *others = found
    assert len(contents) == 1
    for other in others:
        assert (other.rows, other.comparisons) == (first.rows, first.comparisons)
    table, columns = pq.read_table(place), first.episode_columns()
    assert table.column_names == list(columns)
    assert table["return"].to_pylist() == columns["return"].tolist()
    assert table["first_violation"].null_count == columns["safe"].sum()
    with pytest.raises(ConfigurationError, match="keep_episodes"):
        others[-1].episode_columns()
    # A refinement writes the evaluation as given.
    place = tmp_path / "refined.parquet"
    refined = refine("Scalar-v0", "random", filters="none", episodes_out=place, **given)
    lengths = pq.read_table(place)["length"].to_pylist()
    assert max(lengths) == refined.given.problem.steps
    returns = pq.read_table(place)["return"].to_pylist()
    assert returns == refined.given.episode_columns()["return"].tolist()


@pytest.mark.oracle
@pytest.mark.parametrize(
    ("env_id", "given"),
    [
        ("StochasticDubins-v0", {"monitoring": "continuous", "options": {"horizon": 1.0}}),
        ("Pendulum-v0", {"estimator": "ekf", "options": {"measurement": "default"}}),
    ],
)
def test_processes_change_nothing(env_id, given):
    given = {"episodes": 40, "bounds": False, **given}
    assert_same_to_the_bit(*(evaluate(env_id, "random", jobs=n, **given) for n in (1, 2)))


def test_seeds_and_numbers_of_episodes():
    few, many, other = (
        evaluate("Scalar-v0", "random", episodes=n, seed=s, num_envs=8, record=True, **SHORT)
        for n, s in ((10, 0), (25, 0), (25, 1))
    )
    for name, recorder in few.trajectories.items():
        later = many.trajectories[name].barrier[:, :10]
        np.testing.assert_array_equal(recorder.barrier, later)
    assert many.rows[0].return_mean != other.rows[0].return_mean


def test_trajectories_keep_a_bounded_number_of_episodes():
    given = {"filters": ["none"], **SHORT}
    kept = evaluate("Scalar-v0", episodes=300, num_envs=90, record=True, **given).trajectories
    assert kept["none"].barrier.shape == (6, 256)
    assert kept["none"].states.shape == (6, 32, 1)
    np.testing.assert_allclose(kept["none"].barrier[:, :32], 1 - kept["none"].states[:, :, 0])
    assert evaluate("Scalar-v0", episodes=2, **given).trajectories == {}


def test_memory_does_not_grow_with_episodes():
    problem = make_problem("Scalar-v0", horizon=0.02)
    how = {"num_envs": 256, "record": True, "bounds": False, "keep_episodes": False}

    def peak(episodes):
        tracemalloc.start()
        try:
            evaluate(problem, filters=["none"], episodes=episodes, **how)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(256)
    few, many = peak(512), peak(5120)
    # The results of an episode, of which one bit is kept, take 40 bytes, and more to be joined.
    assert many - few < 10 * (5120 - 512)


@pytest.mark.parametrize(
    ("call", "shares"),
    [(evaluate, (0.5,)), (refine, (1 / 16, 1 / 8, 2 / 8, 4 / 8))],
)
def test_progress_goes_from_nothing_to_all(call, shares):
    told = []
    given = {"filters": ["none", "scbf"], "episodes": 7, "num_envs": 3, **SHORT}
    call("Scalar-v0", progress=told.append, **given)
    assert told == sorted(told)
    assert 0.0 < told[0] < 0.1
    assert told[-1] == 1.0
    for share in shares:
        assert min(abs(t - share) for t in told) < 1e-12


@pytest.mark.parametrize(
    ("env_id", "policy", "options", "repeats"),
    [
        ("DubinsDisk-v0", "nominal", {"start": [0.5, 0.0, 0.4]}, True),
        ("DubinsDisk-v0", "random", {"start": [0.5, 0.0, 0.4]}, False),
        ("DubinsDisk-v0", "nominal", {"start": [0.5, 0.0, 0.4], "noise": 0.1}, False),
        ("Scalar-v0", "nominal", {"noise": 0.0}, False),
        ("Scalar-v0", "zero", {"noise": 0.0, "start": "origin"}, True),
    ],
)
def test_evaluations_of_one_episode_over_and_over_are_marked(env_id, policy, options, repeats):
    problem = problem_of(f"safe_envs/{env_id}", **options, horizon=0.2)
    answer = evaluate(problem, policy, ["none"], episodes=4, record=True)
    assert answer.is_deterministic == repeats
    barrier = answer.trajectories["none"].barrier
    assert (barrier == barrier[:, :1]).all() == repeats


# The file of single episodes is written group by group, whole or not at all.


GIVEN = {"options": {"horizon": 0.1, "noise": 3.0}, "bounds": False, "episodes": 50}


def test_groups_do_not_depend_on_the_size_of_batches(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_GROUP", 16)
    contents = set()
    for size in (1, 7, 33, 50):
        place = tmp_path / f"{size}.parquet"
        given = {**GIVEN, "episodes_out": place, "num_envs": size}
        found = evaluate("Scalar-v0", "random", ["none", "scbf"], **given)
        contents.add(place.read_bytes())
    assert len(contents) == 1
    file, columns = pq.ParquetFile(place), found.episode_columns()
    groups = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
    assert groups == 2 * [16, 16, 16, 2]
    table = file.read()
    assert table["filter"].to_pylist() == 50 * ["none"] + 50 * ["scbf"]
    assert table["episode"].to_pylist() == 2 * list(range(50))
    assert set(table["identification"].to_pylist()) == {0}
    for name in ("return", "length", "interventions"):
        assert table[name].to_pylist() == columns[name].tolist()
    times = [None if np.isnan(t) else t for t in columns["first_violation"].tolist()]
    assert table["first_violation"].to_pylist() == times
    assert 0 < times.count(None) < 100


@pytest.mark.parametrize("error", [SystemError, KeyboardInterrupt])
@pytest.mark.parametrize("before", [None, "old"])
def test_a_failure_leaves_what_was_there(tmp_path, error, before):
    place, calls = tmp_path / "out.parquet", []
    if before:
        place.write_text(before)

    def progress(done):
        calls.append(done)
        if len(calls) == 3:
            assert len(list(tmp_path.iterdir())) == (2 if before else 1)
            raise error

    with pytest.raises(error):
        evaluate("Scalar-v0", episodes_out=place, progress=progress, num_envs=5, **GIVEN)
    assert [p.read_text() for p in tmp_path.iterdir()] == ([before] if before else [])


def test_a_full_disk_is_named(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pq.ParquetWriter, "write_table", full)
    with pytest.raises(ConfigurationError, match=r"out.parquet: No space left"):
        evaluate("Scalar-v0", episodes_out=tmp_path / "out.parquet", **GIVEN)
    assert list(tmp_path.iterdir()) == []


def test_without_pyarrow_it_is_said_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda _: None)
    with pytest.raises(ConfigurationError, match="sweep"):
        evaluate("Scalar-v0", episodes_out=tmp_path / "out.parquet", **GIVEN)


# Filters in an evaluation: on the same episodes, each with intervals, and compared.


DUBINS = "safe_envs/StochasticDubins-v0"


def test_filters_see_the_same_episodes_and_are_compared_on_them():
    filters = ["none", "hocbf:alpha=1,2", "scbf"]
    given = {"options": {"horizon": 3.0, "noise": 0.4}, "episodes": 100, "seed": 4}
    given |= {"confidence": 0.9, "bounds": False}
    answer = evaluate(DUBINS, filters=filters, num_envs=64, record=True, **given)
    safe = {name: (answer.trajectories[name].barrier > 0).all(axis=0) for name in filters}
    pairs = [(c.first, c.second) for c in answer.comparisons]
    assert pairs == [(filters[1], filters[0]), (filters[2], filters[0]), (filters[2], filters[1])]
    for c in answer.comparisons:
        a, b = safe[c.first], safe[c.second]
        table = [int(flags.sum()) for flags in (a & b, a & ~b, ~a & b, ~a & ~b)]
        assert [c.both, c.only_first, c.only_second, c.neither] == table
        assert c.difference == pytest.approx(a.mean() - b.mean())
        assert (c.ci_low, c.ci_high) == paired_difference_interval(*table, 0.9)
        assert c.mcnemar_p == mcnemar_p(*table[1:3])
    assert answer.document()["comparisons"] == [vars(c) for c in answer.comparisons]
    # Together at first, and never together again.
    bare, filtered = (answer.trajectories[name].states for name in filters[:2])
    np.testing.assert_array_equal(bare[0], filtered[0])
    parted = (bare != filtered).any(axis=2)
    assert parted.any()
    assert (np.diff(parted.astype(int), axis=0) >= 0).all()
    # Alone a filter has the same row.
    (row,) = evaluate(DUBINS, filters=filters[2], **given).rows
    assert row == answer.rows[2]


def test_confidence_is_that_of_every_interval():
    given = {"options": {"horizon": 0.5, "noise": 0.8}, "episodes": 100, "bounds": False}
    narrow, wide = (
        evaluate("Scalar-v0", filters=["none", "scbf"], confidence=c, **given) for c in (0.5, 0.999)
    )
    assert (narrow.config["confidence"], wide.config["confidence"]) == (0.5, 0.999)
    for a, b in zip(narrow.rows, wide.rows, strict=True):
        assert (a.ci_low, a.ci_high) == rate_interval(a.safe, 100, 0.5)
        assert b.ci_low < a.ci_low < a.safety_rate < a.ci_high < b.ci_high
        assert b.curve.ci_low[-1] < a.curve.ci_low[-1]
        assert a.curve.rate == b.curve.rate
    assert wide.comparisons[0].ci_low < narrow.comparisons[0].ci_low


def test_a_filter_that_never_acts_leaves_everything_as_it_is():
    given = {"options": {"horizon": 1.0, "noise": 1.5}, "episodes": 20, "bounds": False}
    answer = evaluate("ACC-v0", "random", ["none", "cbf:alpha=50"], record=True, **given)
    bare, filtered = answer.rows
    assert (bare.intervention_rate, filtered.intervention_rate) == (0.0, 0.0)
    for name in ("safe", "return_mean", "effort_mean", "min_h_median", "curve"):
        assert getattr(bare, name) == getattr(filtered, name)
    states = [answer.trajectories[row.filter].states for row in answer.rows]
    np.testing.assert_array_equal(*states)


def test_a_filter_may_have_a_condition_for_each_barrier_and_be_objects():
    problem = make_problem(DUBINS, horizon=1.0, noise=0.4)
    disk = problem.barriers[0]
    wall = replace(disk, name="wall", expression=1 - problem.plant.states[0])
    problem = replace(problem, barriers=(disk, wall))
    filters = ["hocbf:alpha=1.0,1.0+hocbf:alpha=2.0,8.0", "hocbf:alpha=2.0,8.0+hocbf:alpha=1.0,1.0"]
    objects = [HOCBF(alpha=(2.0, 8.0)), (SCBF.for_gains((1.0, 1.0)),) * 2]
    answer = evaluate(problem, filters=[*filters, *objects], episodes=20, bounds=False)
    names = [*filters, "hocbf:alpha=2.0,8.0"]
    assert [f["spec"] for f in answer.config["filters"]][:3] == names
    assert len({row.effort_mean for row in answer.rows}) == 4
    (text,) = evaluate(problem, filters=spec_of(objects[0]), episodes=20, bounds=False).rows
    assert text == answer.rows[2]
    for call, fragment in (("hocbf+hocbf+hocbf", "3"), ((HOCBF(alpha=(1.0, 1.0)),) * 3, "3")):
        with pytest.raises(ConfigurationError, match=f"{fragment} conditions"):
            evaluate(problem, filters=[call])


def test_the_log_of_the_first_episode_has_its_decisions():
    found = evaluate(DUBINS, filters=["none", "hocbf"], episodes=3, record=True, bounds=False)
    log = found.trajectories["hocbf"].log
    env = SafetyFilterWrapper(gym.make(DUBINS), "hocbf")
    problem, policy = found.problem, NominalController(found.problem)
    observation, info = env.reset(seed=episode_seed(0, 0))
    sections = map(log.section, ("h", "nominal", "action", "slack"))
    for k, row in enumerate(zip(*sections, strict=True)):
        barrier = info["barrier"]
        state = log.section("state")[k]
        np.testing.assert_allclose(env.unwrapped.components, state, rtol=1e-9, atol=1e-12)
        action, _ = policy.predict(observation, deterministic=True)
        observation, _, terminated, truncated, info = env.step(action)
        expected = (barrier, info["nominal_action"], info["safe_action"], info["slacks"])
        for values, there in zip(row, expected, strict=True):
            np.testing.assert_allclose(values, there, rtol=1e-6, atol=1e-9)
        assert log.t[k] == pytest.approx(k * problem.dt)
        assert (log.intervention[k], log.feasible[k]) == (info["intervention"], info["feasible"])
    assert terminated or truncated
    assert log.interventions == info["episode_interventions"] > 0
    assert log.columns.units["omega"] == "rad/s"
    np.testing.assert_array_equal(log.section("high")[:, 0], problem.input_bounds[0][1])
    # Without a filter what is proposed is executed.
    bare = found.trajectories["none"].log
    np.testing.assert_array_equal(bare.section("nominal"), bare.section("action"))
    assert np.ptp(bare.section("action")) > 0.0
    assert (bare.interventions, bare.infeasible) == (0, 0)
