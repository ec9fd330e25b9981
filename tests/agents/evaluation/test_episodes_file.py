"""The file of single episodes is written group by group, whole or not at all."""

from __future__ import annotations

import errno

import numpy as np
import pyarrow.parquet as pq
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation import episodes_file as module

GIVEN = {"options": {"horizon": 0.1, "noise": 3.0}, "bounds": False, "episodes": 50}


def test_groups_do_not_depend_on_the_size_of_batches(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_GROUP", 16)
    contents = set()
    for size in (1, 7, 33, 50):
        place = tmp_path / f"{size}.parquet"
        given = {**GIVEN, "episodes_out": place, "num_envs": size}
        found = evaluate("Scalar-v0", "random", ["none", "scbf"], **given)
        contents.add(place.read_bytes())
    assert len(contents) == 1
    file, columns = pq.ParquetFile(place), found.episode_columns()
    groups = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
    assert groups == 2 * [16, 16, 16, 2]
    table = file.read()
    assert table["filter"].to_pylist() == 50 * ["none"] + 50 * ["scbf"]
    assert table["episode"].to_pylist() == 2 * list(range(50))
    assert set(table["identification"].to_pylist()) == {0}
    for name in ("return", "length", "interventions"):
        assert table[name].to_pylist() == columns[name].tolist()
    times = [None if np.isnan(t) else t for t in columns["first_violation"].tolist()]
    assert table["first_violation"].to_pylist() == times
    assert 0 < times.count(None) < 100


@pytest.mark.parametrize("error", [SystemError, KeyboardInterrupt])
@pytest.mark.parametrize("before", [None, "old"])
def test_a_failure_leaves_what_was_there(tmp_path, error, before):
    place, calls = tmp_path / "out.parquet", []
    if before:
        place.write_text(before)

    def progress(done):
        calls.append(done)
        if len(calls) == 3:
            assert len(list(tmp_path.iterdir())) == (2 if before else 1)
            raise error

    with pytest.raises(error):
        evaluate("Scalar-v0", episodes_out=place, progress=progress, num_envs=5, **GIVEN)
    assert [p.read_text() for p in tmp_path.iterdir()] == ([before] if before else [])


def test_a_full_disk_is_named(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pq.ParquetWriter, "write_table", full)
    with pytest.raises(ConfigurationError, match=r"out.parquet: No space left"):
        evaluate("Scalar-v0", episodes_out=tmp_path / "out.parquet", **GIVEN)
    assert list(tmp_path.iterdir()) == []


def test_without_pyarrow_it_is_said_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda _: None)
    with pytest.raises(ConfigurationError, match="sweep"):
        evaluate("Scalar-v0", episodes_out=tmp_path / "out.parquet", **GIVEN)
