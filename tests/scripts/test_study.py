"""`safe-envs study` as a person types it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

STUDY = """
episodes: 20
variants:
  - name: unfiltered
    algorithm: ppo
    training: &short
      n_timesteps: 256
      num_envs: 4
      eval_freq: 256
      eval_episodes: 4
      settings: {n_steps: 16, batch_size: 64}
    filters: [default, none]
  - name: behind it
    algorithm: ppo
    training: {<<: *short, filter: default, intervention_penalty: 0.5}
    filters: [default, none]
"""


@pytest.fixture
def arguments(tmp_path):
    Path("mine.yml").write_text(STUDY)
    return ("study", "mine.yml", "Scalar-v0", "--out", "found", "--seeds", 2, "--jobs", 1)


@pytest.mark.slow
def test_agents_are_trained_once_and_compared(safe_envs_command, arguments):
    status, out, _ = safe_envs_command(*arguments, "--json s.json")
    assert status == 0
    for word in ("unfiltered", "behind it", "scbf", "no filter", "2 seeds", "20 episodes"):
        assert word in out
    document = json.loads(Path("s.json").read_text())
    assert len(document["rows"]) == 8
    assert [(each["name"], each["filter"]) for each in document["summaries"]] == [
        ("unfiltered", "scbf"),
        ("behind it", "scbf"),
    ]
    assert document["settings"]["seeds"] == 2
    agents = {each["policy"] for each in document["rows"]}
    assert len(agents) == 4  # two agents of two seeds: each is trained once
    changed = {path: path.stat().st_mtime_ns for path in Path("found").rglob("*.*")}
    status, out, _ = safe_envs_command(*arguments, "--markdown --against unfiltered")
    assert status == 0
    assert "differences from unfiltered" in out
    lines = [line for line in out.splitlines() if line.startswith("| behind it")]
    assert [line.count("|") for line in lines] == [6, 6]
    assert all("+" in line or "-" in line for line in lines)
    assert {path: path.stat().st_mtime_ns for path in Path("found").rglob("*.*")} == changed
