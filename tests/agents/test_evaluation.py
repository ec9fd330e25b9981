"""Evaluation: what is counted, that it does not depend on the batch, and what it says about the world."""

from __future__ import annotations

import itertools
import json
import math
import tracemalloc
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import norm

from agents import NominalController, RandomPolicy, evaluate, load_problem, make_policy
from agents.episodes import Recorder, episode_seed, run_episodes
from agents.statistics import mcnemar_p, paired_difference_interval, rate_interval, wilson_interval
from safe_envs import ConfigurationError, RelativeDegreeError, SafeEnv
from safe_envs.vector import SafeVectorEnv
from wrappers import SafetyFilterWrapper

COUNTS = ("episodes", "safe", "violations")
MEASURES = ("safety_rate", "ci_low", "ci_high", "min_h_median", "min_h_p05", "effort_mean", "return_mean")
RATES = ("intervention_rate", "infeasible_rate")
KEYS = {"filter", "policy", *COUNTS, *MEASURES, *RATES, "curve", "bound", "bound_note", "certificate", "outside_rate", "learning"}


class Constant:
    """A policy of anybody's: it has `predict` and nothing else."""

    def __init__(self, action):
        self.action = action

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.full((len(observation), 1), self.action), state


class Schedule:
    """Physical inputs by the step, which it counts in the hidden state."""

    def __init__(self, problem, inputs):
        (low, high) = problem.box[0]
        self.actions = [(u - low) / (high - low) * 2 - 1 for u in inputs]
        self.starts = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.starts.append((state is None, bool(np.all(episode_start)), deterministic))
        k = 0 if state is None else state
        return np.full((len(observation), 1), self.actions[k]), k + 1


class Levelling:
    """ACC with A h = 0: the gap's rate equals tau times the acceleration."""

    def __init__(self, problem, tau):
        self.half = problem.box[0][1]
        self.tau = tau

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        own, lead, _ = observation.astype(np.float64).T
        force = 1650.0 * (lead - own) / self.tau + 0.1 + 5.0 * own + 0.25 * own**2
        return (force / self.half)[:, None], state


def steps_option(env_id, steps, **options):
    return {"horizon": steps * load_problem(env_id).dt, **options}


def bare_env(env_id, options):
    env = gym.make(env_id, disable_env_checker=True, **options).unwrapped
    assert isinstance(env, SafeEnv)
    return env


def survival(start, steps, factor, deviation):
    """P(h_1 > 0, ..., h_N > 0) of h_(k+1) = factor h_k + deviation N(0, 1), by quadrature over each step."""
    top, spacing = start + 8 * deviation * math.sqrt(steps), deviation / 8
    grid = np.arange(spacing / 2, top, spacing)
    kernel = spacing * norm.pdf(grid[None, :], factor * grid[:, None], deviation)
    beyond = norm.sf(top, factor * grid, deviation)
    probability = np.ones(len(grid))
    for _ in range(steps - 1):
        probability = kernel @ probability + beyond
    last = norm.pdf(grid, factor * start, deviation)
    return float(spacing * last @ probability + norm.sf(top, factor * start, deviation))


def replay(env_id, options, spec, policy_name, episodes, seed, knowledge="model"):
    """The row of an evaluation by brute force: the scalar env, an episode at a time, whole trajectories in lists."""
    safe, lowest, returns, efforts, kept = 0, [], [], [], []
    counted = intervened = infeasible = 0
    env = bare_env(env_id, options)
    policy = make_policy(policy_name, env.problem)
    run = env if spec == "none" else SafetyFilterWrapper(env, spec, knowledge)
    for i in range(episodes):
        policy.begin(range(i, i + 1), seed)
        observation, info = run.reset(seed=episode_seed(seed, i))
        h, steps, ended = [info["barrier"].min()], [], False
        while not ended:
            action = policy.predict(observation[None])[0][0]
            executed = env.physical_action(action)
            observation, reward, terminated, truncated, info = run.step(action)
            h.append(info["barrier"].min())
            executed = info["safe_action"] if spec != "none" else np.array(executed)
            steps.append((float(executed @ executed), info.get("intervention", False), not info.get("feasible", True), reward))
            ended = terminated or truncated
        first = next((k for k, value in enumerate(h) if value <= 0), len(h))
        before = steps[:first]
        safe += first == len(h)
        lowest.append(min(h))
        returns.append(sum(s[3] for s in steps))
        counted += len(before)
        intervened += sum(s[1] for s in before)
        infeasible += sum(s[2] for s in before)
        efforts += [np.mean([s[0] for s in before])] if before else []
        kept.append(h)
    low, high = rate_interval(safe, episodes)
    row = {
        "episodes": episodes,
        "safe": safe,
        "safety_rate": safe / episodes,
        "ci_low": low,
        "ci_high": high,
        "min_h_median": np.median(lowest),
        "min_h_p05": np.quantile(lowest, 0.05),
        "violations": episodes - safe,
        "intervention_rate": intervened / counted,
        "infeasible_rate": infeasible / counted,
        "effort_mean": np.mean(efforts),
        "return_mean": np.mean(returns),
    }
    return row, kept


def safe_so_far(trajectories, times, dt):
    """How many trajectories of h are positive up to each time; one that has ended stays as it was."""
    return [sum(min(h[: round(t / dt) + 1]) > 0 for h in trajectories) for t in times]


def assert_same_to_the_bit(first, second):
    assert json.dumps(first.rows) == json.dumps(second.rows)
    assert json.dumps(first.comparisons) == json.dumps(second.comparisons)
    assert first.config == second.config
    assert first.recorders.keys() == second.recorders.keys()
    for name, recorder in first.recorders.items():
        assert recorder.barrier.tobytes() == second.recorders[name].barrier.tobytes()
        assert recorder.states.tobytes() == second.recorders[name].states.tobytes()


def test_answer_is_the_same_for_every_num_envs(env_id):
    options = steps_option(env_id, 12, noise=0.2)
    # The mean of a bound over the starts goes the same way for all ids.
    arguments = {"options": options, "episodes": 66, "seed": 3, "record": True, "bounds": env_id.endswith("CubicSDEDisk-v0")}
    answers = [evaluate(env_id, num_envs=n, **arguments) for n in (64, 1, 7, 1000)]
    for other in answers[1:]:
        assert_same_to_the_bit(answers[0], other)
    assert len(answers[0].rows) == 2
    assert len(answers[0].comparisons) == 1


@pytest.mark.parametrize("policy", ["nominal", "random"])
@pytest.mark.parametrize(
    ("env_id", "filters", "options"),
    [
        # Episodes that end at different times: out of the workspace, and at the goal.
        ("Scalar-v0", ("none", "cbf:alpha=3"), {"noise": 0.9, "horizon": 3.0}),
        ("DubinsObstacle-v0", ("none", "hocbf"), {"noise": 0.1, "start": [2.0, 1.3, 0.3, 0.5, 1.0], "horizon": 2.0}),
        # More control periods than the noise is drawn ahead for.
        ("StochasticDubins-v0", ("none", "scbf"), {"dt": 0.01, "horizon": 2.7, "substeps": 2}),
    ],
)
def test_long_and_ending_episodes_are_the_same_for_every_num_envs(policy, env_id, filters, options):
    given = {"options": options, "episodes": 8, "seed": 1, "record": True, "bounds": False}
    answers = [evaluate(env_id, policy, filters, num_envs=n, **given) for n in (8, 1, 3)]
    for other in answers[1:]:
        assert_same_to_the_bit(answers[0], other)


def test_another_seed_is_another_answer():
    first, second = (evaluate("Scalar-v0", episodes=20, seed=s, options={"horizon": 0.5}) for s in (0, 1))
    assert first.rows[0]["return_mean"] != second.rows[0]["return_mean"]


def test_more_episodes_begin_with_the_same_ones():
    few, many = (evaluate("Scalar-v0", "random", episodes=n, options={"horizon": 0.5}, num_envs=8, record=True) for n in (10, 25))
    for name, recorder in few.recorders.items():
        assert recorder.barrier.tobytes() == np.ascontiguousarray(many.recorders[name].barrier[:, :10]).tobytes()


@pytest.mark.parametrize(
    ("env_id", "spec", "policy", "options"),
    [
        ("safe_envs/Scalar-v0", "none", "random", {"noise": 0.8}),
        ("safe_envs/Scalar-v0", "cbf:alpha=2", "nominal", {"noise": 0.5, "horizon": 2.0}),
        ("safe_envs/Scalar-v0", "scbf", "random", {"noise": 0.3, "box": [-0.2, 3.0], "horizon": 1.0}),
        ("safe_envs/StochasticDubins-v0", "scbf", "nominal", {"horizon": 3.0}),
        ("safe_envs/StochasticDubins-v0", "hocbf:p=1,1", "random", {"horizon": 3.0}),
        ("safe_envs/DubinsObstacle-v0", "hocbf", "nominal", {"noise": 0.05, "start": [1.5, 1.2, 0.3, 0.5, 1.0], "horizon": 3.0}),
        ("safe_envs/QuadrotorAltitude-v0", "ecbf", "nominal", {"horizon": 4.0}),
        ("safe_envs/Quadrotor-v0", "hocbf", "nominal", {"noise": 0.3, "horizon": 1.5, "barrier": {"half_width": 0.7}}),
    ],
)
def test_episodes_replayed_by_hand(env_id, spec, policy, options):
    episodes, seed = 14, 11
    answer = evaluate(env_id, policy, [spec], options=options, episodes=episodes, seed=seed, num_envs=5, record=True)
    row, trajectories = replay(env_id, options, spec, policy, episodes, seed)
    assert set(answer.rows[0]) == KEYS
    assert (answer.rows[0]["filter"], answer.rows[0]["policy"]) == (spec, policy)
    for key in COUNTS:
        assert answer.rows[0][key] == row[key], key
    for key in MEASURES + RATES:
        assert answer.rows[0][key] == pytest.approx(row[key], rel=1e-7, abs=1e-9), key
    recorded = answer.recorders[spec].barrier
    for i, h in enumerate(trajectories):
        np.testing.assert_allclose(recorded[: len(h), i], h, rtol=1e-6, atol=1e-7)
        assert np.isnan(recorded[len(h) :, i]).all()
    curve = answer.rows[0]["curve"]
    assert curve["safe"] == safe_so_far(trajectories, curve["time"], load_problem(env_id, options).dt)
    assert curve["rate"] == [count / episodes for count in curve["safe"]]
    assert all(later <= earlier for earlier, later in itertools.pairwise(curve["safe"]))
    assert (curve["rate"][-1], curve["ci_low"][-1], curve["ci_high"][-1]) == tuple(
        answer.rows[0][key] for key in ("safety_rate", "ci_low", "ci_high")
    )
    timing = answer.timing["rows"][0]
    assert timing["steps"] == sum(len(h) - 1 for h in trajectories)
    assert timing["seconds"] > 0
    assert timing["steps_per_second"] == pytest.approx(timing["steps"] / timing["seconds"])


def test_filters_that_know_the_plant_are_replayed_too():
    env_id, options = "safe_envs/QuadrotorAltitude-v0", {"horizon": 3.0, "start": [5.0, 2.0]}
    for knowledge in ("model", "plant"):
        answer = evaluate(env_id, filters=["hocbf"], options=options, episodes=1, knowledge=knowledge)
        row, _ = replay(env_id, options, "hocbf", "nominal", 1, 0, knowledge)
        assert answer.rows[0]["min_h_median"] == pytest.approx(row["min_h_median"], rel=1e-9)
        assert answer.rows[0]["effort_mean"] == pytest.approx(row["effort_mean"], rel=1e-9)


def test_counting_ends_with_the_first_violation_and_simulation_goes_on():
    # dx = (x + u) dt under constant u: x' = e^dt x + (e^dt - 1) u. Over the edge with the fourth input, back, and over again.
    problem = load_problem("Scalar-v0", {"noise": 0.0, "start": [0.9], "dt": 0.05, "horizon": 0.5})
    inputs = [-0.5, -1.0, -0.9, 4.0, -9.0, -9.0, 0.0, 0.0, 9.0, 9.0]
    x, grown = [0.9], math.exp(0.05)
    for u in inputs:
        x.append(grown * x[-1] + (grown - 1) * u)
    h = 1 - np.array(x)
    assert (h[:4] > 0).all()
    assert h[4] < 0
    assert (h[5:9] > 0).all()
    assert h[10] == h.min() < 0
    policy = Schedule(problem, inputs)
    (row,) = evaluate(problem, policy, ["none"], episodes=3, num_envs=2).rows
    assert (row["safe"], row["violations"], row["policy"]) == (0, 3, "Schedule")
    assert row["min_h_median"] == pytest.approx(h.min(), rel=1e-6)
    assert row["effort_mean"] == pytest.approx(np.mean(np.square(inputs[:4])))
    assert row["return_mean"] == pytest.approx(np.exp(-((2 * h[1:]) ** 2)).sum(), rel=1e-6)
    # Two waves of ten steps; a hidden state is None, and an episode starts, at the first of them alone.
    assert policy.starts == 2 * [(True, True, True), *(9 * [(False, False, True)])]


def test_curve_of_one_episode_falls_at_its_first_violation_for_good():
    problem = load_problem("Scalar-v0", {"noise": 0.0, "start": [0.9], "dt": 0.05, "horizon": 0.5})
    inputs = [-0.5, -1.0, -0.9, 4.0, -9.0, -9.0, 0.0, 0.0, 9.0, 9.0]
    (row,) = evaluate(problem, Schedule(problem, inputs), ["none"], episodes=3, num_envs=2).rows
    assert row["curve"]["time"] == [k * 0.05 for k in range(11)]
    assert row["curve"]["safe"] == [3] * 4 + [0] * 7


def test_curve_of_a_long_episode_is_thinned_out():
    # The inputs let x grow by dt in each of 701 steps: x' = e^dt x + (e^dt - 1) u.
    options = {"noise": 0.0, "start": [0.0], "dt": 1e-3, "horizon": 0.701, "box": [-2.0, 2.0]}
    x = np.cumsum([0.0] + [1e-3] * 701)
    inputs = (x[1:] - math.exp(1e-3) * x[:-1]) / (math.exp(1e-3) - 1)
    for last in (301, 303, 700, 701):
        problem = load_problem("Scalar-v0", {**options, "barrier": {"limit": float(x[last - 1] + x[last]) / 2}})
        (row,) = evaluate(problem, Schedule(problem, inputs), ["none"], episodes=2).rows
        assert len(row["curve"]["time"]) == 177
        assert row["curve"]["time"][-1] == pytest.approx(0.701)
        assert row["curve"]["safe"] == [2 if round(t / 1e-3) < last else 0 for t in row["curve"]["time"]]


def test_comparisons_are_of_the_same_episodes():
    filters = ["none", "hocbf:p=1,2", "scbf"]
    arguments = {"options": {"horizon": 4.0, "noise": 0.4}, "episodes": 150, "seed": 4, "bounds": False}
    answer = evaluate("StochasticDubins-v0", filters=filters, num_envs=64, record=True, confidence=0.9, **arguments)
    safe = {name: (answer.recorders[name].barrier > 0).all(axis=0) for name in filters}
    assert [(c["first"], c["second"]) for c in answer.comparisons] == [
        ("hocbf:p=1,2", "none"),
        ("scbf", "none"),
        ("scbf", "hocbf:p=1,2"),
    ]
    for c in answer.comparisons:
        a, b = safe[c["first"]], safe[c["second"]]
        table = [int(flags.sum()) for flags in (a & b, a & ~b, ~a & b, ~a & ~b)]
        assert [c[key] for key in ("both", "only_first", "only_second", "neither")] == table
        assert c["difference"] == pytest.approx(a.mean() - b.mean())
        assert (c["ci_low"], c["ci_high"]) == paired_difference_interval(*table, 0.9)
        assert c["mcnemar_p"] == mcnemar_p(*table[1:3])
    assert min(answer.comparisons[2][key] for key in ("both", "only_first", "neither")) > 0
    assert answer.document()["comparisons"] == answer.comparisons
    assert evaluate("StochasticDubins-v0", filters=["scbf"], **arguments).comparisons == []


def test_confidence_is_that_of_every_interval():
    options = {"horizon": 1.0, "noise": 0.5}
    narrow, wide = (evaluate("Scalar-v0", filters=["none", "scbf"], options=options, episodes=200, confidence=c) for c in (0.5, 0.999))
    assert (narrow.config["confidence"], wide.config["confidence"]) == (0.5, 0.999)
    for a, b in zip(narrow.rows, wide.rows, strict=True):
        assert (a["ci_low"], a["ci_high"]) == rate_interval(a["safe"], 200, 0.5)
        assert b["ci_low"] < a["ci_low"] < a["safety_rate"] < a["ci_high"] < b["ci_high"]
        assert b["curve"]["ci_low"][-1] < a["curve"]["ci_low"][-1]
        assert a["curve"]["rate"] == b["curve"]["rate"]
    assert wide.comparisons[0]["ci_low"] < narrow.comparisons[0]["ci_low"]


def test_episodes_that_are_all_safe_have_the_exact_interval():
    (row,) = evaluate("ACC-v0", filters=["scbf"], options={"horizon": 0.2}, episodes=1000).rows
    assert (row["safe"], row["ci_low"], row["ci_high"]) == (1000, pytest.approx(0.025 ** (1 / 1000)), 1.0)


def test_starts_are_told_wave_by_wave():
    problem = load_problem("StochasticDubins-v0", {"horizon": 0.2})
    policy = NominalController(problem)
    told = []
    totals = run_episodes(SafeVectorEnv(problem, 4), policy, 10, 7, on_start=lambda x, count: told.append((np.stack(x), count)))
    assert totals.episodes == 10
    assert [(x.shape, count) for x, count in told] == [((3, 4), 4), ((3, 4), 4), ((3, 4), 2)]
    starts = np.concatenate([x[:, :count] for x, count in told], axis=1).T
    recorded = evaluate(problem, policy, ["none"], episodes=10, seed=7, record=True).recorders["none"].states[0]
    np.testing.assert_array_equal(starts, recorded)


def test_interventions_after_a_violation_do_not_count():
    # With u = 0 at first, x grows over the edge in step 3; a box with no negative input makes each later step infeasible.
    problem = load_problem("Scalar-v0", {"noise": 0.0, "start": [0.95], "dt": 0.02, "box": [-0.5, 1.0], "horizon": 0.2})
    (row,) = evaluate(problem, Constant(1.0), ["cbf:alpha=1"], episodes=1).rows
    # The condition 1 - x - (x + u) >= 0 asks for u <= 1 - 2 x < -.5 from the start: the least-violating action is -.5.
    steps = 0
    x = 0.95
    while x < 1.0:
        x = math.exp(0.02) * x - 0.5 * (math.exp(0.02) - 1)
        steps += 1
    assert 1 < steps < 10
    assert (row["intervention_rate"], row["infeasible_rate"], row["safe"]) == (1.0, 1.0, 0)
    assert row["effort_mean"] == pytest.approx(0.25)
    (mixed,) = evaluate(problem, Schedule(problem, [-0.5] * steps + [1.0] * (10 - steps)), ["cbf:alpha=1"], episodes=1).rows
    assert mixed["intervention_rate"] == 0.0


def test_an_episode_that_starts_on_the_edge_is_unsafe_and_counts_no_step():
    options = {"noise": 0.0, "start": [1.0], "horizon": 0.1}
    answer = evaluate("Scalar-v0", Constant(-0.5), ["none", "scbf"], options=options, episodes=2)
    for row in answer.rows:
        assert (row["safe"], row["violations"], row["safety_rate"]) == (0, 2, 0.0)
        assert (row["intervention_rate"], row["infeasible_rate"], row["effort_mean"]) == (None, None, None)
        assert row["min_h_median"] == row["min_h_p05"] == 0.0
        assert row["return_mean"] > 0
    json.dumps(answer.document(), allow_nan=False)


def test_touching_the_edge_is_unsafe():
    options = {"noise": 0.0, "start": [0.5], "horizon": 0.05}
    up_and_down = [3.0, -3.0, -3.0, -3.0, -3.0]
    problem = load_problem("Scalar-v0", options)
    reached = evaluate(problem, Schedule(problem, up_and_down), ["none"], episodes=1, record=True).recorders["none"].states[:, 0, 0]
    assert reached[1] == reached.max()
    for limit, safe in ((reached[1], 0), (np.nextafter(reached[1], 1.0), 1)):
        problem = load_problem("Scalar-v0", {**options, "barrier": {"limit": float(limit)}})
        answer = evaluate(problem, Schedule(problem, up_and_down), ["none"], episodes=1, record=True)
        assert answer.recorders["none"].barrier[1, 0] == limit - reached[1]
        assert answer.rows[0]["safe"] == safe


def test_smallest_h_counts_the_start_and_the_last_instant():
    options = {"noise": 0.0, "start": [0.5], "horizon": 0.1}
    falling, rising = (evaluate("Scalar-v0", Constant(a), ["none"], options=options, episodes=1).rows[0] for a in (-1.0, 1.0))
    assert falling["min_h_median"] == 0.5
    assert rising["min_h_median"] == pytest.approx(1 - (math.exp(0.1) * 0.5 + (math.exp(0.1) - 1) * 10), rel=1e-6)


def test_a_filter_that_never_acts_leaves_everything_as_it_is():
    options = {"horizon": 3.0, "noise": 1.5}
    answer = evaluate("ACC-v0", "random", ["none", "cbf:alpha=50"], options=options, episodes=40, num_envs=16, record=True)
    bare, filtered = answer.rows
    assert (bare["intervention_rate"], filtered["intervention_rate"]) == (0.0, 0.0)
    alike = {"filter": "", "bound_note": "", "outside_rate": None}
    assert {**bare, **alike} == {**filtered, **alike}
    np.testing.assert_array_equal(answer.recorders["none"].states, answer.recorders["cbf:alpha=50"].states)


def test_filters_see_the_same_episodes_until_they_act():
    answer = evaluate("StochasticDubins-v0", "random", ["none", "hocbf"], episodes=30, options={"horizon": 2.0}, record=True, bounds=False)
    bare, filtered = (answer.recorders[name].states for name in ("none", "hocbf"))
    np.testing.assert_array_equal(bare[0], filtered[0])
    parted = (bare != filtered).any(axis=2)
    assert parted.any()
    # Together at first, and never together again.
    assert (np.diff(parted.astype(int), axis=0) >= 0).all()


def test_a_filter_may_have_a_condition_for_each_barrier():
    problem = load_problem("StochasticDubins-v0", {"horizon": 1.0, "noise": 0.4})
    disk = problem.barriers[0]
    wall = replace(disk, name="wall", expression=1 - problem.plant.states[0])
    problem = replace(problem, barriers=(disk, wall))
    filters = ["hocbf:p=1.0,1.0+hocbf:p=2.0,8.0", "hocbf:p=2.0,8.0+hocbf:p=1.0,1.0", "hocbf:p=2.0,8.0"]
    answer = evaluate(problem, filters=filters, episodes=30)
    assert [f["spec"] for f in answer.config["filters"]] == filters
    assert len({row["effort_mean"] for row in answer.rows}) == 3
    with pytest.raises(ConfigurationError, match="has 3 conditions"):
        evaluate(problem, filters=["hocbf+hocbf+hocbf"])


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
    first = evaluate("StochasticDubins-v0", "random", ["none", "hocbf"], options=options, episodes=25, seed=9, knowledge="plant")
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
        assert {**a, "filter": ""} == {**b, "filter": ""}
    assert "versions" in first.document()


def test_a_problem_gives_the_same_as_its_id_and_defaults_are_the_natural_filter(env_id):
    options = steps_option(env_id, 10)
    problem = load_problem(env_id, options)
    by_id = evaluate(env_id, options=options, episodes=5)
    by_problem = evaluate(problem, NominalController(problem), episodes=5)
    assert [row["filter"] for row in by_id.rows] == ["none", problem.filter]
    for a, b in zip(by_id.rows, by_problem.rows, strict=True):
        assert {**a, "policy": ""} == {**b, "policy": ""}
    assert (by_id.config["env_id"], by_problem.config["env_id"]) == (env_id, None)
    assert by_id.config["problem"] == by_problem.config["problem"]


@pytest.mark.parametrize(("scheme", "tolerance"), [("policy", 0.999), ("filter", 0.999)])
def test_gaussian_law_of_adaptive_cruise_control(scheme, tolerance):
    # A h = 0 makes h_t = h_0 - tau sigma_1 W_t; an Euler-Maruyama step keeps that exactly. In one case a policy holds
    # A h at 0, in the other the scbf holds a policy back that only wants to drive faster.
    tau, sigma, dt, horizon, distance = 1.8, 1.0, 0.05, 10.0, 5.0
    options = {"start": [15.0, 20.0, tau * 15 + distance], "box": [-1e5, 1e5], "horizon": horizon, "noise": sigma, "dt": dt}
    problem = load_problem("ACC-v0", options)
    policy, filters = (Levelling(problem, tau), ["none"]) if scheme == "policy" else (Constant(1.0), ["scbf"])
    (row,) = evaluate("ACC-v0", policy, filters, options=options, episodes=6000, seed=1).rows
    deviation = tau * sigma * math.sqrt(horizon)
    shifted = 1 - 2 * norm.cdf(-(distance + 0.5826 * tau * sigma * math.sqrt(dt)) / deviation)
    low, high = wilson_interval(row["safe"], row["episodes"], tolerance)
    assert low <= shifted <= high
    exact = survival(distance, round(horizon / dt), 1.0, tau * sigma * math.sqrt(dt))
    assert exact == pytest.approx(shifted, abs=1e-3)
    assert low <= exact <= high
    # The distribution of the smallest h, from the same law at other levels.
    for key, level in (("min_h_median", 0.5), ("min_h_p05", 0.05)):
        below = 2 * norm.cdf(-(distance - row[key] + 0.5826 * tau * sigma * math.sqrt(dt)) / deviation)
        assert below == pytest.approx(level, abs=4.0 * math.sqrt(level * (1 - level) / 6000))
    if scheme == "filter":
        assert (row["intervention_rate"], row["infeasible_rate"]) == (1.0, 0.0)


def test_law_of_the_scalar_system():
    # The nominal controller makes dh = -h dt + sigma dW, symmetric about the edge: P(safe) = 2 Phi(mean/deviation) - 1
    # in continuous time by reflection, and by quadrature at the control instants.
    sigma, dt, horizon, distance = 0.8, 0.01, 0.6, 0.5
    options = {"start": [1 - distance], "noise": sigma, "horizon": horizon, "dt": dt, "box": [-100.0, 100.0]}
    (row,) = evaluate("Scalar-v0", filters=["none"], options=options, episodes=8000, seed=2).rows
    mean, deviation = distance * math.exp(-horizon), sigma * math.sqrt((1 - math.exp(-2 * horizon)) / 2)
    continuous = 2 * norm.cdf(mean / deviation) - 1
    exact = survival(distance, round(horizon / dt), 1 - dt, sigma * math.sqrt(dt))
    assert continuous < exact < continuous + 0.1
    assert survival(distance, 6 * 60, 1 - dt / 6, sigma * math.sqrt(dt / 6)) == pytest.approx(continuous, abs=0.03)
    low, high = wilson_interval(row["safe"], row["episodes"], 0.999)
    assert low <= exact <= high


def test_recorder_keeps_a_bounded_number_of_episodes():
    recorder = Recorder(100, 12, 10**9)
    assert recorder.barrier.shape == (101, 256)
    assert recorder.states.shape == (101, 32, 12)
    answer = evaluate("Scalar-v0", filters=["none"], episodes=300, num_envs=90, options={"horizon": 0.05}, record=True)
    kept = answer.recorders["none"]
    assert kept.barrier.shape == (6, 256)
    assert kept.states.shape == (6, 32, 1)
    assert np.isfinite(kept.barrier).all()
    np.testing.assert_allclose(kept.barrier[:, :32], 1 - kept.states[:, :, 0])
    assert evaluate("Scalar-v0", filters=["none"], episodes=2, options={"horizon": 0.05}).recorders == {}


def test_memory_does_not_grow_with_the_episodes():
    def peak(episodes):
        tracemalloc.start()
        try:
            evaluate("Scalar-v0", filters=["none"], episodes=episodes, num_envs=512, options={"horizon": 0.1}, record=True)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(512)
    few, many = peak(512), peak(5120)
    # Of an episode nothing but the smallest h is kept (of the first 65536, and copied twice for their quantiles):
    # that is far less than its steps or even its statistics.
    assert many - few < 4 * 8 * (5120 - 512)


def test_progress_goes_from_nothing_to_all():
    told = []
    evaluate("Scalar-v0", filters=["none", "scbf"], episodes=7, num_envs=3, options={"horizon": 0.05}, progress=told.append)
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
    answer = evaluate(env_id, policy, ["none"], options={**options, "horizon": 0.2}, episodes=4, record=True)
    assert answer.repeats == repeats
    barrier = answer.recorders["none"].barrier
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
        ({"filters": ["hocbf+none"]}, "'hocbf\\+none': 'none' is the bare env"),
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
        evaluate(load_problem("Scalar-v0"), options={"noise": 1.0})


def test_episode_seeds_differ():
    seeds = {episode_seed(seed, i) for seed in range(20) for i in range(200)}
    assert len(seeds) == 4000
    assert all(0 <= s < 2**64 for s in seeds)


def test_random_policy_and_noise_do_not_share_their_numbers():
    problem = load_problem("Scalar-v0")
    policy = RandomPolicy(problem)
    policy.begin(range(400), seed=0)
    actions = policy.predict(np.zeros((400, 1)))[0][:, 0]
    starts = [np.random.default_rng(episode_seed(0, i)).random() for i in range(400)]
    assert abs(np.corrcoef(actions, starts)[0, 1]) < 5 / math.sqrt(400)
