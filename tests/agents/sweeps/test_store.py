from __future__ import annotations

import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from safe_envs.agents.jobs.job import JobOutcome, outcome_of
from safe_envs.agents.jobs.store import ResultStore
from safe_envs.agents.sweeps.spec import Sweep, sweep_of
from safe_envs.agents.sweeps.store import Store, read
from safe_envs.errors import ConfigurationError
from tests.oracles.full_disk import no_file_larger_than

SMALL: dict[str, Any] = {"env": "Scalar-v0", "filter": "scbf", "episodes": 20, "horizon": 0.2}


@pytest.fixture(scope="module")
def sweep() -> Sweep:
    return sweep_of(
        {"fixed": SMALL, "grid": {"noise": [0.1, [0.2], 0.3]}, "cells": [{"start": [0.5]}]}
    )


@pytest.fixture(scope="module")
def outcomes(sweep: Sweep) -> list[JobOutcome]:
    return [outcome_of(cell) for cell in sweep.cells]


def test_what_was_kept_is_read_in_the_order_of_the_file(
    tmp_path: Path, sweep: Sweep, outcomes: list[JobOutcome]
):
    store = Store(tmp_path, sweep)
    assert store.missing == list(sweep.cells)
    for outcome in reversed(outcomes[1:]):
        store.keep(outcome)
    table = read(tmp_path)
    assert table["key"].to_pylist() == [cell.key for cell in sweep.cells[1:]]
    assert table["noise"].to_pylist() == ["[0.2]", "0.3", None]
    assert table["start"].to_pylist() == [None, None, "[0.5]"]
    assert table["episodes"].to_pylist() == [20] * 3
    for row, outcome in zip(table.to_pylist(), outcomes[1:], strict=True):
        assert all(
            row[name] == outcome.result["row"][name]
            for name in (
                "safe",
                "safety_rate",
                "ci_low",
                "min_h_p05",
                "return_mean",
                "held_bound",
                "continuous_bound",
                "continuous_word",
            )
        )
        assert json.loads(row["row"]) == outcome.result["row"]
        assert json.loads(row["config"])["problem"]["dt"] == 0.01
        assert set(json.loads(row["versions"])) > {"python", "numpy", "safe-envs", "source"}
    assert Store(tmp_path, sweep).missing == [sweep.cells[0]]


def test_a_failed_cell_is_told_and_tried_again(
    tmp_path: Path, sweep: Sweep, outcomes: list[JobOutcome]
):
    store = Store(tmp_path, sweep)
    store.keep(JobOutcome(sweep.cells[0].key, None, "it broke", 0.1))
    assert read(tmp_path)["error"].to_pylist() == ["it broke"]
    # Those that failed come last, so that they keep no other from being computed.
    assert Store(tmp_path, sweep).missing == [*sweep.cells[1:], sweep.cells[0]]
    store.keep(outcomes[0])
    assert read(tmp_path)["error"].to_pylist() == [None]


def test_a_failure_replaces_no_result_of_another_run(
    tmp_path: Path, sweep: Sweep, outcomes: list[JobOutcome]
):
    store, other = Store(tmp_path, sweep), Store(tmp_path, sweep)
    other.keep(outcomes[0])
    store.keep(JobOutcome(sweep.cells[0].key, None, "it broke", 0.1))
    assert read(tmp_path)["error"].to_pylist() == [None]
    assert store.missing == list(sweep.cells[1:])


def test_settings_of_cells_that_are_not_there_have_columns(
    tmp_path: Path, sweep: Sweep, outcomes: list[JobOutcome]
):
    Store(tmp_path, sweep).keep(outcomes[0])
    assert read(tmp_path).select(["noise", "start"]).to_pylist() == [{"noise": 0.1, "start": None}]


def test_the_results_of_another_sweep_are_read_until_there_is_one_of_this(
    tmp_path: Path, sweep: Sweep, outcomes: list[JobOutcome]
):
    first = Store(tmp_path, sweep)
    for outcome in outcomes:
        first.keep(outcome)
    # As after an update of the code: nothing of it has been computed yet.
    newer = Sweep(
        tuple(replace(cell, versions={**cell.versions, "source": "newer"}) for cell in sweep.cells),
        sweep.swept,
    )
    store = Store(tmp_path, newer)
    assert store.missing == list(newer.cells)
    assert len(read(tmp_path)) == 4
    store.keep(replace(outcomes[0], key=newer.cells[0].key))
    assert read(tmp_path)["key"].to_pylist() == [newer.cells[0].key]


def test_what_was_being_written_when_a_run_was_killed_is_removed(tmp_path: Path, sweep: Sweep):
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


def test_cells_of_another_sweep_stay_and_are_not_read(
    tmp_path: Path, sweep: Sweep, outcomes: list[JobOutcome]
):
    store = Store(tmp_path, sweep)
    for outcome in outcomes:
        store.keep(outcome)
    smaller = Sweep(sweep.cells[:1], ())
    assert Store(tmp_path, smaller).missing == []
    assert len(read(tmp_path)) == 1
    assert Store(tmp_path, sweep).missing == []


def test_a_full_disk_loses_nothing_that_is_finished(
    tmp_path: Path, sweep: Sweep, outcomes: list[JobOutcome]
):
    store = Store(tmp_path, sweep)
    store.keep(outcomes[0])

    with (
        no_file_larger_than(300),
        pytest.raises(
            ConfigurationError, match=r"File too large; .*\. 1 of 4 cells are finished and kept"
        ),
    ):
        store.keep(outcomes[1])
    assert [path.stem for path in (tmp_path / "cells").iterdir()] == [sweep.cells[0].key]
    again = Store(tmp_path, sweep)
    assert again.missing == list(sweep.cells[1:])
    again.keep(outcomes[1])
    assert len(read(tmp_path)) == 2


def test_a_broken_file_is_computed_again(tmp_path: Path, sweep: Sweep, outcomes: list[JobOutcome]):
    store = Store(tmp_path, sweep)
    store.keep(outcomes[0])
    (file,) = (tmp_path / "cells").iterdir()
    results, key = ResultStore(tmp_path / "cells"), sweep.cells[0].key
    configuration = sweep.cells[0].configuration
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(ConfigurationError, match="remove it, and it is computed again"):
        read(tmp_path)
    assert sweep.cells[0] in Store(tmp_path, sweep).missing
    # Whole, but with nothing in it, or with something else.
    content = {**outcomes[0].result, "error": None, "seconds": 0.0}
    for other in ({}, {**content, "row": 3}, {**content, "row": {"safe": "x"}, "config": []}):
        results.keep(key, configuration, other)
        with pytest.raises(ConfigurationError, match="remove it and start the sweep again"):
            read(tmp_path)
    for other in ({}, {**content, "row": 3}):
        results.keep(key, configuration, other)
        assert sweep.cells[0] in Store(tmp_path, sweep).missing


def test_folders_that_cannot_be(tmp_path: Path, sweep: Sweep):
    with pytest.raises(ConfigurationError, match="holds no sweep"):
        read(tmp_path)
    for text in ("{}", "[]", '{"cells": 1, "swept": []}'):
        (tmp_path / "sweep.json").write_text(text)
        with pytest.raises(ConfigurationError, match="is not as `safe-envs sweep` writes it"):
            read(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="cannot be made"):
        Store(tmp_path / "file", sweep)
    Store(tmp_path / "empty", sweep)
    assert len(read(tmp_path / "empty")) == 0


def test_without_pyarrow_the_extra_is_named(
    tmp_path: Path, sweep: Sweep, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("safe_envs.agents.sweeps.store.find_spec", lambda name: None)
    with pytest.raises(ConfigurationError, match=r"\.\[sweep\]"):
        Store(tmp_path, sweep)
