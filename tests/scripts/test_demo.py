"""The demo, with little training."""

from __future__ import annotations

import pytest

from safe_envs.scripts import demo

pytestmark = pytest.mark.slow


@pytest.mark.slow
def test_demo_prints_two_tables_and_leaves_a_policy_and_two_pictures(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(demo, "_STEPS", 2048)
    folder = tmp_path / "new" / "results"
    demo.demo(folder, episodes=10)
    out = capsys.readouterr().out
    assert sorted(p.name for p in folder.iterdir()) == ["nominal.png", "ppo", "ppo.png"]
    assert {"model.zip", "policy.npz"} <= {p.name for p in (folder / "ppo").iterdir()}
    for path in folder.iterdir():
        assert str(path) in out
        assert path.is_dir() or path.stat().st_size > 5000
    assert "\n".join(out.split()).count("safe\n[95\n%") == 2
    assert "policy nominal" in out
    for name in demo.FILTERS:
        # In each of two tables of two parts.
        assert sum(line.startswith(name) for line in out.splitlines()) == 4
