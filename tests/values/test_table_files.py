"""Tables as files and in the cache: what is written comes back, once, whole, and nothing else."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import threading
import zipfile
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError
from safe_envs.arrays import checksum, reading, write_arrays
from safe_envs.files import VARIABLE, locked
from safe_envs.registry import make_problem
from safe_envs.values import tables
from safe_envs.values.look_ahead import LookAhead
from safe_envs.values.solve import table_for
from safe_envs.values.tables import FORMAT, ValueFileError, ValueSettings, load_table, save_table
from tests.oracles.full_disk import no_file_larger_than
from tests.values.systems import scalar, solved, x

PROBLEM = scalar(horizon=0.4)
SETTINGS = ValueSettings(cells=(12,), inputs=3)
ANGLE = scalar(barriers=sp.cos(x) + 0.5, workspace={}, units={x: "rad"}, start=(0.1,), horizon=0.3)


@pytest.mark.parametrize(
    ("given", "fragment"),
    [
        ({"knowledge": "plants"}, "'plant'"),
        ({"leaving": "no"}, "violation, safe"),
        ({"cells": 400}, "cells = 400"),
        ({"cells": "400x100"}, "whole number"),
        ({"cells": (1,)}, "cells = 1;"),
        ({"inputs": 1}, "inputs = 1;"),
        ({"memory": 0.0}, "bytes"),
        ({"intervals": {"v": 3.0}}, "v = 3.0"),
        ({"intervals": {"v": (1.0, 2.0, 3.0)}}, "two numbers"),
        ({"intervals": {"v": (1.0, float("nan"))}}, "v = nan"),
        ({"specification": 3}, "specification = 3"),
    ],
)
def test_settings_that_are_none_are_refused(given: dict[str, Any], fragment: str):
    with pytest.raises(ConfigurationError, match=fragment):
        ValueSettings(**given)


def test_settings_go_through_json():
    settings = ValueSettings("plant", "safe", {"v": (1, 2)}, cells=[40, 50], inputs=3)  # pyright: ignore[reportArgumentType]
    assert ValueSettings(**json.loads(json.dumps(settings.as_dict()))) == settings
    assert settings.cells == (40, 50)


@pytest.fixture(scope="module")
def table():
    return solved(PROBLEM, 12, inputs=3)


@pytest.fixture
def file(tmp_path, table):
    path = tmp_path / "table.npz"
    save_table(table, path)
    return path


def same(one, other):
    for name in ("problem", "fingerprint", "settings", "first", "seconds", "steps", "states"):
        assert getattr(one, name) == getattr(other, name), name
    for name in ("inputs", "lower", "upper"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert getattr(one, name).dtype == getattr(other, name).dtype
    for a, b in zip(one.grid.axes, other.grid.axes, strict=True):
        assert a.period == b.period
        np.testing.assert_array_equal(a.edges, b.edges)
    return True


@pytest.mark.parametrize(
    ("problem", "settings"),
    [
        (PROBLEM, {"leaving": "safe"}),
        (scalar(horizon=3.0), {}),
        (ANGLE, {}),
        (PROBLEM, {"specification": "eventually[1,2] safe"}),
    ],
)
def test_a_table_comes_back_as_it_was(problem, settings, tmp_path):
    table = solved(problem, 12, inputs=3, **settings)
    save_table(table, tmp_path / "table.npz")
    assert same(load_table(tmp_path / "table.npz", problem), table)
    assert same(load_table(str(tmp_path / "table.npz")), table)


def rewritten(path, change):
    """Write a file again with other content, under a right checksum."""
    with reading(path, "the test") as content:
        header, arrays = dict(content.header), content.arrays()
    change(header, arrays)
    del header["sha256"]
    header["sha256"] = checksum(header, arrays)
    write_arrays(path, header, arrays)


def _with_right_crc(content):
    """Return an archive packed again, as whoever alters a cell would do."""
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(packed, "w") as new:
        for part in old.infolist():
            with old.open(part) as stream:
                stream._expected_crc = None  # pyright: ignore[reportAttributeAccessIssue]
                new.writestr(part.filename, stream.read())
    return packed.getvalue()


def test_one_wrong_cell_is_refused(file, table):
    content = file.read_bytes()
    row = table.lower[0].tobytes()
    assert content.count(row) == 1
    place = content.index(row) + 4 * int(table.lower[0].argmax())
    for other in (content[place] ^ 1, content[place] ^ 128):
        file.write_bytes(_with_right_crc(content[:place] + bytes([other]) + content[place + 1 :]))
        with pytest.raises(ValueFileError, match="altered"):
            load_table(file)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_half_a_file_is_refused(file, share):
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueFileError, match="`safe-envs best`"):
        load_table(file)


def _with_value(array, value):
    array = array.copy()
    array.flat[1] = value
    return array


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("kind", "transitions"),
        ("problem", 3),
        ("fingerprint", "0" * 63),
        ("first", -1),
        ("first", True),
        ("first", KeyError),
        ("seconds", -1.0),
        ("settings", {"leaving": "best"}),
        ("settings", []),
    ],
)
def test_headers_that_are_none_are_refused(file, name, value):
    rewritten(file, lambda header, arrays: None)
    load_table(file, PROBLEM)
    if value is KeyError:
        rewritten(file, lambda header, arrays: header.pop(name))
    else:
        rewritten(file, lambda header, arrays: header.update({name: value}))
    with pytest.raises(ValueFileError, match=r"table.npz is no file of `safe-envs best`"):
        load_table(file)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("lower", lambda a: _with_value(a, np.nan)),
        ("upper", lambda a: _with_value(a, np.nan)),
        ("lower", lambda a: _with_value(a, -0.01)),
        ("upper", lambda a: _with_value(a, 1.01)),
        ("lower", lambda a: a + np.float32(1e-3)),
        ("lower", lambda a: a[:-1]),
        ("lower", lambda a: a.astype(np.float64)),
        ("upper", lambda a: a.reshape(-1)),
        ("edges_0", lambda a: a[::-1]),
        ("edges_0", lambda a: _with_value(a, a[0])),
        ("edges_0", lambda a: np.append(a[:-1], np.inf)),
        ("edges_0", lambda a: a[:1]),
        ("periods", lambda a: np.append(a, 0.0)),
        ("periods", lambda a: a + np.nan),
        ("periods", lambda a: a - 2 * np.pi),
        ("inputs", lambda a: a[:, 0]),
        ("inputs", lambda a: _with_value(a, np.inf)),
        ("upper", None),
        ("more", lambda _: np.zeros(3)),
    ],
)
def test_arrays_that_are_none_are_refused(file, name, change):
    def changed(header, arrays):
        before = arrays.pop(name, None)
        if change is not None:
            arrays[name] = change(before)

    rewritten(file, changed)
    with pytest.raises(ValueFileError, match=r"table.npz is no file of `safe-envs best`"):
        load_table(file)


def test_an_object_is_not_unpickled(file):
    with zipfile.ZipFile(file, "a") as archive, archive.open("more.npy", "w") as stream:
        np.lib.format.write_array(stream, np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(ValueFileError, match=r"table\.npz"):
        load_table(file)


def test_sizes_are_looked_at_before_memory_is_taken(file, table, tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "MOST_BYTES_OF_TABLE", file.stat().st_size - 1)
    with pytest.raises(ValueFileError, match="larger than"):
        load_table(file)
    monkeypatch.setattr(tables, "MOST_BYTES_OF_TABLE", tables.MOST_BYTES_OF_TEXT)
    with pytest.raises(ConfigurationError, match="would take"):
        save_table(table, tmp_path / "other.npz")
    assert list(tmp_path.iterdir()) == [file]


def test_a_table_that_would_not_be_read_is_not_written(tmp_path, table):
    false = dataclasses.replace(table, lower=table.upper + np.float32(1e-3))
    with pytest.raises(ConfigurationError, match="lower <= upper"):
        save_table(false, tmp_path / "table.npz")
    assert not list(tmp_path.iterdir())


def test_other_files_and_problems_are_named(file, tmp_path):
    for name in ("none.npz", ""):
        with pytest.raises(ValueFileError, match=tmp_path.name):
            load_table(tmp_path / name)
    with pytest.raises(ValueFileError, match="earlier version of 'scalar'"):
        load_table(file, scalar(horizon=0.2))
    with pytest.raises(ValueFileError, match="'scalar', and not of 'Pendulum'"):
        load_table(file, make_problem("safe_envs/Pendulum-v0"))
    rewritten(file, lambda header, arrays: header.update(format=99))
    with pytest.raises(ValueFileError, match=f"99.*{FORMAT}"):
        load_table(file)


def test_a_table_is_read_ahead_for_its_own_problem_and_inputs_only(table):
    with pytest.raises(ConfigurationError, match="another problem"):
        LookAhead(table, scalar(horizon=0.2))
    with pytest.raises(ConfigurationError, match="other inputs"):
        LookAhead(dataclasses.replace(table, inputs=table.inputs[:-1]), PROBLEM)


class Asked:
    """Asks for tables, and counts how many were computed."""

    def __init__(self, folder):
        self.folder, self.computed = folder, 0

    def __call__(self, problem=PROBLEM, settings=SETTINGS, **more):
        def progress(share):
            self.computed += share == 1.0

        return table_for(problem, settings, progress, **more)

    def place(self):
        (place,) = self.folder.iterdir()
        return place


@pytest.fixture
def asked(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    return Asked(tmp_path / "cache" / "values")


def test_a_table_is_computed_once(asked):
    first = asked()
    place = asked.place()
    os.utime(place, (1, 1))
    assert same(asked(), first)
    assert asked.computed == 1
    assert place.stat().st_mtime > 1
    other = asked(settings=dataclasses.replace(SETTINGS, leaving="safe"))
    assert other.settings.leaving == "safe"
    assert asked.computed == len(list(asked.folder.iterdir())) == 2


def test_without_a_cache_nothing_is_kept(asked, tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, "")
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        asked()
    assert asked.computed == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("how", ["half", "another problem", "other settings"])
def test_a_file_under_the_name_of_a_table_that_is_another_is_not_taken(asked, how, caplog):
    right = asked()
    place = asked.place()
    if how == "half":
        place.write_bytes(place.read_bytes()[:-100])
    elif how == "another problem":
        save_table(solved(scalar(horizon=0.2), 12, inputs=3), place)
    else:
        save_table(solved(PROBLEM, 12, inputs=3, leaving="safe"), place)
    np.testing.assert_array_equal(asked().lower, right.lower)
    assert asked.computed == 2
    assert (how == "half") == ("truncated" in caplog.text)
    np.testing.assert_array_equal(load_table(place, PROBLEM).lower, right.lower)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ConfigurationError, MemoryError])
def test_an_interrupted_computation_leaves_nothing(asked, error):
    def interrupted(share):
        raise error

    with pytest.raises(error):
        table_for(PROBLEM, SETTINGS, interrupted)
    assert not list(asked.folder.iterdir())
    asked()
    asked.place()


def test_an_interrupted_writing_leaves_nothing(asked, monkeypatch):
    def interrupted(stream, **_):
        stream.write(b"half of a table")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", interrupted)
        with pytest.raises(KeyboardInterrupt):
            asked()
    assert not list(asked.folder.iterdir())


def test_a_full_disk_costs_no_table(asked, table, caplog):
    with no_file_larger_than(200):
        np.testing.assert_array_equal(asked().lower, table.lower)
    assert "not kept" in caplog.text
    assert not list(asked.folder.iterdir())


def test_who_finds_another_at_work_waits_for_its_table(asked, table, caplog):
    asked()
    place = asked.place()
    place.unlink()
    begun, release = threading.Event(), threading.Event()

    def other():
        with locked(place.with_suffix(".lock"), "taken"):
            begun.set()
            release.wait(10)
            save_table(table, place)

    thread = threading.Thread(target=other)
    timer = threading.Timer(0.3, release.set)
    thread.start()
    begun.wait(10)
    timer.start()
    found = asked()
    thread.join()
    assert asked.computed == 1
    assert "another process" in caplog.text
    assert same(found, table)
    assert asked.place() == place


def test_a_file_by_name_is_read_or_written(asked, tmp_path):
    file = tmp_path / "mine.npz"
    first = asked(file=file)
    assert same(load_table(file, PROBLEM), first)
    # What is not asked for does not matter.
    assert same(asked(file=str(file), settings=ValueSettings()), first)
    for settings, fragment in (
        (ValueSettings(leaving="safe"), "leaving = 'violation'"),
        (ValueSettings(knowledge="plant"), "knowledge = 'model'"),
        (ValueSettings(cells=(40,)), "cells ="),
        (ValueSettings(inputs=5), "inputs = 3"),
    ):
        with pytest.raises(ValueFileError, match=fragment):
            asked(file=file, settings=settings)
    for bad in (tmp_path / "none" / "mine.npz", tmp_path):
        with pytest.raises(ConfigurationError, match=bad.parent.name):
            asked(file=bad, problem=ANGLE)
    assert asked.computed == 1


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
