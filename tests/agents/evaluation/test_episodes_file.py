"""The file of single episodes is written group by group, whole or not at all."""

from __future__ import annotations

import errno

import numpy as np
import pyarrow.parquet as pq
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents.evaluation import episodes_file as module
from safe_envs.agents.evaluation.episodes_file import episodes_file, require_parquet
from tests.agents.evaluation.made_up import made_up


def write(path, portions, results):
    with episodes_file(path, 0.5) as file:
        for name, repeat in (("none", 0), ("scbf", 0), ("scbf", 1)):
            file.begin(name, repeat)
            for part in np.split(np.arange(len(results.length)), portions):
                file.add(results.part(slice(part[0], part[-1] + 1)))


@pytest.fixture
def small_groups(monkeypatch):
    monkeypatch.setattr(module, "_GROUP", 16)


@pytest.mark.usefixtures("small_groups")
def test_groups_do_not_depend_on_the_size_of_batches(tmp_path):
    results, contents = made_up(50), set()
    for i, portions in enumerate(([], [1, 2, 40], [16, 32], range(1, 50))):
        path = tmp_path / f"{i}.parquet"
        write(path, portions, results)
        contents.add(path.read_bytes())
    assert len(contents) == 1
    file = pq.ParquetFile(tmp_path / "0.parquet")
    groups = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
    assert groups == 3 * [16, 16, 16, 2]
    table = file.read()
    assert table["filter"].to_pylist() == 50 * ["none"] + 100 * ["scbf"]
    assert table["identification"].to_pylist() == 100 * [0] + 50 * [1]
    assert table["episode"].to_pylist() == 3 * list(range(50))
    assert table["return"].to_pylist() == 3 * results.returns.tolist()
    assert table["length"].to_pylist() == 3 * results.length.tolist()
    times = [None if f < 0 else 0.5 * f for f in results.first_violation.tolist()]
    assert table["first_violation"].to_pylist() == 3 * times


@pytest.mark.usefixtures("small_groups")
def test_what_waits_is_less_than_a_group(tmp_path):
    results = made_up(50)
    with episodes_file(tmp_path / "out.parquet", 0.5) as file:
        file.begin("none", 0)
        for _ in range(9):
            file.add(results)
            waiting = sum(len(each.length) for each in file._waiting)
            assert waiting < 16


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("before", [None, "old"])
def test_a_failure_leaves_what_was_there(tmp_path, error, before):
    path = tmp_path / "out.parquet"
    if before:
        path.write_text(before)

    def interrupted():
        with episodes_file(path, 0.5) as file:
            file.begin("none", 0)
            file.add(made_up(5))
            assert len(list(tmp_path.iterdir())) == (2 if before else 1)
            raise error

    with pytest.raises(error):
        interrupted()
    assert [p.read_text() for p in tmp_path.iterdir()] == ([before] if before else [])


def test_a_full_disk_is_named(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pq.ParquetWriter, "write_table", full)
    with pytest.raises(ConfigurationError, match=r"cannot write .*out.parquet: No space left"):
        write(tmp_path / "out.parquet", [], made_up(5))
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_written_is_named_before_the_run(tmp_path):
    require_parquet(tmp_path / "out.parquet", "--episodes-out")
    with pytest.raises(ConfigurationError, match=r"episodes_out .*out.csv is no name of a Parquet"):
        require_parquet(tmp_path / "out.csv", "episodes_out")
    with pytest.raises(ConfigurationError, match="does not exist"):
        require_parquet(tmp_path / "no" / "out.parquet", "episodes_out")
