"""`evaluate --closed-loop`: certified bounds in the tables of `evaluate` and `verify`."""

from __future__ import annotations

import json

import pytest

from safe_envs.values import closed_loop

SCALAR = ("Scalar-v0", "--horizon", 0.1, "--noise", 1, "--start", 0.5)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SAFE_ENVS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(closed_loop, "CELLS", {1: 400, 2: 400})


def test_the_bounds_are_shown_by_evaluate_and_verify(safe_envs_command, tmp_path):
    asked = ("--filter", "none", "--filter", "scbf", "--filter", "srcbf", "--episodes", 50)
    status, out, _ = safe_envs_command("evaluate", *SCALAR, *asked, "--closed-loop --json e.json")
    assert status == 0
    rows = json.loads((tmp_path / "e.json").read_text())["rows"]
    assert [row["held_word"] for row in rows] == ["certified", "certified", "none"]
    for row in rows[:2]:
        assert 0.3 < row["held_bound"] < 1.0
    text = " ".join(out.split())
    assert text.count("certified, by a table of this policy, 401 cells") == 2
    assert "no bound, held input, for srcbf: the constraint of srcbf is not of the form" in text
    status, out, _ = safe_envs_command(
        "verify", *SCALAR, "--filter scbf --episodes 50 --json v.json --closed-loop"
    )
    assert status == 0
    chain = json.loads((tmp_path / "v.json").read_text())["chain"]
    assert chain["held_word"] == "certified"
    assert chain["held_bound"] == pytest.approx(rows[1]["held_bound"])
    assert "Held input: certified, by a table of this policy, 401 cells" in " ".join(out.split())


def test_a_policy_that_is_no_formula_has_a_note(safe_envs_command):
    asked = ("--policy", "random", "--filter", "none", "--episodes", 5, "--closed-loop")
    status, out, _ = safe_envs_command("evaluate", *SCALAR, *asked)
    assert status == 0
    assert "for none: the policy 'random' is no formula of the state" in " ".join(out.split())
