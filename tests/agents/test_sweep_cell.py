from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from agents import sweep_cell
from agents.sweep import sweep_of
from agents.sweep_cell import compute, versions


def test_versions_change_with_each_byte_and_name_of_the_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sweep_cell, "files", lambda package: tmp_path / package)
    (tmp_path / "agents" / "inner").mkdir(parents=True)
    file = tmp_path / "agents" / "inner" / "code.py"

    def source() -> str:
        return versions.__wrapped__()["source"]

    file.write_text("a = 1")
    first = source()
    assert source() == first
    file.write_text("a = 2")
    second = source()
    file.rename(file.with_name("other.py"))
    assert len({first, second, source()}) == 3


def test_a_cell_has_one_thread(monkeypatch: pytest.MonkeyPatch):
    seen: list[int] = []

    def evaluate(*_: Any, **__: Any) -> Any:
        seen.extend(pool["num_threads"] for pool in threadpool_info())
        raise RuntimeError("seen")

    monkeypatch.setattr(sweep_cell, "evaluate", evaluate)
    (cell,) = sweep_of({"fixed": {"env": "Scalar-v0", "filter": "none"}}).cells
    with threadpool_limits(2):
        assert "seen" in str(compute(cell).error)
    assert seen
    assert set(seen) == {1}
