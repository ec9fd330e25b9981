"""What the table of an evaluation says around its rows."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import sympy as sp
from rich.console import Console

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.statistics import touches
from safe_envs.scripts.reports.evaluation import print_evaluation
from tests.scripts.conftest import strictly
from tests.scripts.own_system import SYSTEM

X = sp.Symbol("x", real=True)


@pytest.fixture
def evaluated(safe_envs_command):
    """Evaluates a system of `SYSTEM`."""
    Path("own.py").write_text(SYSTEM)
    return lambda name, *arguments: safe_envs_command(
        "evaluate --system", f"own.py:{name}", "--episodes 40", *arguments
    )


@pytest.mark.parametrize(
    ("name", "noise"),
    [("problem", "noise sigma = 0.1,"), ("fixed", "fixed noise,"), ("still", "no noise,")],
)
def test_the_heading_has_the_noise_and_the_horizon_of_what_is_simulated(evaluated, name, noise):
    status, out, err = evaluated(name, "--filter none")
    assert (status, err) == (0, "")
    # 33 whole periods.
    assert (
        out.splitlines()[1]
        == f"{noise} model = plant, dt = 0.03 s, horizon 0.99 s; filters know the model"
    )


def test_starts_from_which_nothing_is_promised_are_told(evaluated):
    status, out, _ = evaluated("falling --filter none --filter scbf --json out.json")
    assert status == 0
    bare, scbf = strictly("out.json")["rows"]
    assert bare["outside_rate"] is None
    # b_1 = v, and v is even in [-3, 1].
    assert 0.5 < scbf["outside_rate"] < 0.95
    told = (
        "lie outside the sets C_j = {b_j >= 0}, j >= 1, that scbf keeps: no bound holds from there"
    )
    assert f"Note: {100 * scbf['outside_rate']:.3g} % of the starts {told}\n" in out
    assert "no bound holds" not in evaluated("falling --filter scbf --start 1,1")[1]


def printed(answer):
    console = Console(width=200, file=io.StringIO())
    print_evaluation(console, answer, timing=True)
    return " ".join(console.file.getvalue().split())


def moving(rate, barrier, *, start=0.0, horizon=4.0, nominal=0):
    """dx = (rate + u) dt in [-1, 1], in steps of .5 s at most."""
    u = sp.Symbol("u", real=True)
    system = ControlAffineSDE.from_rate((X,), (u,), [rate + u], diffusion=[0])
    options = {
        "workspace": {X: (-1, 1)},
        "start": (start,),
        "dt": 0.5,
        "horizon": horizon,
        "nominal": nominal,
    }
    return define_problem(system, [barrier], input_bounds=(-1, 1), **options)


def test_violations_that_are_no_more_than_rounding_are_told():
    # h halves in each step, and is 0 once the sum of the halves is 1 to rounding.
    edge = moving(0.0, 1 - X, horizon=40.0, nominal=1)
    (row,) = evaluate(edge, filters="cbf:alpha=1", episodes=3, bounds=False).rows
    assert (row.safe, row.violations, row.touching) == (0, 3, 3)
    assert abs(row.min_h_median) < 1e-15
    told = (
        "all violations of cbf:alpha=1 come no lower than h = 0 to rounding: they touch the edge,"
        " and safe is h > 0"
    )
    assert told in printed(evaluate(edge, filters="cbf:alpha=1", episodes=3, bounds=False))
    # What is below by more than rounding is a violation like any other, however little it is.
    below = evaluate(moving(1e-12, 1e-12 - X, start=0.0), filters="none", episodes=3, bounds=False)
    assert (below.rows[0].violations, below.rows[0].touching) == (3, 0)
    assert "touch the edge" not in printed(below)
    # The terms are those at the lowest state, not at the start: here h is x, and the state itself
    # is as far below 0.
    passed = evaluate(
        moving(-1.000000000000002, X, start=0.5, horizon=0.5),
        filters="none",
        episodes=3,
        bounds=False,
    )
    assert -1e-14 < passed.rows[0].min_h_median < 0.0
    assert (passed.rows[0].violations, passed.rows[0].touching) == (3, 0)


def test_violations_of_a_filter_that_rides_the_edge_are_told():
    options = {"noise": 0.0, "input_bounds": [-20, 20], "horizon": 10.0}

    def told(spec):
        answer = evaluate(
            "DubinsDisk-v0",
            filters=spec,
            policy="zero",
            knowledge="plant",
            options=options,
            episodes=4,
            bounds=False,
        )
        return answer, answer.document()["rows"][0], printed(answer)

    answer, stored, text = told("hocbf:alpha=10,10")
    assert (stored["violations"], stored["touching"], stored["below_rounding"]) == (4, 0, 4)
    worst = -answer.episode_columns()["min_h"].min()
    assert stored["worst_below_rounding"] == worst < 1e-10
    all_of_them = "all violations of hocbf:alpha=10,10 are below rounding"
    assert f"{all_of_them}, worst violation {worst:.2g}: they settle on the edge" in text
    answer, stored, text = told("none")
    assert answer.rows[0].violations == 4
    assert "below_rounding" not in stored
    assert "below rounding" not in text


@pytest.mark.parametrize(
    ("barrier", "x", "lowest", "touching"),
    [
        (1 - X, 1.0, 0.0, True),
        (1 - X, 1.0, -1e-15, True),
        (1 - X, 1.0, -1e-12, False),
        (1 - X, 1.0, 1e-15, False),
        # Of large terms little is known, of small ones much.
        (1e9 - 1e9 * X, 1.0, -1e-6, True),
        (1e-9 - 1e-9 * X, 1.0, -1e-15, False),
        # The fifth power of a difference of rounded numbers.
        ((X - 0.3) ** 5, float(np.nextafter(0.3, 1.0)), -5e-82, True),
        ((X - 0.3) ** 5, float(np.nextafter(0.3, 1.0)), -1e-60, False),
    ],
)
def test_rounding_is_that_of_the_terms(barrier, x, lowest, touching):
    problem = moving(0.0, barrier if barrier.subs(X, 0.5) > 0 else -barrier, start=0.5)
    assert touches(problem, np.array([lowest]), np.array([[x]])).tolist() == [touching]
