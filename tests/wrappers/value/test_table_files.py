"""Tables as files: what is written comes back, and nothing else is read."""

from __future__ import annotations

import dataclasses
import io
import re
import zipfile

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.arrays import checksum, reading, write_arrays
from safe_envs.registry import make_problem
from safe_envs.values import tables
from safe_envs.values.grid import Axis, Grid
from safe_envs.values.reduction import reduced
from safe_envs.values.tables import (
    FORMAT,
    ValueFileError,
    ValueSettings,
    ValueTable,
    load_table,
    require_asked,
    save_table,
)

PROBLEM = make_problem("safe_envs/Scalar-v0")


def table_of(problem=PROBLEM, settings=None, rows=4):
    """Return a table with the fingerprint of a problem, and with values that are none of its."""
    settings = settings or ValueSettings()
    small = reduced(problem, settings.knowledge, settings.intervals)
    axes = (Axis(np.array([0.0, 0.5, 2.0])), Axis(np.linspace(-np.pi, np.pi, 4), 2 * np.pi))
    upper = np.random.default_rng(0).uniform(size=(rows, 6)).astype(np.float32)
    return ValueTable(
        problem=problem.name,
        fingerprint=small.fingerprint,
        settings=settings,
        grid=Grid(axes),
        inputs=np.array([[-1.0], [0.0], [1.0]]),
        first=3,
        lower=upper * np.float32(0.5),
        upper=upper,
        seconds=1.5,
    )


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "table.npz"
    save_table(table_of(), path)
    return path


def rewritten(path, change):
    """Write a file again with other content, under a right checksum."""
    with reading(path, "the test") as content:
        header, arrays = dict(content.header), content.arrays()
    change(header, arrays)
    del header["sha256"]
    header["sha256"] = checksum(header, arrays)
    write_arrays(path, header, arrays)


def test_a_table_comes_back_as_it_was(tmp_path):
    settings = ValueSettings(leaving="safe", cells=(2, 3), inputs=3)
    table = table_of(settings=settings)
    save_table(table, tmp_path / "table.npz")
    for found in (
        load_table(tmp_path / "table.npz", PROBLEM),
        load_table(str(tmp_path / "table.npz")),
    ):
        for name in ("problem", "fingerprint", "settings", "first", "seconds"):
            assert getattr(found, name) == getattr(table, name)
        for name in ("inputs", "lower", "upper"):
            np.testing.assert_array_equal(getattr(found, name), getattr(table, name))
            assert getattr(found, name).dtype == getattr(table, name).dtype
        assert [a.period for a in found.grid.axes] == [0.0, 2 * np.pi]
        for one, other in zip(found.grid.axes, table.grid.axes, strict=True):
            np.testing.assert_array_equal(one.edges, other.edges)
        assert found.steps == table.steps


def test_one_wrong_cell_is_refused(file):
    content = file.read_bytes()
    value = table_of().lower[2, 4].tobytes()
    assert content.count(value) == 1
    place = content.index(value)
    for other in (content[place] ^ 1, content[place] ^ 128):
        changed = content[:place] + bytes([other]) + content[place + 1 :]
        # Without zip's own checksum.
        file.write_bytes(_with_right_crc(changed))
        with pytest.raises(ValueFileError, match="altered: its content does not match"):
            load_table(file)


def _with_right_crc(content):
    """Return an archive packed again, as whoever alters a cell would do."""
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(packed, "w") as new:
        for part in old.infolist():
            with old.open(part) as stream:
                stream._expected_crc = None  # pyright: ignore[reportAttributeAccessIssue]
                new.writestr(part.filename, stream.read())
    return packed.getvalue()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_half_a_file_is_refused(file, share):
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueFileError, match="no file of `safe-envs best`"):
        load_table(file)


def _set_header(name, value):
    return lambda header, arrays: header.update({name: value})


def _set_array(name, change):
    return lambda header, arrays: arrays.update({name: change(arrays[name])})


def _with_value(array, value):
    array = array.copy()
    array.flat[1] = value
    return array


@pytest.mark.parametrize(
    "change",
    [
        _set_header("kind", "transitions"),
        _set_header("problem", 3),
        _set_header("fingerprint", "0" * 63),
        _set_header("fingerprint", None),
        _set_header("first", -1),
        _set_header("first", 1.5),
        _set_header("first", True),
        _set_header("seconds", -1.0),
        _set_header("seconds", "soon"),
        _set_header("settings", {"leaving": "best"}),
        _set_header("settings", {"speed": 1}),
        _set_header("settings", []),
        _set_array("lower", lambda a: _with_value(a, np.nan)),
        _set_array("upper", lambda a: _with_value(a, np.nan)),
        _set_array("lower", lambda a: _with_value(a, -0.01)),
        _set_array("upper", lambda a: _with_value(a, 1.01)),
        _set_array("lower", lambda a: _with_value(a, 0.999)),
        _set_array("lower", lambda a: a[:-1]),
        _set_array("lower", lambda a: a.astype(np.float64)),
        _set_array("upper", lambda a: a[:, :-1]),
        _set_array("upper", lambda a: a.reshape(-1)),
        _set_array("edges_0", lambda a: a[::-1]),
        _set_array("edges_0", lambda a: _with_value(a, a[0])),
        _set_array("edges_0", lambda a: _with_value(a, np.nan)),
        _set_array("edges_0", lambda a: np.append(a[:-1], np.inf)),
        _set_array("edges_0", lambda a: a[:1]),
        _set_array("edges_0", lambda a: a[None]),
        _set_array("edges_1", lambda a: 0.9 * a),
        _set_array("periods", lambda a: a[:1]),
        _set_array("periods", lambda a: _with_value(a, np.nan)),
        _set_array("periods", lambda a: -a),
        _set_array("inputs", lambda a: a[:, 0]),
        _set_array("inputs", lambda a: a[:0]),
        _set_array("inputs", lambda a: _with_value(a, np.inf)),
        lambda header, arrays: header.pop("first"),
        lambda header, arrays: arrays.pop("upper"),
        lambda header, arrays: arrays.update(more=np.zeros(3)),
    ],
)
def test_values_that_are_none_are_refused(file, change):
    rewritten(file, lambda header, arrays: None)
    load_table(file, PROBLEM)
    rewritten(file, change)
    with pytest.raises(ValueFileError, match=r"table.npz is no file of `safe-envs best`"):
        load_table(file)


def test_an_object_is_not_unpickled(file):
    with zipfile.ZipFile(file, "a") as archive, archive.open("more.npy", "w") as stream:
        np.lib.format.write_array(stream, np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(ValueFileError, match="no file of"):
        load_table(file)


def test_sizes_are_looked_at_before_memory_is_taken(file, monkeypatch):
    monkeypatch.setattr(tables, "MOST_BYTES_OF_TABLE", file.stat().st_size - 1)
    with pytest.raises(ValueFileError, match="larger than"):
        load_table(file)


def test_a_table_that_would_not_be_read_is_not_written(tmp_path, monkeypatch):
    path = tmp_path / "table.npz"
    table = table_of()
    with pytest.raises(ConfigurationError, match="0 <= lower <= upper <= 1"):
        save_table(dataclasses.replace(table, lower=table.upper + np.float32(1e-3)), path)
    monkeypatch.setattr(tables, "MOST_BYTES_OF_TABLE", tables.MOST_BYTES_OF_TEXT)
    with pytest.raises(ConfigurationError, match="would take"):
        save_table(table, path)
    assert not list(tmp_path.iterdir())


def test_another_format_is_named(file):
    rewritten(file, _set_header("format", 99))
    with pytest.raises(ValueFileError, match=f"has the format 99; this version reads {FORMAT}"):
        load_table(file)


@pytest.mark.parametrize(("name", "words"), [("none.npz", "does not exist"), ("", "is a folder")])
def test_no_file_is_named(tmp_path, name, words):
    with pytest.raises(ValueFileError, match=words):
        load_table(tmp_path / name)


def test_a_table_of_another_problem_is_refused(file):
    shorter = dataclasses.replace(PROBLEM, horizon=0.5 * PROBLEM.horizon)
    with pytest.raises(ValueFileError, match="an earlier version of 'Scalar'"):
        load_table(file, shorter)
    other = make_problem("safe_envs/Pendulum-v0")
    with pytest.raises(ValueFileError, match=re.escape("'Scalar', and not of 'Pendulum'")):
        load_table(file, other)
    assert load_table(file).problem == PROBLEM.name


def test_a_table_with_other_settings_is_refused(tmp_path):
    path = tmp_path / "table.npz"
    table = table_of(settings=ValueSettings(inputs=3))
    require_asked(path, table, ValueSettings())
    require_asked(path, table, ValueSettings(cells=(2, 3), inputs=3, memory=1e9))
    for settings, words in (
        (ValueSettings(leaving="safe"), "leaving = 'violation', and 'safe' is asked for"),
        (ValueSettings(knowledge="plant"), "knowledge = 'model'"),
        (ValueSettings(cells=(2, 4)), "cells ="),
        (ValueSettings(inputs=5), "inputs = 3"),
    ):
        with pytest.raises(ValueFileError, match=words):
            require_asked(path, table, settings)
