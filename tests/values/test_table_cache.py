"""Tables that are kept: computed once, found again, and never half-written."""

from __future__ import annotations

import dataclasses
import logging
import os
import threading

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.files import VARIABLE, locked
from safe_envs.values import solve as solving
from safe_envs.values.solve import table_for
from safe_envs.values.tables import FORMAT, ValueFileError, ValueSettings, load_table, save_table
from tests.values.systems import scalar, solved, x
from tests.values.test_table_files import PROBLEM, table_of


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache" / "values"


@pytest.fixture
def computed(monkeypatch):
    """What was computed, in place of the computation."""
    calls = []

    def solve(problem, settings, progress):
        calls.append(settings)
        if progress:
            progress(1.0)
        return table_of(problem, settings)

    monkeypatch.setattr(solving, "solve", solve)
    return calls


def test_a_table_is_computed_once(folder, computed):
    done = []
    first = table_for(PROBLEM, progress=done.append)
    (place,) = folder.iterdir()
    os.utime(place, (1, 1))
    second = table_for(PROBLEM, ValueSettings(), progress=done.append)
    assert len(computed) == len(done) == 1
    assert place.stat().st_mtime > 1
    np.testing.assert_array_equal(first.lower, second.lower)
    assert first.fingerprint == second.fingerprint
    other = table_for(PROBLEM, ValueSettings(leaving="safe"))
    assert other.settings.leaving == "safe"
    assert len(computed) == len(list(folder.iterdir())) == 2


def test_without_a_cache_nothing_is_kept(tmp_path, monkeypatch, computed):
    monkeypatch.setenv(VARIABLE, "")
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        table_for(PROBLEM)
    assert len(computed) == 2
    assert not list(tmp_path.iterdir())


def test_a_damaged_table_is_computed_again(folder, computed, caplog):
    table_for(PROBLEM)
    (place,) = folder.iterdir()
    place.write_bytes(place.read_bytes()[:-100])
    with caplog.at_level(logging.WARNING, "safe_envs"):
        table_for(PROBLEM)
    assert len(computed) == 2
    assert "truncated or altered" in caplog.text
    assert load_table(place, PROBLEM).steps == 6


def test_a_table_of_another_problem_under_the_name_is_not_taken(folder, computed):
    table_for(PROBLEM)
    (place,) = folder.iterdir()
    save_table(table_of(dataclasses.replace(PROBLEM, horizon=0.5 * PROBLEM.horizon)), place)
    assert table_for(PROBLEM).fingerprint == table_of().fingerprint
    assert len(computed) == 2


def test_a_table_of_other_settings_under_the_name_is_not_taken(folder, computed):
    table_for(PROBLEM)
    (place,) = folder.iterdir()
    save_table(table_of(settings=ValueSettings(leaving="safe")), place)
    assert table_for(PROBLEM).settings.leaving == "violation"
    assert len(computed) == 2


@pytest.mark.parametrize("error", [KeyboardInterrupt, ConfigurationError, MemoryError])
def test_an_interrupted_computation_leaves_nothing(folder, computed, monkeypatch, error):
    def interrupted(*_):
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(solving, "solve", interrupted)
        with pytest.raises(error):
            table_for(PROBLEM)
    assert not list(folder.iterdir())
    table_for(PROBLEM)
    assert len(list(folder.iterdir())) == 1


def test_an_interrupted_writing_leaves_nothing(folder, computed, monkeypatch):
    def interrupted(stream, **_):
        stream.write(b"half of a table")
        raise KeyboardInterrupt

    monkeypatch.setattr("safe_envs.files.np.savez", interrupted)
    with pytest.raises(KeyboardInterrupt):
        table_for(PROBLEM)
    assert not list(folder.iterdir())


def test_a_full_disk_costs_no_table(folder, computed, monkeypatch, caplog):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("safe_envs.files.np.savez", full)
    with caplog.at_level(logging.WARNING, "safe_envs"):
        assert table_for(PROBLEM).steps == 6
    assert "the table is not kept: cannot write" in caplog.text
    monkeypatch.setattr("safe_envs.files._opened", full)
    assert table_for(PROBLEM).steps == 6
    assert len(computed) == 2


def test_who_finds_another_at_work_waits_for_its_table(folder, computed, caplog):
    table_for(PROBLEM)
    (place,) = folder.iterdir()
    table = load_table(place)
    place.unlink()
    told = threading.Event()

    class Told(logging.Handler):
        def emit(self, record):
            told.set()

    def other():
        with locked(place.with_suffix(".lock"), "taken"):
            begun.set()
            told.wait(10)
            save_table(table, place)

    begun, thread = threading.Event(), threading.Thread(target=other)
    handler = Told()
    logging.getLogger("safe_envs").addHandler(handler)
    try:
        thread.start()
        begun.wait(10)
        found = table_for(PROBLEM)
    finally:
        logging.getLogger("safe_envs").removeHandler(handler)
        thread.join()
    assert "another process computes the values of 'Scalar'" in caplog.text
    assert len(computed) == 1
    np.testing.assert_array_equal(found.upper, table.upper)
    assert list(folder.iterdir()) == [place]


def test_a_file_by_name_is_read_or_written(folder, computed, tmp_path):
    file = tmp_path / "mine.npz"
    table_for(PROBLEM, file=file)
    assert load_table(file, PROBLEM).fingerprint == table_of().fingerprint
    table_for(PROBLEM, file=str(file))
    assert len(computed) == 1
    with pytest.raises(ValueFileError, match="leaving"):
        table_for(PROBLEM, ValueSettings(leaving="safe"), file=file)
    assert len(computed) == 1


def test_a_file_that_cannot_be_written_is_named_before_the_work(folder, computed, tmp_path):
    with pytest.raises(ConfigurationError, match="does not exist"):
        table_for(PROBLEM, file=tmp_path / "none" / "mine.npz")
    with pytest.raises(ConfigurationError, match="is a folder"):
        table_for(PROBLEM, file=tmp_path)
    assert not computed


@pytest.mark.parametrize(
    ("problem", "means"),
    [
        (scalar(), (0.96320188, 0.98909324)),
        (scalar(-x, 0.2 + 0.3 * x), (0.97694087, 0.99563587)),
    ],
)
def test_other_values_are_of_another_format(problem, means):
    """Whoever changes how values are computed raises FORMAT, and then these numbers.

    Else the tables in caches, which an earlier way has computed, are taken for the new ones.
    """
    table = solved(problem, 60, inputs=9)
    assert FORMAT == 3
    assert (table.lower.mean(), table.upper.mean()) == pytest.approx(means, abs=2e-6)
