"""An evaluation depends on neither the batch nor the processes, and keeps little."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import NominalController, evaluate, make_problem
from safe_envs.agents.evaluation.evaluate import refine
from tests.conftest import problem_of

pytestmark = pytest.mark.slow

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
        (
            "DubinsObstacle-v0",
            "nominal",
            ("none", "hocbf"),
            {"noise": 0.1, "start": [2.0, 1.3, 0.3, 0.5, 1.0]},
            {},
        ),
        # More control periods than the noise is drawn ahead for, and bridges.
        (
            "Scalar-v0",
            "nominal",
            ("none",),
            {"noise": 0.6, "horizon": 3.0, "dt": 0.008},
            {"monitoring": "continuous"},
        ),
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


def test_config_is_enough_to_run_it_again():
    options = {
        "noise": [0.3, 0.1],
        "plant": {"v": 1.7},
        "model": {"v": 1.9},
        "barrier": {"radius": 2.5},
        "dt": 0.1,
        "substeps": 2,
        "horizon": 1.0,
        "input_bounds": [-4.0, 5.0],
        "start": [0.5, 0.0, 1.0],
    }
    given = {"episodes": 10, "seed": 9, "knowledge": "plant", "bounds": False}
    first = evaluate("StochasticDubins-v0", "random", ["none", "hocbf"], options=options, **given)
    config = json.loads(json.dumps(first.config, allow_nan=False))
    again = evaluate(
        config["env_id"],
        config["policy"]["name"],
        [f["spec"] for f in config["filters"]],
        options=config["options"],
        **{name: config[name] for name in ("episodes", "seed", "knowledge")},
        bounds=False,
    )
    assert config["env_id"] == "safe_envs/StochasticDubins-v0"
    assert (config["problem"]["plant"]["v"], config["problem"]["model"]["v"]) == (1.7, 1.9)
    for a, b in zip(first.rows, again.rows, strict=True):
        assert replace(a, filter="") == replace(b, filter="")


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
    [
        (evaluate, (0.5,)),
        (refine, (1 / 16, 1 / 8, 2 / 8, 4 / 8)),
    ],
)
def test_progress_goes_from_nothing_to_all(call, shares):
    told = []
    call(
        "Scalar-v0", filters=["none", "scbf"], episodes=7, num_envs=3, progress=told.append, **SHORT
    )
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
