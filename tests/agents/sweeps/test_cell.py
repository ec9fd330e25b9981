from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from safe_envs.agents.jobs import store
from safe_envs.agents.jobs.job import available_threads, outcome_of
from safe_envs.agents.sweeps import spec
from safe_envs.agents.sweeps.spec import sweep_of

pytestmark = pytest.mark.slow


def test_a_file_that_changed_or_went_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "model.npz"
    file.write_bytes(b"1")
    monkeypatch.setattr(
        spec,
        "run_evaluation",
        lambda *_, **__: Evaluated([SimpleNamespace(as_dict=lambda: {"safe": 1})], {}),
    )
    (one,) = sweep_of({"fixed": {"env": "Scalar-v0", "filter": "none"}}).cells
    one = replace(one, files={str(file): store.file_checksum(file)})
    assert outcome_of(one).result["row"] == {"safe": 1}
    file.write_bytes(b"2")
    assert f"the worker finds another content in {file}" in str(outcome_of(one).error)
    file.unlink()
    assert f"{file} cannot be read" in str(outcome_of(one).error)


class Evaluated(NamedTuple):
    """As much of an evaluation as a cell takes."""

    rows: list[Any]
    config: dict[str, Any]
    best: None = None


def test_threads_of_a_worker_compute_one_cell_at_a_time(monkeypatch: pytest.MonkeyPatch):
    both = threading.Barrier(2)

    def evaluate(*_: Any, **__: Any) -> Evaluated:
        both.wait(0.3)
        return Evaluated([{}], {})

    monkeypatch.setattr(spec, "run_evaluation", evaluate)
    (one,) = sweep_of({"fixed": {"env": "Scalar-v0", "filter": "none"}}).cells
    with ThreadPoolExecutor(2) as threads:
        errors = [outcome.error for outcome in threads.map(outcome_of, [one, one])]
    # Neither met the other.
    assert all(error is not None and error.startswith("BrokenBarrierError") for error in errors)


def test_a_cell_has_one_thread(monkeypatch: pytest.MonkeyPatch):
    seen: list[int] = []

    def evaluate(*_: Any, **__: Any) -> Any:
        seen.extend(pool["num_threads"] for pool in threadpool_info())
        seen.append(available_threads())
        raise RuntimeError("seen")

    monkeypatch.setattr(spec, "run_evaluation", evaluate)
    (one,) = sweep_of({"fixed": {"env": "Scalar-v0", "filter": "none"}}).cells
    with threadpool_limits(2):
        assert "seen" in str(outcome_of(one).error)
    assert seen
    assert set(seen) == {1}


def test_the_engine_is_no_part_of_what_identifies_a_cell(monkeypatch: pytest.MonkeyPatch):
    asked: list[str] = []

    def evaluate(_: Any, settings: Any) -> Evaluated:
        asked.append(settings.engine)
        return Evaluated([SimpleNamespace(as_dict=dict)], {})

    monkeypatch.setattr(spec, "run_evaluation", evaluate)
    document = {"fixed": {"env": "Scalar-v0", "filter": "none"}}
    found = [sweep_of(document, engine=engine).cells[0] for engine in ("auto", "numpy")]
    assert found[0].key == found[1].key
    for one in found:
        assert outcome_of(one).error is None
    assert asked == ["auto", "numpy"]
