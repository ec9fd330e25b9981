"""`safe-envs leaderboard` as a person types it."""

from __future__ import annotations

from pathlib import Path

import pytest

from safe_envs.scripts.reports.leaderboard import BEGIN, END
from tests.scripts.conftest import strictly

pytestmark = pytest.mark.slow

TINY = {"n_timesteps": 256, "num_envs": 4, "eval_freq": 256, "eval_episodes": 4}


def test_agents_are_compared_over_seeds_and_nothing_is_done_twice(safe_envs_command, monkeypatch):
    monkeypatch.setattr("safe_envs.agents.training.leaderboard._QUICK", TINY)
    monkeypatch.setattr("safe_envs.agents.training.leaderboard._PROMISE", "cbf")
    arguments = (
        "leaderboard Scalar-v0 safe_envs/Scalar-v0 --quick --episodes 8 --jobs 1 --out board"
    )
    status, out, err = safe_envs_command(arguments, "--json board.json")
    assert (status, err) == (0, "")
    document = strictly("board.json")
    assert document["settings"]["seeds"] == 2
    rows = document["rows"]
    assert [(row["variant"], row["k"]) for row in rows[:4]] == [
        ("nominal", 0), ("nominal", 1), ("ppo", 0), ("ppo", 1),
    ]  # fmt: skip
    assert len({row["evaluation_seed"] for row in rows}) == 2
    assert "Scalar, filter scbf" in out
    assert max(map(len, out.split("Note: ")[0].splitlines())) <= 100
    assert all(Path("board", row["policy"]).is_dir() for row in rows if row["training_seed"])

    monkeypatch.setattr("safe_envs.agents.training.trainer.train", None)  # An error, if called.
    Path("page.md").write_text(f"# Title\n\n{BEGIN}\n{END}\n")
    more = ("--markdown", "--quiet", "--pictures", "pictures", "--page", "page.md")
    status, out, _ = safe_envs_command(arguments, *more, "--json again.json")
    assert status == 0
    assert strictly("again.json")["rows"] == rows
    assert Path("pictures/Scalar.png").stat().st_size > 10_000
    assert "![Return against violations on Scalar](pictures/Scalar.png)" in out
    assert out.strip() in Path("page.md").read_text()
