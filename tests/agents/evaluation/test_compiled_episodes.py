"""The compiled engine counts what NumPy counts; programs run as plain Python but for two."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, NumericalError
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation import compiled_episodes
from safe_envs.agents.jobs.job import available_threads, one_thread
from safe_envs.engine import choice as engine_module
from safe_envs.engine import program as program_module
from safe_envs.engine.program import Program
from safe_envs.errors import NotCompilableError
from safe_envs.problem.backup import BackupLaw
from tests.conftest import problem_of
from tests.oracles.carts import DT, STRONGEST, cart_problem, v, x

WIDE = {"start": [(-0.5, 0.9), (0.0, 2.0)]}
TWO = (1 - x, 1 + x)
SLOW = sp.Min(STRONGEST * DT - sp.Abs(v), *TWO, *(b.subs(x, x + v * DT / 2) for b in TWO))
STOPS = (
    BackupLaw("stop", (-v / DT,), terminal=SLOW),
    BackupLaw("wait", (-v / DT + 5 * sp.Max(0, sp.Abs(v) - STRONGEST * DT),), terminal=SLOW),
)
"""Laws that stop within a period where the cart is slow."""

LONG, LOUD = {"noise": 0.9, "dt": 0.05, "horizon": 1.5}, {"noise": 1.0, "horizon": 2.5}
SHORT = {"filters": ["none"], "options": {"horizon": 0.05}, "bounds": False}


def assert_columns_alike(found, expected, relative=1e-9):
    """Flags and counts are equal, and other numbers are but for rounding."""
    for name, column in expected.items():
        assert found[name].dtype == column.dtype, name
        if column.dtype.kind == "f":
            np.testing.assert_allclose(
                found[name], column, rtol=relative, atol=1e-12, err_msg=name, equal_nan=True
            )
        else:
            assert (found[name] == column).all(), name


def both(problem, name, policy, relative=1e-9, **given):
    """Return the columns, states and row of NumPy's evaluation, which are those of the other."""
    given = {"episodes": 8, "seed": 3, "num_envs": 8, "bounds": False, "jobs": 1, **given}
    theirs, ours = (
        evaluate(problem, policy, name, engine=engine, **given) for engine in ("numpy", "compiled")
    )
    assert ours.timing.rows[0].engine == "compiled"
    columns = []
    for each in (ours, theirs):
        (visited,) = each.visited[each.rows[0].filter]
        columns.append(each.episode_columns() | vars(visited))
    assert_columns_alike(*columns, relative)
    assert ours.config == theirs.config
    for key in ("safe", "touching", "below_rounding", "intervention_rate", "infeasible_rate"):
        assert getattr(ours.rows[0], key) == getattr(theirs.rows[0], key), key
    assert ours.rows[0].curve.safe == theirs.rows[0].curve.safe
    return columns[1], theirs.rows[0]


@pytest.mark.parametrize(
    ("filtered", "monitoring"), [(False, "continuous"), (True, "discrete")], ids=str
)
@pytest.mark.usefixtures("plain")
def test_episodes_are_those_of_numpy(env_id, filtered, monitoring):
    problem = problem_of(env_id, noise=0.2)
    problem = problem.configured(horizon=4 * problem.dt)
    name = problem.filter if filtered else "none"
    both(problem, name, "random", episodes=3, monitoring=monitoring)


@pytest.mark.parametrize("monitoring", ["discrete", "continuous"])
@pytest.mark.parametrize(
    ("env_id", "text", "policy", "options", "varied"),
    [
        # Violations after which an episode goes on, and ends out of the workspace.
        ("Scalar-v0", "scbf", "random", LONG, "first_violation length interventions"),
        ("StochasticDubins-v0", "scbf", "nominal", LOUD, "interventions infeasible slack"),
        # Violations from the start on, and ends at the goal.
        ("Scalar-v0", "none", "random", {"start": [1.5], "horizon": 0.5, "noise": 0.5}, "return"),
        ("DubinsObstacle-v0", "hocbf", "random", {"start": [2.0, 1.3, 0.3, 0.5, 1.0]}, "length"),
        # Episodes that only touch h = 0.
        ("Scalar-v0", "cbf", "zero", {"noise": 0.0, "start": [1.0], "horizon": 0.2}, ""),
        # Noise that reaches h through a derivative only: there is nothing between the instants.
        ("ACCGap-v0", "none", "zero", {"noise": 3.0, "horizon": 1.0}, "min_h"),
    ],
)
@pytest.mark.usefixtures("plain")
def test_all_counts_are_those_of_numpy(env_id, text, policy, options, varied, monitoring):
    problem = problem_of(f"safe_envs/{env_id}", **options)
    columns, row = both(problem, text, policy, monitoring=monitoring)
    assert (row.touching == 8) == (varied == "")
    for name in varied.split():
        assert len(set(columns[name])) > 1, name


@pytest.mark.parametrize("options", [{}, {"noise": 0.2}, {"laws": STOPS, "barriers": TWO}])
@pytest.mark.usefixtures("plain")
def test_backup_filters_decide_alike(options):
    problem = cart_problem(**{**WIDE, "horizon": 1.5, **options})
    columns, _ = both(problem, "backup", "random", episodes=24)
    for name in ("interventions", "infeasible", "slack", "first_violation"):
        assert len(set(columns[name].tolist())) > 1, name


def test_compiled_programs_count_alike_in_any_threads_and_parts(monkeypatch):
    problem = problem_of("safe_envs/Scalar-v0", noise=0.9, horizon=0.3)
    given = {"filters": "scbf", "bounds": False, "seed": 5, "engine": "compiled"}
    both(problem, "scbf", "random", episodes=300)
    whole = evaluate(problem, "random", episodes=1000, jobs=1, **given).episode_columns()
    assert len(set(whole["min_h"])) == 1000
    monkeypatch.setattr(compiled_episodes, "periods_of_a_part", lambda numbers: 7 * problem.steps)
    for jobs in (1, 2):
        again = evaluate(problem, "random", episodes=1000, jobs=jobs, **given).episode_columns()
        for name, column in whole.items():
            assert again[name].tobytes() == column.tobytes(), name


@pytest.mark.oracle
@pytest.mark.parametrize("filtered", [False, True], ids=["unfiltered", "filtered"])
def test_engines_differ_at_thresholds_alone(env_id, filtered):
    """Flags of whole episodes differ where rounding decides, which is next to never."""
    problem = problem_of(env_id, noise=0.2)
    solved = filtered and len(problem.barriers) > 1 and len(problem.inputs) > 2
    given = {"episodes": 20 if solved else 2000, "seed": 7, "bounds": False}
    ours, theirs = (
        evaluate(problem, "random", problem.filter if filtered else "none", engine=e, **given)
        for e in ("compiled", "numpy")
    )
    assert ours.timing.rows[0].engine == "compiled"
    one, other = ours.episode_columns(), theirs.episode_columns()
    same = np.ones(given["episodes"], dtype=bool)
    for name in ("safe", "length", "interventions", "infeasible"):
        same &= one[name] == other[name]
    assert (~same).mean() < 1e-3
    for name in ("min_h", "return", "effort"):
        np.testing.assert_allclose(one[name][same], other[name][same], rtol=1e-4, atol=1e-6)


@pytest.mark.usefixtures("plain")
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_an_episode_without_finite_values_has_the_error_of_numpy():
    given = {"options": {"dt": 1e200, "horizon": 1e202}, "episodes": 40, "filters": "none"}
    with pytest.raises(NumericalError, match="finite"):
        evaluate("ACCGap-v0", engine="compiled", **given)


def test_what_numpy_finds_finite_stands(monkeypatch):
    def halting(program):
        """Stops at the episode 5, as if it had no finite values, if that is not the first."""
        entry = program.plain()["play_episodes"]

        def play(first, *arguments):
            count = len(arguments[4])
            keep = 5 - first if first < 5 < first + count else count
            return entry(first, *arguments[:4], *(a[:keep] for a in arguments[4:8]), *arguments[8:])

        return {"play_episodes": play}

    monkeypatch.setattr(Program, "compiled", halting)
    given = {"episodes": 24, "jobs": 1, **SHORT}
    ours, theirs = (
        evaluate("Scalar-v0", "random", engine=e, **given) for e in ("compiled", "numpy")
    )
    assert ours.timing.rows[0].engine == "compiled, numpy"
    assert_columns_alike(ours.episode_columns(), theirs.episode_columns())


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
@pytest.mark.usefixtures("plain")
def test_long_runs_take_the_compiled_engine_where_it_can_do_them(
    monkeypatch, long, arguments, engine
):
    monkeypatch.setattr(engine_module, "LONG", long)
    told = []
    found = evaluate("Scalar-v0", episodes=12, progress=told.append, **SHORT, **arguments)
    assert found.timing.rows[0].engine == engine
    assert told == sorted(told)
    assert told[-1] == 1.0


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        ({"engine": "compile"}, "compile"),
        ({"engine": "compiled", "record": True}, "trajectories"),
        ({"engine": "compiled", "policy": lambda o: 0.0 * o}, "FunctionPolicy"),
        ({"engine": "compiled", "filters": ["promise:p=0.9"]}, "promise"),
    ],
)
def test_what_the_compiled_engine_cannot_do_is_an_error(arguments, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        evaluate("Scalar-v0", **{**SHORT, "episodes": 2, **arguments})


def test_what_numba_cannot_compile_is_done_by_numpy(monkeypatch):
    def refuse(*_):
        raise TypeError("no such function")

    monkeypatch.setattr(Program, "compiled", lambda _: {"play_episodes": refuse})
    monkeypatch.setattr(engine_module, "LONG", 1)
    assert evaluate("Scalar-v0", episodes=2, **SHORT).timing.rows[0].engine == "numpy"
    with pytest.raises(NotCompilableError, match="no such function"):
        evaluate("Scalar-v0", episodes=2, engine="compiled", **SHORT)
    monkeypatch.undo()
    monkeypatch.setattr(program_module, "is_available", lambda: False)
    with pytest.raises(ConfigurationError, match="pip install numba"):
        evaluate("Scalar-v0", episodes=2, engine="compiled", **SHORT)
    assert evaluate("Scalar-v0", episodes=2, **SHORT).timing.rows[0].engine == "numpy"


@pytest.mark.usefixtures("plain")
def test_jobs_that_run_side_by_side_take_one_thread_each():
    given = {"episodes": 2, "engine": "compiled", **SHORT}
    with one_thread():
        assert available_threads() == 1
        assert evaluate("Scalar-v0", **given).timing.rows[0].jobs == 1
    assert evaluate("Scalar-v0", **given).timing.rows[0].jobs == available_threads()
