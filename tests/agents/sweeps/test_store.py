"""The results of a sweep: kept cell by cell, whole, and read in the order of the file."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from safe_envs.agents.jobs.executor import Backend, run
from safe_envs.agents.jobs.job import JobOutcome, outcome_of
from safe_envs.agents.jobs.store import ResultStore, source_checksum
from safe_envs.agents.sweeps.spec import Sweep, sweep_of, versions
from safe_envs.agents.sweeps.store import Store, read
from safe_envs.errors import ConfigurationError
from tests.oracles.full_disk import no_file_larger_than

SMALL: dict[str, Any] = {"env": "Scalar-v0", "filter": "scbf", "episodes": 20, "horizon": 0.2}
DOCUMENT = {"fixed": SMALL, "grid": {"noise": [0.1, [0.2], 0.3]}, "cells": [{"start": [0.5]}]}


@pytest.fixture(scope="module")
def sweep() -> Sweep:
    return sweep_of(DOCUMENT)


@pytest.fixture(scope="module")
def outcomes(sweep: Sweep) -> list[JobOutcome]:
    return [outcome_of(cell) for cell in sweep.cells]


def filled(folder: Path, sweep: Sweep, outcomes: list[JobOutcome]) -> Store:
    store = Store(folder, sweep)
    for outcome in outcomes:
        store.keep(outcome)
    return store


def test_what_was_kept_is_read_in_the_order_of_the_file(tmp_path, sweep, outcomes):
    store = Store(tmp_path, sweep)
    assert len(read(tmp_path)) == 0
    assert store.missing == list(sweep.cells)
    filled(tmp_path, sweep, outcomes[:0:-1])
    table = read(tmp_path)
    assert table["key"].to_pylist() == [cell.key for cell in sweep.cells[1:]]
    assert table["noise"].to_pylist() == ["[0.2]", "0.3", None]
    assert table["start"].to_pylist() == [None, None, "[0.5]"]
    assert table["episodes"].to_pylist() == [20] * 3
    names = ("safe", "safety_rate", "ci_low", "min_h_p05", "return_mean")
    names += ("held_bound", "continuous_bound", "continuous_word")
    for row, outcome in zip(table.to_pylist(), outcomes[1:], strict=True):
        assert {n: row[n] for n in names} == {n: outcome.result["row"][n] for n in names}
        assert json.loads(row["row"]) == outcome.result["row"]
        assert json.loads(row["config"])["problem"]["dt"] == 0.01
        assert set(json.loads(row["versions"])) > {"python", "numpy", "safe-envs", "source"}
    assert Store(tmp_path, sweep).missing == [sweep.cells[0]]
    # Settings of cells that are not there have columns.
    Store(tmp_path / "one", sweep).keep(outcomes[0])
    columns = read(tmp_path / "one").select(["noise", "start"])
    assert columns.to_pylist() == [{"noise": 0.1, "start": None}]


def test_a_failed_cell_is_told_and_tried_again(tmp_path, sweep, outcomes):
    store, failed = Store(tmp_path, sweep), JobOutcome(sweep.cells[0].key, None, "it broke", 0.1)
    store.keep(failed)
    assert read(tmp_path)["error"].to_pylist() == ["it broke"]
    # Those that failed come last, so that they keep no other from being computed.
    assert Store(tmp_path, sweep).missing == [*sweep.cells[1:], sweep.cells[0]]
    store.keep(outcomes[0])
    assert read(tmp_path)["error"].to_pylist() == [None]
    # A failure replaces no result of another run.
    Store(tmp_path, sweep).keep(failed)
    assert read(tmp_path)["error"].to_pylist() == [None]


def test_the_results_of_another_sweep_are_read_until_there_is_one_of_this(
    tmp_path, sweep, outcomes
):
    filled(tmp_path, sweep, outcomes)
    # As after an update of the code: nothing of it has been computed yet.
    cells = [replace(cell, versions={**cell.versions, "source": "new"}) for cell in sweep.cells]
    store = Store(tmp_path, Sweep(tuple(cells), sweep.swept))
    assert store.missing == cells
    assert len(read(tmp_path)) == 4
    store.keep(replace(outcomes[0], key=cells[0].key))
    assert read(tmp_path)["key"].to_pylist() == [cells[0].key]
    # Cells of another sweep stay.
    assert Store(tmp_path, Sweep(sweep.cells[:1], ())).missing == []
    assert len(read(tmp_path)) == 1
    assert Store(tmp_path, sweep).missing == []


def test_what_was_being_written_when_a_run_was_killed_is_removed(tmp_path, sweep):
    Store(tmp_path, sweep)
    old, young = tmp_path / "cells" / ".abc.x1.json", tmp_path / "cells" / ".abc.x2.json"
    of_index = tmp_path / ".sweep.x1.json"
    for path in (old, young, of_index):
        path.touch()
    before = time.time() - 7200
    for path in (old, of_index):
        os.utime(path, (before, before))
    Store(tmp_path, sweep)
    assert [path.exists() for path in (old, young, of_index)] == [False, True, False]


def test_a_full_disk_loses_nothing_that_is_finished(tmp_path, sweep, outcomes):
    store = filled(tmp_path, sweep, outcomes[:1])
    with no_file_larger_than(300), pytest.raises(ConfigurationError, match="1 of 4 cells"):
        store.keep(outcomes[1])
    assert [path.stem for path in (tmp_path / "cells").iterdir()] == [sweep.cells[0].key]
    again = Store(tmp_path, sweep)
    assert again.missing == list(sweep.cells[1:])
    again.keep(outcomes[1])
    assert len(read(tmp_path)) == 2


def test_a_broken_file_is_computed_again(tmp_path, sweep, outcomes):
    filled(tmp_path, sweep, outcomes[:1])
    (file,) = (tmp_path / "cells").iterdir()
    results, cell = ResultStore(tmp_path / "cells"), sweep.cells[0]
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(ConfigurationError, match=file.name):
        read(tmp_path)
    assert cell in Store(tmp_path, sweep).missing
    # Whole, but with nothing in it, or with something else.
    content = {**outcomes[0].result, "error": None, "seconds": 0.0}
    for other in ({}, {**content, "row": 3}, {**content, "row": {"safe": "x"}, "config": []}):
        results.keep(cell.key, cell.configuration, other)
        with pytest.raises(ConfigurationError, match="remove it"):
            read(tmp_path)
        if other.get("row") in (None, 3):
            assert cell in Store(tmp_path, sweep).missing


def test_folders_that_cannot_be(tmp_path, sweep, monkeypatch):
    for text in (None, "{}", "[]", '{"cells": 1, "swept": []}'):
        if text is not None:
            (tmp_path / "sweep.json").write_text(text)
        with pytest.raises(ConfigurationError, match=tmp_path.name):
            read(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="file"):
        Store(tmp_path / "file", sweep)
    monkeypatch.setattr("safe_envs.agents.sweeps.store.find_spec", lambda name: None)
    with pytest.raises(ConfigurationError, match=r"\.\[sweep\]"):
        Store(tmp_path, sweep)


# In a process of its own, which ends after so many cells; it says which it has computed.
DRIVER = """
import json, os, signal, sys
from pathlib import Path
from safe_envs.agents.jobs.executor import Backend, run
from safe_envs.agents.sweeps.spec import sweep_of
from safe_envs.agents.sweeps.store import Store

store, left = Store(Path(sys.argv[1]), sweep_of(json.loads(sys.argv[2]))), int(sys.argv[3])

def keep(outcome):
    global left
    store.keep(outcome)
    print(outcome.key, flush=True)
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)

run(store.missing, Backend(jobs=1), keep)
"""


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(tmp_path, sweep, outcomes):
    """Both runs are new processes: this one may have read the code before it was edited."""

    def driven(last: int) -> tuple[int, list[str]]:
        words = [sys.executable, "-c", DRIVER, str(tmp_path / "out"), json.dumps(DOCUMENT)]
        found = subprocess.run([*words, str(last)], stdout=subprocess.PIPE, text=True)
        return found.returncode, found.stdout.split()

    def times() -> dict[str, int]:
        return {path.stem: path.stat().st_mtime_ns for path in (tmp_path / "out/cells").iterdir()}

    (code, first), before = driven(2), times()
    assert (code, len(first)) == (-signal.SIGKILL, 2)
    assert set(before) == set(first)
    code, rest = driven(-1)
    assert (code, len(rest)) == (0, 2)
    assert before.items() <= times().items()
    found = read(tmp_path / "out").to_pylist()
    assert [row["key"] for row in found] == [*first, *rest]
    assert [json.loads(row["row"]) for row in found] == [each.result["row"] for each in outcomes]


@pytest.mark.slow
def test_a_failing_cell_costs_no_other_and_processes_change_nothing(tmp_path, sweep, outcomes):
    for known in (versions, source_checksum):  # as of now, as the new processes read it
        known.cache_clear()
    worse = sweep_of({**DOCUMENT, "cells": [*DOCUMENT["cells"], {"noise": -1}]})
    store = Store(tmp_path, worse)
    run(store.missing, Backend(jobs=2), store.keep)
    *found, failed = read(tmp_path).to_pylist()
    assert failed["error"]
    assert [json.loads(row["row"]) for row in found] == [each.result["row"] for each in outcomes]
