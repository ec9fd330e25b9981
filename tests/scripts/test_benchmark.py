"""The benchmark measures; how fast things are is not tested here."""

from __future__ import annotations

import gc
import json
import math
import mmap
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from safe_envs.agents import evaluate
from safe_envs.agents.training import vec_env_speed as sb3_speed
from safe_envs.compiled.program import Program
from safe_envs.errors import ConfigurationError
from safe_envs.scripts import benchmark
from safe_envs.scripts.reports import benchmark_cases, benchmark_figures, command_times, latency
from safe_envs.scripts.reports.benchmark_cases import Case
from safe_envs.scripts.reports.benchmark_figures import Part
from safe_envs.scripts.reports.hand_written_loop import step_by_hand
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper

STEPS = ("env.step, filtered", "env.step, unfiltered")

pytestmark = pytest.mark.slow


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(benchmark_figures, "_ROUNDS", 1)
    monkeypatch.setattr(benchmark_figures, "_SECONDS_PER_ROUND", 1e-4)
    monkeypatch.setattr(sb3_speed, "speeds", partial(sb3_speed.speeds, steps=5, rounds=1))
    few = {
        "learned-hocbf": {"states": 200, "epochs": 2},
        "ddscbf": {"points": 30, "repetitions": 20},
        "bayesian": {"starts": 50},
    }
    learned = {
        name: (env_id, method, {**few[method], **{k: v for k, v in settings.items() if k == "way"}})
        for name, (env_id, method, settings) in benchmark_figures._LEARNED.items()
    }
    monkeypatch.setattr(benchmark_figures, "_LEARNED", learned)
    monkeypatch.setattr(benchmark_figures, "_EPISODES", {"numpy": 20, "compiled": 2})
    monkeypatch.setattr(latency, "_CALLS", 50)
    monkeypatch.setattr(latency, "_DRAWN", 1024)
    monkeypatch.setattr(command_times, "_ROUNDS", 1)
    monkeypatch.setattr(command_times, "MISTAKES", command_times.MISTAKES[:1])


def measured():
    """Return the figures of all parts."""
    return {name: v for part in benchmark_figures.parts() for name, v in part.measure().items()}


def part_of(figures):
    """Return what measures these."""
    return lambda: [Part("something", lambda: figures)]


@pytest.mark.slow
def test_figures_are_finite_and_positive_and_ratios_fit(quick, monkeypatch):
    monkeypatch.setattr(benchmark_figures, "is_available", lambda: False)
    figures = measured()
    tails = {name: figures.pop(name) for name in list(figures) if latency.is_latency(name)}
    assert all(math.isfinite(value) for value in tails.values())
    assert len(tails) == 6 * len(latency.COLUMNS)
    faults = [figures.pop(name) for name in list(figures) if name.startswith("page faults")]
    assert all(fault >= 0 for fault in faults)
    assert all(math.isfinite(value) and value > 0 for value in figures.values())
    for batch in (1, 32, 1024, 10_000):
        assert sum(name.startswith(f"filter call, {batch} state") for name in figures) == 1
    step, vector = "env.step, {}", "vector env, {}"
    assert figures["filtered / unfiltered env.step"] == pytest.approx(
        figures[step.format("filtered")] / figures[step.format("unfiltered")]
    )
    for name in ("unfiltered", "filtered"):
        assert figures[f"vector env, {name}, million steps a second"] == pytest.approx(
            1 / figures[vector.format(name)]
        )
    assert figures["speed of the filtered vector env / fused loop"] == pytest.approx(
        figures["hand-fused loop"] / figures[vector.format("filtered")]
    )
    assert benchmark_figures.side_by_side(figures) == {}


def test_engines_stand_side_by_side(quick, monkeypatch, capsys):
    monkeypatch.setattr(Program, "compiled", Program.plain)
    ran = []

    def noting(*arguments, **options):
        ran.append((options["engine"], options["jobs"]))
        return evaluate(*arguments, **options)

    monkeypatch.setattr("safe_envs.agents.evaluate", noting)
    monkeypatch.setattr(benchmark_cases, "NUM_ENVS", 1)
    for name in ("filter_calls", "several_constraints"):
        monkeypatch.setattr(benchmark_figures, name, dict)
    monkeypatch.setattr(benchmark_figures, "_LEARNED", {})
    monkeypatch.setattr(latency, "cases", dict)
    monkeypatch.setattr(
        benchmark_figures, "scalar_steps", lambda: dict.fromkeys(STEPS, Case(lambda: None))
    )
    benchmark.benchmark()
    lines = capsys.readouterr().out.split("engines side by side")[1].splitlines()[2:]
    rows = {line.split("  ")[0].strip(): line.split()[-3:] for line in lines if line.strip()}
    assert len(rows) == 5
    # The ratio is that of one core to one core.
    assert set(ran) == {("numpy", 1), ("compiled", 1), ("compiled", None)}
    for numpy_engine, compiled, ratio in rows.values():
        assert float(ratio) == pytest.approx(float(compiled) / float(numpy_engine), rel=0.02)


def test_the_hand_written_loop_does_the_work_of_the_env():
    n, limit = 4, 100
    env = SafetyFilterVectorWrapper(gym.make_vec(benchmark_cases.ENV_ID, num_envs=n), "scbf")
    observed, _ = env.reset(seed=0)
    observations, rewards = np.empty((n, 4), dtype=np.float32), np.empty(n)
    counters, ended = np.zeros((n, 4)), np.ones(n, dtype=bool)
    arrays = (
        np.arange(n, dtype=np.uint64),
        *np.array([[-1] * n, [0] * n]),
        np.zeros((n, 3)),
        np.zeros((n, 2)),
        counters,
        observations,
        rewards,
        ended,
    )
    step_by_hand(np.zeros((n, 1), dtype=np.float32), *arrays)
    np.testing.assert_allclose(observations, observed, rtol=1e-6)
    for k in range(limit):
        actions = np.full((n, 1), 0.3 - 0.01 * k, dtype=np.float32)
        observed, reward, terminated, truncated, info = env.step(actions)
        # In plain Python products of single precision would be rounded to it.
        step_by_hand(actions.astype(np.float64), *arrays)
        np.testing.assert_allclose(observations, observed, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(rewards, reward, rtol=1e-9)
        np.testing.assert_array_equal(ended, terminated | truncated)
    names = ("h_min", "episode_cost", "episode_interventions", "episode_infeasible")
    for column, name in zip(counters.T, names, strict=True):
        np.testing.assert_allclose(column, info[name], rtol=1e-6, err_msg=name)
    assert info["h_min"].max() > 0.0
    assert ended.all()


def test_command_prints_and_writes_the_figures(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(
        benchmark_figures, "parts", part_of({"filter call, 1 state": 5.0, "a ratio": 0.5})
    )
    benchmark.benchmark(tmp_path / "out.json")
    figures = json.loads((tmp_path / "out.json").read_text())
    out = capsys.readouterr().out
    for name in figures:
        assert name in out


def test_each_table_is_printed_before_the_next_part_is_measured(monkeypatch, capfd):
    seen = []

    def measure(name):
        seen.append(capfd.readouterr().out)
        return {name: 1.0}

    parts = [Part(f"part {name}", lambda name=name: measure(name)) for name in ("one", "two")]
    monkeypatch.setattr(benchmark_figures, "parts", lambda: parts)
    benchmark.benchmark()
    seen.append(capfd.readouterr().out)
    assert "measuring part one" in seen[0]
    assert "one" in seen[1].split("measuring part two")[0]
    assert "measuring part two" in seen[1]
    assert "two" in seen[2]
    assert "measuring" not in seen[2]


def test_earlier_figures_stand_beside_with_their_ratio(monkeypatch, tmp_path, capsys):
    earlier = tmp_path / "earlier.json"
    earlier.write_text('{"filter call, 1 state": 4.0, "hand-fused loop": 0.1}')
    monkeypatch.setattr(
        benchmark_figures, "parts", part_of({"filter call, 1 state": 5.0, "new": 0.5})
    )
    benchmark.benchmark(compare=earlier)
    lines = {
        line.rsplit("  ")[0].strip(): line.split()[-3:]
        for line in capsys.readouterr().out.splitlines()
        if line.strip()
    }
    rows = [cells for name, cells in lines.items() if name.startswith(("filter call", "new"))]
    assert rows == [["5", "4", "1.25"], ["0.5", "-", "-"]]


@pytest.mark.parametrize("text", ["[1]", '{"a": 1}', '{"hand-fused loop": "b"}', "no json", None])
def test_what_holds_no_earlier_figures_is_refused(tmp_path, text):
    if text is not None:
        (tmp_path / "earlier.json").write_text(text)
    with pytest.raises(ConfigurationError, match="safe-envs benchmark --json FILE"):
        benchmark.benchmark(compare=tmp_path / "earlier.json")


def test_the_fused_loop_does_the_work_of_the_filter():
    step = benchmark_cases.fused_loop().call
    cells = dict(zip(step.__code__.co_freevars, step.__closure__, strict=True))
    before = np.stack([cells[name].cell_contents for name in ("x", "y", "theta")], axis=1)
    step()
    env = gym.make("safe_envs/StochasticDubins-v0").unwrapped
    turned = (cells["theta"].cell_contents - before[:, 2]) / env.problem.dt
    result = SafetyFilterWrapper(env, "scbf").safety_filter.filter(
        before, np.full((len(before), 1), 3.0)
    )
    np.testing.assert_allclose(turned, result.action[:, 0], rtol=1e-9, atol=1e-9)
    assert result.active.any()
    assert not result.active.all()


def test_decisions_that_are_timed_are_what_their_names_say(monkeypatch):
    monkeypatch.setattr(latency, "_DRAWN", 2048)
    for name, calls in latency.cases().items():
        found = calls.decisions()
        assert len(calls.states) > 20
        assert (found.active.any(axis=1) == ("free" not in name)).all()
        assert (found.feasible == ("infeasible" not in name)).all()
        constraints, inputs = found.slack.shape[1], found.action.shape[1]
        expected = (3, 4) if "Quadrotor" in name else (1 if "one" in name else 3, 2)
        assert (constraints, inputs) == expected


def test_times_of_decisions_grow_from_the_middle_to_the_end(monkeypatch, capsys):
    monkeypatch.setattr(latency, "_CALLS", 200)
    monkeypatch.setattr(latency, "_DRAWN", 512)
    cases = {name: c for name, c in latency.cases().items() if "one constraint" in name}
    monkeypatch.setattr(latency, "cases", lambda: cases)
    figures = latency.measure()
    for values in latency.rows_of(figures).values():
        assert len(values) == len(latency.COLUMNS)
        median, p99, p999, most, p999_off, most_off, collections = values
        assert median <= p99 <= p999 <= most
        assert p999_off <= most_off
        assert collections >= 0
    monkeypatch.setattr(benchmark_figures, "parts", part_of(figures))
    benchmark.benchmark()
    out = capsys.readouterr().out
    assert all(name in out for name in (*cases, "p99.9", "gc off:", "collections"))
    assert "latency, " not in out


def test_collections_are_counted_and_switched_off():
    with latency._counted_collections() as counted:
        gc.collect()
        with latency._without_collections():
            assert not gc.isenabled()
        assert gc.isenabled()
    found = counted[0]
    gc.collect()
    assert 2 <= found == counted[0]


def test_page_faults_are_those_of_fresh_memory():
    resource = pytest.importorskip("resource")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    mmap.mmap(-1, 1 << 24).write(bytes(1 << 24))
    if resource.getrusage(resource.RUSAGE_SELF).ru_minflt == before:
        pytest.skip("this system does not count page faults")
    kept = np.zeros(1 << 20)
    (reused,) = benchmark_figures._page_faults(
        benchmark_cases.Case(lambda: kept.fill(1.0), calls=50)
    ).values()
    (fresh,) = benchmark_figures._page_faults(
        benchmark_cases.Case(lambda: mmap.mmap(-1, 1 << 24).write(bytes(1 << 24)), calls=5)
    ).values()
    assert reused < 1
    # 16 MiB at a time, in pages of at most 2 MiB.
    assert fresh >= 8


def test_a_system_that_counts_no_page_faults_gives_no_figure(monkeypatch):
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(resource, "getrusage", lambda who: SimpleNamespace(ru_minflt=0))
    assert benchmark_figures._page_faults(benchmark_cases.Case(lambda: None)) == {}
