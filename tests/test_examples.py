"""The examples are short, their filters keep them safer, and every command takes them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

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
    assert len(path.read_text().splitlines()) < 60
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("evaluate", ["--episodes", "5", "--noise", "0.1"]),
        ("verify", ["--no-simulate", "--barrier", "radius=1.2"]),
        ("identify", ["--method", "bayesian", "--out", "learned.npz", "--noise", "0.1"]),
        (
            "train",
            [
                "--algo",
                "ppo",
                "--out",
                "agent",
                "--n-timesteps",
                "64",
                "--num-envs",
                "2",
                "--eval-episodes",
                "2",
            ],
        ),
    ],
)
def test_commands_take_a_system_of_ones_own(command, options, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    system = f"{EXAMPLES / 'double_integrator.py'}:problem"
    result = CliRunner().invoke(app, [command, "--system", system, *options])
    assert result.exit_code == 0, result.output
    if command == "train":
        assert (
            json.loads((tmp_path / "agent" / "config.json").read_text())["training"]["options"][
                "system"
            ]
            == system
        )
    else:
        assert system in result.output
