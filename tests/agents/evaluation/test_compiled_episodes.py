"""The compiled engine counts what NumPy counts; programs run as plain Python but for one."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from safe_envs import ConfigurationError, NumericalError
from safe_envs.agents import evaluate, make_policy
from safe_envs.agents.evaluation import compiled_episodes
from safe_envs.agents.evaluation.brownian_bridge import BrownianBridge
from safe_envs.agents.evaluation.compiled_episodes import CompiledEpisodes
from safe_envs.agents.evaluation.episodes import play
from safe_envs.agents.jobs.job import available_threads, one_thread
from safe_envs.engine import choice as engine_module
from safe_envs.engine import program as program_module
from safe_envs.engine.program import Program
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers import SafetyFilter, SafetyFilterVectorWrapper
from tests.conftest import problem_of

"""Its default filter needs a solver."""


def programs(problem, text, policy="nominal", continuous=False):
    """The reference of NumPy, and a program."""
    actor = make_policy(policy, problem)
    env = SafeVectorEnv(problem, 8)
    bridge = BrownianBridge(problem) if continuous else None
    if text != "none":
        env = SafetyFilterVectorWrapper(env, text)
    qp = None if text == "none" else SafetyFilter.for_problem(problem, text).qp

    def reference(part, seed=3):
        return list(play(env, actor, part, seed, bridge=bridge))

    return reference, CompiledEpisodes(problem, actor, qp, continuous)


def no_reference(part):
    raise AssertionError(f"the program has no results for the episodes {part}")


def joined(batches):
    """The columns of all batches, their touching violations, and the states that are kept."""
    results = type(batches[0].results).joined([batch.results for batch in batches])
    columns = {field.name: getattr(results, field.name) for field in fields(results)}
    columns["starts"] = np.concatenate([batch.starts for batch in batches])
    visited = batches[0].visited
    for batch in batches[1:]:
        visited = visited.joined(batch.visited)
    return columns | vars(visited), sum(batch.slight.touching for batch in batches)


def assert_alike(found, expected, relative=1e-9):
    """Flags and counts are equal, and other numbers are but for rounding."""
    (ours, touching), (theirs, touching_too) = joined(found), joined(expected)
    assert touching == touching_too
    for name, column in theirs.items():
        assert ours[name].dtype == column.dtype, name
        np.testing.assert_allclose(
            ours[name], column, rtol=relative, atol=1e-12, err_msg=name, equal_nan=True
        )
        if column.dtype.kind == "i":
            assert (ours[name] == column).all(), name


def shortened(env_id, periods=4, **options):
    problem = problem_of(env_id, **options)
    return replace(problem, horizon=periods * problem.dt)


@pytest.mark.parametrize("filtered", [False, True], ids=["unfiltered", "filtered"])
def test_episodes_are_those_of_numpy(env_id, filtered):
    problem = shortened(env_id, noise=0.2)
    reference, program = programs(
        problem, problem.filter if filtered else "none", continuous=filtered
    )
    found = list(program.play(program.program.plain(), range(3), 3, 1, no_reference))
    assert_alike(found, reference(range(3)))


@pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
@pytest.mark.parametrize(
    ("env_id", "text", "policy", "options", "varied"),
    [
        # Violations after which an episode goes on, and ends out of the workspace.
        (
            "Scalar-v0",
            "scbf",
            "random",
            {"noise": 0.9, "dt": 0.05, "horizon": 1.5},
            "first_violation length interventions",
        ),
        (
            "StochasticDubins-v0",
            "scbf",
            "nominal",
            {"noise": 1.0, "horizon": 2.5},
            "first_violation interventions infeasible slack",
        ),
        # Violations from the start on, and ends at the goal.
        ("Scalar-v0", "none", "random", {"start": [1.5], "horizon": 0.5, "noise": 0.5}, "returns"),
        ("DubinsObstacle-v0", "hocbf", "random", {"start": [2.0, 1.3, 0.3, 0.5, 1.0]}, "length"),
        # Episodes that only touch h = 0.
        ("Scalar-v0", "cbf", "zero", {"noise": 0.0, "start": [1.0], "horizon": 0.2}, "touching"),
        # Noise that reaches h through a derivative only: there is nothing between the instants.
        ("ACCGap-v0", "none", "zero", {"noise": 3.0, "horizon": 1.0}, "min_h"),
    ],
)
def test_all_counts_are_those_of_numpy(env_id, text, policy, options, varied, continuous):
    problem = problem_of(f"safe_envs/{env_id}", **options)
    reference, program = programs(problem, text, policy, continuous)
    expected = reference(range(8))
    columns, touching = joined(expected)
    for name in varied.split():
        assert touching == 8 if name == "touching" else len(set(columns[name])) > 1, name
    found = list(program.play(program.program.plain(), range(8), 3, 1, no_reference))
    assert_alike(found, expected)


def test_continuous_monitoring_sees_more_and_changes_nothing_else():
    problem = problem_of("safe_envs/CubicSDEDisk-v0", noise=0.8, dt=0.05, horizon=0.5)
    discrete, continuous = (
        joined(list(program.play(program.program.plain(), range(20), 1, 1, no_reference)))[0]
        for program in (
            programs(problem, "none", continuous=continuous)[1] for continuous in (False, True)
        )
    )
    assert (continuous["min_h"] <= discrete["min_h"]).all()
    assert (continuous["first_violation"] >= 0).sum() > (discrete["first_violation"] >= 0).sum()
    for name in ("returns", "length", "starts"):
        np.testing.assert_array_equal(continuous[name], discrete[name])


def test_neither_threads_nor_parts_of_the_work_change_a_bit(monkeypatch):
    problem = problem_of("safe_envs/Scalar-v0", noise=0.9, horizon=0.3)
    _, program = programs(problem, "scbf", "random")
    functions = program.compiled()

    def columns(episodes, threads):
        return joined(list(program.play(functions, episodes, 5, threads, no_reference)))[0]

    whole = columns(range(1000), 1)
    assert len(set(whole["min_h"])) == 1000
    assert_alike(
        list(program.play(functions, range(20), 5, 1, no_reference)),
        list(program.play(program.program.plain(), range(20), 5, 1, no_reference)),
    )
    part = columns(range(100, 900), 2)
    for name in ("returns", "min_h", "effort", "starts", "length"):
        assert part[name].tobytes() == whole[name][100:900].tobytes(), name
    monkeypatch.setattr(compiled_episodes, "periods_of_a_part", lambda numbers: 7 * problem.steps)
    for threads in (1, 3):
        again = columns(range(1000), threads)
        for name, column in whole.items():
            assert again[name].tobytes() == column.tobytes(), name


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_an_episode_without_finite_values_is_simulated_again_by_numpy():
    problem = problem_of("safe_envs/ACCGap-v0", dt=1e200, horizon=1e202)
    reference, program = programs(problem, "none")
    with pytest.raises(NumericalError, match="have left the finite numbers; reduce dt"):
        list(program.play(program.program.plain(), range(40), 3, 1, reference))


def test_what_numpy_finds_finite_stands():
    problem = problem_of("safe_envs/Scalar-v0", horizon=0.1)
    reference, program = programs(problem, "none")
    plain = program.program.plain()["play_episodes"]

    def halting(first, *arguments):
        """Stops at the episode 5, as if it had no finite values, if that is not the first."""
        stopped = [a[: 5 - first] if getattr(a, "ndim", 0) else a for a in arguments]
        return plain(first, *(stopped if first < 5 < first + len(arguments[4]) else arguments))

    found = list(program.play({"play_episodes": halting}, range(12), 3, 1, reference))
    assert_alike(found, reference(range(12)))


def compiled(monkeypatch):
    """Lets evaluations run programs as plain Python, which need no compilation."""
    monkeypatch.setattr(Program, "compiled", Program.plain)


def test_an_evaluation_says_which_engine_ran(monkeypatch):
    compiled(monkeypatch)
    told = []
    common = {"episodes": 12, "options": {"horizon": 0.1}, "bounds": False}
    theirs = evaluate("Scalar-v0", engine="numpy", **common)
    ours = evaluate("Scalar-v0", engine="compiled", jobs=2, progress=told.append, **common)
    assert [(row.engine, row.jobs) for row in theirs.timing.rows] == [("numpy", 1)] * 2
    assert [(row.engine, row.jobs) for row in ours.timing.rows] == [("compiled", 2)] * 2
    assert ours.config == theirs.config
    for row, other in zip(ours.rows, theirs.rows, strict=True):
        assert row.safe == other.safe
        assert row.return_mean == pytest.approx(other.return_mean, rel=1e-12)
    assert told == sorted(told)
    assert (told[-1], 0.5 in told) == (1.0, True)


@pytest.mark.parametrize(
    ("long", "arguments", "engine"),
    [
        (60, {}, "compiled"),
        (61, {}, "numpy"),
        (60, {"engine": "numpy"}, "numpy"),
        (60, {"record": True}, "numpy"),
        (60, {"policy": lambda observations: 0.0 * observations}, "numpy"),
        (61, {"engine": "compiled"}, "compiled"),
    ],
)
def test_long_runs_take_the_compiled_engine_where_it_can_do_them(
    monkeypatch, long, arguments, engine
):
    compiled(monkeypatch)
    monkeypatch.setattr(engine_module, "LONG", long)
    given = {"filters": ["none"], "episodes": 12, "options": {"horizon": 0.05}, **arguments}
    assert evaluate("Scalar-v0", **given).timing.rows[0].engine == engine


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"engine": "compile"}, "engine = 'compile'; did you mean 'compiled'"),
        (
            {"engine": "compiled", "record": True},
            "trajectories for pictures are kept by the engine 'numpy'",
        ),
        (
            {"engine": "compiled", "policy": lambda o: 0.0 * o},
            "FunctionPolicy has no compiled form",
        ),
    ],
)
def test_what_the_compiled_engine_cannot_do_is_an_error(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        evaluate("Scalar-v0", filters=["none"], episodes=2, **arguments)


def test_what_numba_cannot_compile_is_done_by_numpy(monkeypatch):
    def refuse(*_):
        raise TypeError("no such function")

    monkeypatch.setattr(Program, "compiled", lambda _: {"play_episodes": refuse})
    monkeypatch.setattr(engine_module, "LONG", 1)
    given = {"filters": ["none"], "episodes": 2, "options": {"horizon": 0.05}, "bounds": False}
    assert evaluate("Scalar-v0", **given).timing.rows[0].engine == "numpy"
    with pytest.raises(NotCompilableError, match="cannot compile Scalar: no such function"):
        evaluate("Scalar-v0", engine="compiled", **given)


def test_without_numba_the_compiled_engine_says_what_to_install(monkeypatch):
    monkeypatch.setattr(program_module, "is_available", lambda: False)
    with pytest.raises(ConfigurationError, match=r'pip install --editable "\.\[fast\]"'):
        evaluate("Scalar-v0", filters=["none"], episodes=2, engine="compiled")
    assert evaluate("Scalar-v0", filters=["none"], episodes=2).timing.rows[0].engine == "numpy"


def test_jobs_that_run_side_by_side_take_one_thread_each(monkeypatch):
    compiled(monkeypatch)
    given = {"filters": ["none"], "episodes": 2, "engine": "compiled", "bounds": False}
    with one_thread():
        assert available_threads() == 1
        assert evaluate("Scalar-v0", **given).timing.rows[0].jobs == 1
    assert evaluate("Scalar-v0", **given).timing.rows[0].jobs == available_threads()
