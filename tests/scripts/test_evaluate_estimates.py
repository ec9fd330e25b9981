"""`safe-envs evaluate --estimator`: rows side by side, and what is refused."""

from __future__ import annotations

import pytest

from tests.scripts.conftest import strictly

QUICK = ("--episodes", 12, "--horizon", 0.5, "--measurement", "default", "--estimator", "ekf")
ROWS = ["scbf@state", "scbf", "scbf:belief=0.05"]

pytestmark = pytest.mark.usefixtures("coarse_bounds")


def test_a_filter_is_compared_at_states_estimates_and_beliefs(safe_envs_command, tmp_path):
    given = (*QUICK, "--json", tmp_path / "out.json")
    status, out, _ = safe_envs_command("evaluate Scalar-v0 --filter scbf", *given)
    assert status == 0
    document = strictly(tmp_path / "out.json")
    assert [row["filter"] for row in document["rows"]] == ROWS
    for text in (*ROWS, "NEES", "NIS"):
        assert text in out
    at_state, at_estimate, at_belief = document["rows"]
    assert "estimation" not in at_state
    for row in (at_estimate, at_belief):
        assert row["estimation"]["nees"]["low"] < row["estimation"]["nees"]["high"]
        # Bounds of true states are not claimed for estimates.
        assert row["continuous_bound"] is row["held_bound"] is None
    named = [(pair["first"], pair["second"]) for pair in document["comparisons"]]
    assert ("scbf", "scbf@state") in named


def test_without_a_filter_nothing_intervenes_at_states_and_at_estimates(safe_envs_command):
    given = (*QUICK, "--no-bounds", "--json", "out.json")
    status, out, _ = safe_envs_command("evaluate Scalar-v0 --filter none --filter scbf", *given)
    assert status == 0
    rows = strictly("out.json")["rows"]
    assert [(row["filter"], row["kind"]) for row in rows] == [
        ("none@state", "unfiltered"),
        ("none", "unfiltered"),
        *((name, "filter") for name in ROWS),
    ]
    assert "0.0 %" not in next(
        line for line in out.splitlines() if line.startswith("none@state") and " %" not in line
    )
    compared = [line for line in out.splitlines() if " points [" in line]
    assert len(compared) == 3
    assert "none" not in " ".join(compared)
    assert "bound, continuous: not computed" in out


def test_training_and_the_evaluation_of_its_policy_take_an_estimator(safe_envs_command, tmp_path):
    status, out, _ = safe_envs_command(
        *("train", "Scalar-v0", "--algo", "ppo", "--filter", "scbf", "--out", tmp_path / "run"),
        "--n-timesteps 128 --num-envs 4 --set n_steps=32 --eval-episodes 4 --horizon 0.3",
        "--measurement default --estimator kf",
    )
    assert status == 0
    assert "--estimator=kf" in out.replace("\n", " ")
    status, out, _ = safe_envs_command(
        *("evaluate", "Scalar-v0", "--policy", tmp_path / "run", "--filter", "scbf"),
        *("--horizon", 0.3, "--episodes", 4, "--measurement", "default", "--estimator", "kf"),
    )
    assert status == 0
    assert "scbf@state" in out
