"""`safe-envs verify` as a person types it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from safe_envs.agents.evaluation import safety_chain
from safe_envs.proofs import guarantees
from safe_envs.proofs.judge import Supremum
from tests.agents.evaluation.made_up import attainable
from tests.proofs.verified import verify_once
from tests.scripts.conftest import strictly
from tests.scripts.own_system import SYSTEM

pytestmark = pytest.mark.slow

CUBIC_DISK = "safe_envs/CubicSDEDisk-v0"


@pytest.fixture
def verify(monkeypatch, safe_envs_command):
    """Runs `safe-envs verify` over the shorter horizons, from fewer starts."""
    monkeypatch.setattr(safety_chain, "_LONG_MULTIPLES", ())
    monkeypatch.setattr(safety_chain, "STARTS", 512)
    monkeypatch.setattr("safe_envs.proofs.feasibility.verify", verify_once)
    return lambda *arguments: safe_envs_command("verify", *arguments)


def test_the_report_names_what_was_found(verify):
    status, out, err = verify(CUBIC_DISK, "--episodes 100 --dt 0.05")
    assert (status, err) == (0, "")
    for text in (
        "relative degree 1 with scbf",
        "it vanishes at",
        "the best action violates it by 0.08",
        "c = sup h over C <= 1.00001, proved",
        "C: about 1.6 %, violated by at most 0.0800",
        ", proved; by 0.08 at (x_1 = 0, x_2 = 0), the worst state found",
        "repaired for the shortfall m = 0.08",
        "Hypotheses, judged G is where all b_j are positive, in the workspace",
        "Proved: a theorem, whose hypotheses and numbers c and m the judge proved",
        "The env's own steps from the start 'uniform', up to 1 s",
        "Held input: no bound, no table",
        "policy nominal",
        "The measurement contradicts no bound.",
        "Shares are of sampled states",
    ):
        assert text in out


def lines_of(out, start, end):
    """Return the lines of a section, without its heading."""
    _, _, rest = out.partition(start)
    return rest.partition(end)[0].splitlines()[1:]


def test_each_hypothesis_has_the_word_of_the_judge(verify):
    status, out, _ = verify("Pendulum-v0 --start .1,.1 --no-simulate")
    assert status == 0
    lines = lines_of(out, "Hypotheses, judged", "Undecided: neither")
    (bounded,) = [line for line in lines if line.startswith("G is bounded")]
    assert bounded.split()[-2:] == ["proved", "0"]
    (feasible,) = [line for line in lines if line.startswith("the condition can be met")]
    assert " undecided " in feasible
    (amount,) = [line for line in lines if line.startswith("the best input violates it")]
    assert " proved " in amount
    # What is estimated stands after no sign, and what is proved does.
    estimated, proved = (
        line for line in lines_of(out, "Bounds on the", "Proved: ") if " %  " in line
    )
    assert (" estimated " in estimated, ">=" in estimated) == (True, False)
    assert " >= 72.6 %  proved" in proved


def test_a_rate_above_what_is_attainable_withholds_it(verify, monkeypatch):
    best = "safe_envs.agents.evaluation.attainable.best_for"
    monkeypatch.setattr(best, lambda problem, progress: attainable(0.2, 0.3))
    arguments = ("Scalar-v0", "--start", "-1", "--horizon", 0.2, "--episodes", 40, "--json", "o.js")
    assert verify(*arguments)[0] == 0
    assert strictly("o.js")["chain"]["best"] is None
    assert verify(*arguments, "--best")[0] == 0
    found = strictly("o.js")["chain"]["best"]
    assert (found["upper"], found["lower"]) == (None, None)
    assert "scbf is safe in 100.0 %" in found["contradiction"]
    monkeypatch.setattr(best, lambda problem, progress: attainable(0.9, 0.99981))
    status, out, _ = verify(*arguments, "--best")
    assert status == 0
    _, titles, _, cells, *_ = lines_of(out, "The env's own steps", "Shares")
    assert titles.split() == [
        "held",
        "input",
        "safe",
        "[95",
        "%",
        "interval]",
        "able",
        "continuous",
    ]
    assert " 99.99 % " in cells


@pytest.mark.parametrize(
    ("line", "texts"),
    [
        ("ACC-v0", "sup h over C <= 1000.01, proved|inside|proved, but empty"),
        ("StochasticDubins-v0", "c_0 <= 9.0|proved; c_1 <= 11.9|repaired for the shortfall"),
        ("StochasticDubins-v0 --filter hocbf", "hocbf ignores the noise"),
        pytest.param(
            "DubinsDisk-v0",
            "theta over a period of 2 pi|the model differs from|has no effect",
            marks=pytest.mark.oracle,
        ),
        pytest.param(
            "DubinsDisk-v0 --start thesis --knowledge plant",
            "the start is outside C_1: b_1 = -1.26",
            marks=pytest.mark.oracle,
        ),
        pytest.param(
            "DubinsDisk-v0 --filter hocbf:alpha=1,1 --knowledge plant",
            "the best action violates it by 0.28",
            marks=pytest.mark.oracle,
        ),
    ],
)
def test_reports_without_a_simulation(verify, line, texts):
    status, out, err = verify(line, "--no-simulate")
    assert (status, err) == (0, "")
    assert "Measured" not in out
    for text in texts.split("|"):
        assert text in out


def test_of_a_set_that_is_cut_only_the_part_inside_is_told(verify):
    Path("own.py").write_text(SYSTEM)
    status, out, _ = verify("--system own.py:falling --filter scbf --no-simulate")
    assert status == 0
    assert out.count("chosen around the starts") == 1
    (ranges,) = [line for line in out.splitlines() if "chosen around the starts" in line]
    assert "x in [" in ranges
    assert ", v in [" in ranges
    assert "their workspace is unbounded" in ranges
    assert "% of the part of C that is searched" in out
    assert "  the part of C that is searched: " in out
    assert "where the episodes are" not in out
    assert "of the starts are in C and outside this intersection: no bound holds from there" in out


@pytest.mark.parametrize(
    ("env_id", "there", "missing"),
    [
        ("StochasticDubins-v0", ("no action meets the condition", "worst state"), ()),
        ("Scalar-v0", ("least to spare",), ("no action meets the condition",)),
    ],
)
def test_the_picture_says_whether_a_state_is_infeasible(verify, env_id, there, missing):
    assert verify(env_id, "--no-simulate --plot found.svg")[0] == 0
    picture = Path("found.svg").read_text()
    assert all(text in picture for text in there)
    assert not any(text in picture for text in missing)


SPIKE = """
from dataclasses import replace

import sympy as sp

from safe_envs.problem.problem import Barrier
from safe_envs.registry import make_problem


def problem():
    p = make_problem("safe_envs/CubicSDEDisk-v0")
    x, y = p.plant.states
    away = (x - sp.Rational(31, 100)) ** 2 + (y - sp.Rational(47, 100)) ** 2
    h = 1 - x**2 - y**2 + 50 * sp.exp(-away * 10**8)
    return replace(p, barriers=(Barrier(h, "h"),), name="spike")
"""


def test_what_a_search_misses_is_not_printed_as_a_fact(verify, safe_envs_command):
    Path("own.py").write_text(SPIKE)
    asked = ("--system", "own.py:problem", "--filter", "scbf")
    status, out, _ = verify(*asked, "--no-simulate --json o.js")
    assert status == 0
    assert "c = sup h over C <= 50.6831, proved" in out
    assert "violated by at most 4.00001e+08, proved; by 0.08 at" in out
    document = strictly("o.js")
    assert document["barriers"][0]["supremum"] > 50.68 > document["barriers"][0]["supremum_found"]
    assert document["safe_set"]["shortfall"] > 4e8 > document["safe_set"]["shortfall_found"]
    arguments = (*asked, "--episodes", 20, "--horizon", 0.1)
    status, evaluated, _ = safe_envs_command("evaluate", *arguments)
    assert status == 0
    assert "no action meets the condition somewhere, by up to 4.001e+08" in evaluated
    for text in (out, evaluated):
        assert "by up to 0.08" not in text
        assert "sup h over C = c = 1" not in text


def test_what_only_a_search_knows_says_so(verify, monkeypatch):
    undecided = Supremum(math.inf, -math.inf, None, 0, "not looked at")
    monkeypatch.setattr(guarantees, "supremum", lambda *_: undecided)
    asked = (CUBIC_DISK, "--horizon", 0.7, "--no-simulate", "--json", "o.js")
    status, out, _ = verify(*asked)
    assert status == 0
    assert "c = sup h over C >= 1, found by search" in out
    assert "violated by at least 0.08, found by search at" in out
    assert "repaired for the shortfall m >=" in out
    document = strictly("o.js")
    assert document["barriers"][0]["suprema"] == [None]
    assert document["safe_set"]["shortfall"] is None
