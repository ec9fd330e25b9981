"""The examples are short, their filters keep them safer, and every command takes them."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from safe_envs import DecisionLog
from safe_envs.agents import evaluate
from safe_envs.scripts.cli import app
from safe_envs.systems import CUSTOM_ID

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[1] / "examples"
SYSTEMS = ("cart_pole.py", "double_integrator.py", "bicycle.py")


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_filter_keeps_an_example_safe(name):
    path = EXAMPLES / name
    found = evaluate(
        CUSTOM_ID,
        filters=["none", "hocbf"],
        options={"system": f"{path}:problem"},
        episodes=60,
        bounds=False,
    )
    bare, filtered = found.rows
    assert bare.ci_high < filtered.ci_low
    assert found.title == f"{path}:problem"


def test_the_robot_in_a_control_loop_keeps_clear_and_logs_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    found = runpy.run_path(str(EXAMPLES / "control_loop.py"), run_name="__main__")
    log = DecisionLog.read("control_loop.csv")
    decisions, latency = capsys.readouterr().out.splitlines()
    assert decisions == str(log) == str(found["log"])
    assert latency.startswith("a decision took")
    assert (tmp_path / "control_loop.png").stat().st_size > 10_000
    assert log.h_min > 0.0
    assert log.infeasible == 0
    # Everybody and the gate had a part in it, under limits and a mass that changed.
    assert {0.0, 1.0, 2.0} <= set(log.section("cause")[log.intervention, 0])
    assert set(log.section("high").ravel()) == {12.0, 20.0}
    assert "parameter:mass" in log.columns.headings
    force = log.section("action")
    assert (abs(force) <= log.section("high") + 1e-12).all()
    # The body itself is clear of the first person, and what was proposed would not have been.
    state, measured = log.section("state"), log.section("parameter")
    assert np.hypot(*(state[:, :2] - measured[:, :2]).T).min() > 0.55
    free, _ = found["run"]("1e6,1e6", 3.5)
    assert free.h_min < -0.1


@pytest.mark.parametrize(
    "line",
    [
        "verify --no-simulate --barrier radius=1.2",
        "identify --method bayesian --out learned.npz --noise 0.1",
    ],
)
def test_commands_take_a_system_of_ones_own(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    system = f"{EXAMPLES / 'double_integrator.py'}:problem"
    result = CliRunner().invoke(app, [*line.split(), "--system", system])
    assert result.exit_code == 0, result.output
    assert system in result.output


@pytest.mark.oracle
def test_beliefs_keep_what_a_radar_sees_safer():
    found = runpy.run_path(str(EXAMPLES / "range_bearing.py"))
    for evaluation in (found["vehicle"](120), found["car"](120)):
        at_state, equivalent, belief = evaluation.rows
        assert at_state.filter.endswith("@state")
        assert belief.safety_rate >= equivalent.safety_rate
        nees = belief.estimation.nees
        assert abs(nees.mean - nees.expected) < 0.25 * nees.expected
