"""`safe-envs best`, and the best attainable safety in other commands, as a person types them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from safe_envs.agents.evaluation import attainable
from safe_envs.values import solve
from safe_envs.values.tables import load_table, save_table
from tests.agents.policies.coarse import COARSE
from tests.scripts.conftest import strictly
from tests.scripts.figures.svg_texts import svg_texts

SCALAR = ("Scalar-v0", "--horizon", 0.3, "--noise", 1.5, "--start", 0.8)
COARSELY = ("--cells", 400, "--inputs", 9, "--episodes", 200)


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path):
    """An empty folder for tables, so that a test sees its own only."""
    folder = tmp_path / "cache"
    folder.mkdir()
    monkeypatch.setattr(solve, "cache_folder", lambda name: folder)
    monkeypatch.setattr(attainable, "evaluation_settings", lambda problem: COARSE)


def test_it_prints_and_writes_both_ends_and_the_rate_between(safe_envs_command, tmp_path):
    status, out, _ = safe_envs_command("best", *SCALAR, *COARSELY, "--json best.json")
    assert status == 0
    for text in ("lower", "simulated", "upper", "P(leave)", "no policy is safer", "not proved"):
        assert text in out
    assert "Grid: " in out
    found = strictly("best.json")
    assert 0.4 < found["lower"] < found["upper"] < 1.0
    low, high = found["simulated_interval"]
    assert low < found["simulated"] < high
    assert low <= found["upper"]
    assert found["lower"] <= high
    assert (found["contradiction"], found["leaving"], found["leave_rate"]) == (None, "violation", 0)
    assert found["coordinates"] == ["x"]
    assert found["seconds"] > 0
    assert found["memory"] > 0


def test_check_certifies_both_ends_or_refuses_the_table(safe_envs_command, tmp_path):
    asked = (*SCALAR, *COARSELY, "--table", "mine.npz")
    safe_envs_command("best", *asked, "--json 1.json")
    status, out, _ = safe_envs_command("best", *asked, "--check --json 2.json")
    assert status == 0
    assert "lower and upper are certified" in out
    assert "not proved" not in out
    computed, certified = strictly("1.json"), strictly("2.json")
    assert computed["check"] is None
    assert 0 <= certified["check"]["lower"] < 1e-9
    assert abs(certified["lower"] - computed["lower"]) < 1e-6
    assert abs(certified["upper"] - computed["upper"]) < 1e-6
    table = load_table("mine.npz")
    lower = np.array(table.lower)
    cell = int(np.flatnonzero((lower[3] > 0.3) & (table.upper[3] > lower[3] + 2e-3))[0])
    lower[3, cell] += 1e-3
    Path("mine.npz").unlink()
    save_table(replace(table, lower=lower), "mine.npz")
    status, _, err = safe_envs_command("best", *asked, "--check")
    assert status == 2
    assert f"k = 3 on cell {cell}," in err
    specified = (*SCALAR, *COARSELY, "--spec 'always safe' --check")
    status, _, err = safe_envs_command("best", *specified)
    assert (status, "only tables of staying safe" in err) == (2, True)


def test_a_table_is_written_and_read_again(safe_envs_command, tmp_path):
    first = safe_envs_command("best", *SCALAR, *COARSELY, "--table mine.npz --json 1.json")
    assert first[0] == 0
    for path in (tmp_path / "cache").glob("*.npz"):
        path.unlink()
    again = safe_envs_command("best", *SCALAR, *COARSELY, "--table mine.npz --json 2.json")
    assert again[0] == 0
    assert strictly("1.json") == strictly("2.json")
    # Of another problem it is refused.
    other = ("Scalar-v0", "--horizon", 0.2, *COARSELY, "--table", "mine.npz")
    status, _, err = safe_envs_command("best", *other)
    assert status == 2
    assert "mine.npz" in err


@pytest.mark.parametrize(
    "arguments",
    [(*SCALAR, "--cells", "400"), ("DubinsObstacle-v0", "--horizon", 0.05, "--cells", "5x5x5")],
)
def test_the_value_is_drawn_over_any_number_of_coordinates(safe_envs_command, tmp_path, arguments):
    how = ("--inputs", 3, "--episodes", 0, "--plot", "value.svg")
    assert safe_envs_command("best", *arguments, *how)[0] == 0
    drawn = svg_texts(tmp_path / "value.svg")
    assert "best attainable safety" in drawn.lower()
    assert "99 % can be had" in drawn


def test_evaluate_shows_it_where_it_is_asked_for(safe_envs_command):
    asked = ("--filter", "none", "--filter", "cbf", "--episodes", 60)
    status, before, _ = safe_envs_command("evaluate", *SCALAR, *asked)
    assert status == 0
    assert "best attainable safety" not in before
    status, out, _ = safe_envs_command("evaluate", *SCALAR, *asked, "--best --json e.json")
    assert status == 0
    assert "best attainable safety: " in out
    assert "avoidable" in out
    assert "times unavoidable: " in out
    best = strictly("e.json")["best"]
    assert 0.4 < best["lower"] < best["upper"] < 1.0
    assert set(best["times_unavoidable"]) == {"none", "cbf"}
    # What is kept now changes nothing of what others print.
    assert safe_envs_command("evaluate", *SCALAR, *asked) == (0, before, "")
    again = safe_envs_command("evaluate", *SCALAR, *asked, "--best")
    assert again == (0, out, "")
    status, _, err = safe_envs_command("evaluate", *SCALAR, "--rare --policy best")
    assert status == 2
    assert "--rare does not go with --policy best" in err


def test_a_sweep_has_it_in_its_cells(safe_envs_command, tmp_path):
    fixed = {"env": "Scalar-v0", "horizon": 0.3, "noise": 1.5, "start": [0.8], "best": True}
    document = {"fixed": {**fixed, "episodes": 40}, "grid": {"filter": ["none", "cbf"]}}
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(document))
    status, _, err = safe_envs_command("sweep sweep.yaml --out cells --jobs 1")
    assert (status, err) == (0, "")
    status, out, _ = safe_envs_command("sweep-report cells --json r.json")
    assert status == 0
    assert "avoidable" in out
    for cell in strictly("r.json")["worst"]:
        assert 0.4 < cell["best_lower"] < cell["best_upper"] < 1.0
    (tmp_path / "sweep.yaml").write_text(
        yaml.safe_dump({"fixed": {**fixed, "env": "Quadrotor-v0"}})
    )
    status, _, err = safe_envs_command("sweep sweep.yaml --out others")
    assert status == 2
