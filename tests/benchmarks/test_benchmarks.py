"""The benchmarks measure what they name; how fast things are is not tested here."""

from __future__ import annotations

import math
import subprocess
import sys
from functools import partial

import gymnasium as gym
import numpy as np
import pytest

from benchmarks import __main__ as command
from benchmarks import cases, command_times, figures, latency
from benchmarks.command_times import MISTAKES
from benchmarks.figures import Part
from benchmarks.hand_written_loop import step_by_hand
from safe_envs.agents.training import vec_env
from safe_envs.scripts.reports.installation import ENV_ID
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper
from tests.scripts.conftest import strictly


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Runs the command in this process, in an empty folder; returns status and what it printed."""
    monkeypatch.chdir(tmp_path)

    def run_with(*words):
        monkeypatch.setattr("sys.argv", ["benchmarks", *map(str, words)])
        status = 0
        try:
            command.main()
        except SystemExit as ended:
            status = ended.code
        return status, *capsys.readouterr()

    return run_with


@pytest.fixture
def measured(monkeypatch):
    """Makes given figures those of two parts."""

    def measure(first, second):
        parts = [Part("one", lambda: first), Part("two", lambda: second)]
        monkeypatch.setattr(figures, "parts", lambda: parts)

    return measure


TAIL = {f"{latency._PREFIX}a case: {column}": 2.5 for column in latency.COLUMNS}
SPEED = f"evaluation, filtered, {figures._SPEED}"


def test_tables_are_printed_and_figures_written(run, measured):
    measured({"filter call": 5.0, **TAIL}, {SPEED: 2.0, f"{figures.COMPILED}{SPEED}": 30.0})
    status, out, err = run("--json", "out.json")
    assert (status, err) == (0, "")
    found = strictly("out.json")
    assert found == {"filter call": 5.0, **TAIL, SPEED: 2.0, f"{figures.COMPILED}{SPEED}": 30.0}
    assert out.index("measuring one") < out.index("filter call") < out.index("measuring two")
    assert all(word in out for word in ("a case", "p99.9", "engines side by side"))
    assert "latency, " not in out
    # The ratio of the engines.
    assert out.split("engines side by side")[1].split()[-1] == "15"


def test_earlier_figures_stand_next_to_them_with_their_ratio(run, measured, tmp_path):
    (tmp_path / "earlier.json").write_text('{"filter call": 4.0, "hand-fused loop": 0.1}')
    measured({"filter call": 5.0}, {"new": 0.5})
    status, out, _ = run("--compare", "earlier.json")
    assert status == 0
    rows = {line.split("  ")[0]: line.split()[-3:] for line in out.splitlines() if line}
    assert rows["filter call"] == ["5", "4", "1.25"]
    assert rows["new"] == ["0.5", "-", "-"]


@pytest.mark.parametrize("text", ["[1]", '{"a": 1}', '{"hand-fused loop": "b"}', "no json", None])
def test_what_holds_no_earlier_figures_is_refused(run, tmp_path, text):
    if text is not None:
        (tmp_path / "earlier.json").write_text(text)
    status, out, err = run("--compare", "earlier.json")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert "earlier.json" in err


def test_a_path_is_checked_before_anything_is_measured(run):
    status, out, err = run("--json", "nowhere/out.json")
    assert (status, out) == (2, "")
    assert "nowhere/out.json" in err


def test_the_hand_written_loop_does_the_work_of_the_env():
    n, limit = 4, 100
    env = SafetyFilterVectorWrapper(gym.make_vec(ENV_ID, num_envs=n), "scbf")
    observed, _ = env.reset(seed=0)
    observations, rewards = np.empty((n, 4), dtype=np.float32), np.empty(n)
    counters, ended = np.zeros((n, 4)), np.ones(n, dtype=bool)
    numbers = np.array([[-1] * n, [0] * n])
    state = np.zeros((n, 3)), np.zeros((n, 2)), counters
    arrays = (np.arange(n, dtype=np.uint64), *numbers, *state, observations, rewards, ended)
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


def test_the_fused_loop_does_the_work_of_the_filter():
    step = cases.fused_loop().call
    cells = dict(zip(step.__code__.co_freevars, step.__closure__, strict=True))
    before = np.stack([cells[name].cell_contents for name in ("x", "y", "theta")], axis=1)
    step()
    env = gym.make(ENV_ID).unwrapped
    turned = (cells["theta"].cell_contents - before[:, 2]) / env.problem.dt
    decide = SafetyFilterWrapper(env, "scbf").safety_filter.filter
    result = decide(before, np.full((len(before), 1), 3.0))
    np.testing.assert_allclose(turned, result.action[:, 0], rtol=1e-9, atol=1e-9)
    assert 0 < result.active.sum() < len(before)


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


def test_processor_times_of_commands_are_measured(monkeypatch):
    monkeypatch.setattr(command_times, "_ROUNDS", 1)
    monkeypatch.setattr(command_times, "MISTAKES", MISTAKES[:1])
    monkeypatch.setattr(command_times, "_WITHOUT_MISTAKE", (("--version",),))
    found = command_times.measure()
    assert [name for name in found if name.startswith("safe-envs")] == [
        "safe-envs --version, s",
        "safe-envs evalute, s",
    ]
    assert all(0 < seconds < 60 for seconds in found.values())
    # Where the package is not found, every command would seem to be quick.
    monkeypatch.setattr(command_times, "_WITHOUT_MISTAKE", (("no-such-command",),))
    with pytest.raises(RuntimeError, match="ended with 2"):
        command_times.measure()


@pytest.mark.parametrize("words", MISTAKES, ids=" ".join)
def test_a_mistake_ends_with_status_2_and_one_line(safe_envs_command, words):
    status, out, err = safe_envs_command(*words)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("Error: ")
    assert len(err) < 400


def test_no_mistake_needs_symbolic_algebra(tmp_path):
    code = f"""
import sys
from contextlib import suppress

from safe_envs.scripts import cli

HEAVY = ("sympy", "scipy", "torch", "safe_envs.problem.problem", "safe_envs.agents.evaluation")
for words in (("--help",), ("--version",), ("list",), *{MISTAKES!r}):
    sys.argv = ["safe-envs", *words]
    with suppress(SystemExit):
        cli.main()
    found = [name for name in HEAVY if name in sys.modules]
    assert not found, (words, found)
"""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Error: ") == len(MISTAKES) == len(set(MISTAKES)) == 25


@pytest.mark.oracle
def test_figures_are_finite_and_ratios_fit(monkeypatch):
    monkeypatch.setattr(figures, "_ROUNDS", 1)
    monkeypatch.setattr(figures, "_SECONDS_PER_ROUND", 1e-4)
    monkeypatch.setattr(figures, "_EPISODES", {"numpy": 20, "compiled": 20})
    monkeypatch.setattr(latency, "_CALLS", 50)
    monkeypatch.setattr(latency, "_DRAWN", 1024)
    monkeypatch.setattr(command_times, "_ROUNDS", 1)
    speeds = partial(vec_env.speeds, steps=5, rounds=1)
    monkeypatch.setattr(vec_env, "speeds", speeds)
    found = {name: value for part in figures.parts() for name, value in part.measure().items()}
    assert all(math.isfinite(value) and value >= 0 for value in found.values())
    assert len(latency.rows_of(found)) == 6
    step, vector = (found[f"{kind}, filtered"] for kind in ("env.step", "vector env"))
    for name, expected in {
        "filtered / unfiltered env.step": step / found["env.step, unfiltered"],
        f"vector env, filtered, {figures._SPEED}": 1 / vector,
        "speed of the filtered vector env / fused loop": found[figures.FUSED] / vector,
    }.items():
        assert found[name] == pytest.approx(expected)
    sides = figures.side_by_side(found)
    assert len(sides) == (5 if figures.is_available() else 0)
