"""The folder of the cache is the user's alone, or there is none."""

from __future__ import annotations

import os
import stat
import time

import pytest

from safe_envs import files
from safe_envs.files import CONTENTS, VARIABLE, cache_folder, entries, make_room, own_cache


def test_places_of_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, "")
    assert cache_folder("values") is None
    (tmp_path / "file").touch()
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file"))
    assert cache_folder("values") is None
    monkeypatch.setenv(VARIABLE, str(tmp_path / "given"))
    assert cache_folder("values") == tmp_path / "given" / "values"
    monkeypatch.delenv(VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(files.sys, "platform", "linux")
    assert cache_folder("compiled") == tmp_path / "safe-envs" / "compiled"


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="rights of POSIX")
def test_a_folder_that_others_write_to_is_not_trusted(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    folder = cache_folder("values")
    assert folder is not None
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(0o770)
    assert cache_folder("values") is None
    folder.chmod(0o700)
    tmp_path.chmod(0o777)
    assert cache_folder("values") is None


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An entry in each folder, the later the folder the later used, and files of others."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    folders = {name: cache_folder(name) for name in CONTENTS}
    for i, (name, folder) in enumerate(folders.items()):
        if name == "compiled":
            (folder / ("0" * 32)).mkdir()
            (folder / ("0" * 32) / "program.py").write_bytes(b"x" * 10)
            place = folder / ("0" * 32)
        else:
            place = folder / f"{'0' * 64}.{'json' if name == 'attainable' else 'npz'}"
            place.write_bytes(b"x" * 10)
        os.utime(place, (i, i))
        (folder / "mine.npz").write_bytes(b"x" * 1000)
    return folders


def test_what_was_used_last_remains(cache):
    names = list(CONTENTS)
    make_room(25)
    assert [name for name in names if entries(name)] == names[-2:]
    make_room(5)
    assert [name for name in names if entries(name)] == names[-1:]
    assert all((folder / "mine.npz").exists() for folder in cache.values())


def test_what_killed_processes_left_goes_after_a_day(cache):
    old, new = (cache["values"] / f".{digit * 40}.abc.npz" for digit in "01")
    for place, age in ((old, 90_000), (new, 60)):
        place.touch()
        os.utime(place, (time.time() - age, time.time() - age))
    make_room()
    assert (old.exists(), new.exists()) == (False, True)
    assert all(entries(name) for name in CONTENTS)


def test_a_cache_of_its_own_has_compiled_programs_alone(cache):
    with own_cache():
        assert [name for name in CONTENTS if entries(name)] == ["compiled"]
        table = cache_folder("values") / f"{'1' * 64}.npz"
        table.touch()
        assert entries("values")
    assert os.environ[VARIABLE] == str(cache["values"].parent)
    assert [each.place.name[0] for each in entries("values")] == ["0"]
