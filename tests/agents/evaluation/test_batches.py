"""An evaluation depends on neither the batch nor the way it was asked for, and keeps little."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from safe_envs import ConfigurationError, RelativeDegreeError
from safe_envs.agents import NominalController, evaluate, make_problem
from safe_envs.agents.evaluation import episodes as played
from safe_envs.agents.evaluation.episodes import Trajectories, play
from safe_envs.envs.vector_env import SafeVectorEnv

pytestmark = pytest.mark.slow


def assert_same_to_the_bit(first, second):
    texts = [json.dumps({**each.document(), "timing": None}) for each in (first, second)]
    assert texts[0] == texts[1]
    columns = [each.episode_columns() for each in (first, second)]
    for name, values in columns[0].items():
        assert values.tobytes() == columns[1][name].tobytes(), name
    assert first.config == second.config
    assert first.trajectories.keys() == second.trajectories.keys()
    for name, recorder in first.trajectories.items():
        assert recorder.barrier.tobytes() == second.trajectories[name].barrier.tobytes()
        assert recorder.states.tobytes() == second.trajectories[name].states.tobytes()
        assert recorder.log.table().tobytes() == second.trajectories[name].log.table().tobytes()


def test_answer_is_the_same_for_every_num_envs(env_id):
    problem = make_problem(env_id, noise=0.2)
    problem = problem.configured(horizon=6 * problem.dt)
    # The mean of a bound over the starts goes the same way for all ids.
    arguments = {
        "episodes": 5,
        "seed": 3,
        "record": True,
        "bounds": env_id.endswith("CubicSDEDisk-v0"),
    }
    answers = [evaluate(problem, num_envs=n, **arguments) for n in (100, 3, 1)]
    for other in answers[1:]:
        assert_same_to_the_bit(answers[0], other)
    assert len(answers[0].rows) == 2
    assert len(answers[0].comparisons) == 1


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["nominal", "random"])
@pytest.mark.parametrize(
    ("env_id", "filters", "options"),
    [
        # Episodes that end at different times: out of the workspace, and at the goal.
        ("Scalar-v0", ("none", "cbf:alpha=3"), {"noise": 0.9, "horizon": 3.0, "dt": 0.02}),
        (
            "DubinsObstacle-v0",
            ("none", "hocbf"),
            {"noise": 0.1, "start": [2.0, 1.3, 0.3, 0.5, 1.0], "horizon": 2.0},
        ),
        # More control periods than the noise is drawn ahead for.
        ("StochasticDubins-v0", ("none", "scbf"), {"dt": 0.01, "horizon": 2.7, "substeps": 2}),
    ],
)
def test_long_and_ending_episodes_are_the_same_for_every_num_envs(policy, env_id, filters, options):
    problem = make_problem(env_id, **options)
    given = {"episodes": 3, "seed": 1, "record": True, "bounds": False}
    answers = [evaluate(problem, policy, filters, num_envs=n, **given) for n in (3, 1, 2)]
    for other in answers[1:]:
        assert_same_to_the_bit(answers[0], other)


def test_another_seed_is_another_answer():
    first, second = (
        evaluate("Scalar-v0", episodes=20, seed=s, options={"horizon": 0.5}, bounds=False)
        for s in (0, 1)
    )
    assert first.rows[0].return_mean != second.rows[0].return_mean


def test_more_episodes_begin_with_the_same_ones():
    arguments = {"options": {"horizon": 0.5}, "num_envs": 8, "record": True, "bounds": False}
    few, many = (evaluate("Scalar-v0", "random", episodes=n, **arguments) for n in (10, 25))
    for name, recorder in few.trajectories.items():
        assert (
            recorder.barrier.tobytes()
            == np.ascontiguousarray(many.trajectories[name].barrier[:, :10]).tobytes()
        )


def test_batches_have_the_starts_of_their_episodes():
    problem = make_problem("StochasticDubins-v0", horizon=0.2)
    policy = NominalController(problem)
    found = [batch.starts for batch in play(SafeVectorEnv(problem, 4), policy, range(10), 7)]
    assert [x.shape for x in found] == [(4, 3), (4, 3), (2, 3)]
    starts = np.concatenate(found)
    recorded = (
        evaluate(problem, policy, ["none"], episodes=10, seed=7, record=True)
        .trajectories["none"]
        .states[0]
    )
    np.testing.assert_array_equal(starts, recorded)


def test_config_is_enough_to_run_it_again():
    options = {
        "noise": [0.3, 0.1],
        "plant": {"v": 1.7},
        "model": {"v": 1.9},
        "barrier": {"radius": 2.5},
        "dt": 0.1,
        "substeps": 2,
        "horizon": 1.5,
        "box": [-4.0, 5.0],
        "start": [0.5, 0.0, 1.0],
    }
    first = evaluate(
        "StochasticDubins-v0",
        "random",
        ["none", "hocbf"],
        options=options,
        episodes=25,
        seed=9,
        knowledge="plant",
    )
    config = json.loads(json.dumps(first.config, allow_nan=False))
    again = evaluate(
        config["env_id"],
        config["policy"]["name"],
        [f["spec"] for f in config["filters"]],
        options=config["options"],
        episodes=config["episodes"],
        seed=config["seed"],
        knowledge=config["knowledge"],
        num_envs=4,
    )
    assert [f["name"] for f in config["filters"]] == ["none", "hocbf"]
    assert config["env_id"] == "safe_envs/StochasticDubins-v0"
    assert config["problem"]["plant"]["v"] == 1.7
    assert config["problem"]["model"]["v"] == 1.9
    for a, b in zip(first.rows, again.rows, strict=True):
        assert replace(a, filter="") == replace(b, filter="")
    assert "versions" in first.document()


def test_a_problem_gives_the_same_as_its_id_and_defaults_are_the_natural_filter(env_id):
    options = {"horizon": 5 * make_problem(env_id).dt}
    problem = make_problem(env_id, **options)
    # The bounds go the same way for all ids.
    arguments = {"episodes": 5, "bounds": env_id.endswith(("CubicSDEDisk-v0", "Pendulum-v0"))}
    by_id = evaluate(env_id, options=options, **arguments)
    by_problem = evaluate(problem, NominalController(problem), **arguments)
    assert [row.filter for row in by_id.rows] == ["none", problem.filter]
    for a, b in zip(by_id.rows, by_problem.rows, strict=True):
        assert replace(a, policy="") == replace(b, policy="")
    assert (by_id.config["env_id"], by_problem.config["env_id"]) == (env_id, None)
    assert by_id.config["problem"] == by_problem.config["problem"]


def test_trajectories_keep_a_bounded_number_of_episodes():
    recorder = Trajectories(make_problem("Quadrotor-v0", horizon=1.0, dt=0.01), 10**9)
    assert recorder.barrier.shape == (101, 256)
    assert recorder.states.shape == (101, 32, 12)
    answer = evaluate(
        "Scalar-v0",
        filters=["none"],
        episodes=300,
        num_envs=90,
        options={"horizon": 0.05},
        record=True,
    )
    kept = answer.trajectories["none"]
    assert kept.barrier.shape == (6, 256)
    assert kept.states.shape == (6, 32, 1)
    assert np.isfinite(kept.barrier).all()
    np.testing.assert_allclose(kept.barrier[:, :32], 1 - kept.states[:, :, 0])
    assert (
        evaluate("Scalar-v0", filters=["none"], episodes=2, options={"horizon": 0.05}).trajectories
        == {}
    )


@pytest.mark.slow
def test_memory_does_not_grow_with_episodes():
    problem = make_problem("Scalar-v0", horizon=0.02)

    def peak(episodes):
        tracemalloc.start()
        try:
            evaluate(
                problem,
                filters=["none"],
                episodes=episodes,
                num_envs=256,
                record=True,
                bounds=False,
                keep_episodes=False,
            )
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(256)
    few, many = peak(512), peak(5120)
    # The results of an episode, of which one bit is kept, take 40 bytes, and more to be joined.
    assert many - few < 10 * (5120 - 512)


def test_parts_of_processes_do_not_grow_with_episodes(monkeypatch):
    def largest(episodes):
        sizes, told = [], []

        def done(function, shared, parts, jobs):
            sizes.extend(map(len, parts))
            return ([] for _ in parts)

        monkeypatch.setattr(played, "compute_in_order", done)
        how = (episodes, 0, 1024, 2, False, told.append)
        no_env: Any = None
        assert list(played.play_in_processes(no_env, None, *how)) == []
        assert sum(sizes) == told[-1] == episodes
        return max(sizes)

    assert largest(5) == 1
    assert largest(800) == 100
    assert largest(10**7) == largest(10**8) == 65_536


def test_progress_goes_from_nothing_to_all():
    told = []
    evaluate(
        "Scalar-v0",
        filters=["none", "scbf"],
        episodes=7,
        num_envs=3,
        options={"horizon": 0.05},
        progress=told.append,
    )
    assert told == sorted(told)
    assert 0.0 < told[0] < 0.1
    assert told[-1] == 1.0
    assert 0.5 in told


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
    answer = evaluate(
        env_id, policy, ["none"], options={**options, "horizon": 0.2}, episodes=4, record=True
    )
    assert answer.is_deterministic == repeats
    barrier = answer.trajectories["none"].barrier
    assert (barrier == barrier[:, :1]).all() == repeats


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episodes": 0}, "episodes = 0"),
        ({"episodes": 1.5}, "episodes = 1.5"),
        ({"episodes": True}, "episodes = True"),
        ({"seed": -1}, "seed = -1"),
        ({"num_envs": 0}, "num_envs = 0"),
        ({"knowledge": "plan"}, "did you mean 'plant'"),
        ({"confidence": 1.0}, "confidence = 1.0; give a number above 0 and below 1"),
        ({"filters": ["hocbf+none"]}, "'hocbf\\+none': 'none' is the unfiltered env"),
        ({"filters": ["scb"]}, "unknown filter 'scb'; did you mean 'scbf'"),
        ({"filters": ["non"]}, "did you mean 'none'"),
        ({"filters": ["hocbf:q=1,1"]}, "no parameter 'q'"),
        ({"policy": "nominl"}, "did you mean 'nominal'"),
        ({"options": {"nois": 1}}, "did you mean 'noise'"),
    ],
)
def test_arguments_out_of_range_are_named(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        evaluate("StochasticDubins-v0", **arguments)


def test_conditions_that_do_not_suit_are_errors_before_any_episode():
    told = []
    with pytest.raises(RelativeDegreeError, match="use hocbf"):
        evaluate("StochasticDubins-v0", filters=["none", "cbf"], progress=told.append)
    assert told == []
    with pytest.raises(ConfigurationError, match="options"):
        evaluate(make_problem("Scalar-v0"), options={"noise": 1.0})
