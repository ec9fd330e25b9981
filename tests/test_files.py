"""Files: only regular ones are read, within bounds; one at a time holds a lock; the cache is the
user's alone."""

from __future__ import annotations

import contextlib
import io
import math
import os
import re
import stat
import struct
import sys
import threading
import time
import zipfile
from pathlib import Path

import hypothesis
import hypothesis.strategies as st
import pytest

from safe_envs import files
from safe_envs.errors import ConfigurationError
from safe_envs.files import (
    CONTENTS,
    VARIABLE,
    cache_folder,
    entries,
    locked,
    make_room,
    open_archive,
    own_cache,
    read_bytes,
    read_json,
    require_writable,
    write_atomically,
    write_json,
)


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    """A pipe into which nobody writes: to open it in the plain way waits for ever."""
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


def test_a_regular_file_is_read_up_to_its_largest_size(tmp_path: Path):
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    (tmp_path / "link").symlink_to(path)
    assert read_bytes(path, 5) == read_bytes(tmp_path / "link") == b"12345"
    with pytest.raises(OSError, match="larger than"):
        read_bytes(path, 4)


@pytest.mark.usefixtures("pipe")
def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path):
    (tmp_path / "endless").symlink_to("/dev/zero")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with (tmp_path / "sparse").open("wb") as stream:
        stream.truncate(10**12)
    refused = {
        "pipe": "pipe",
        "endless": "device",
        "loop": "symbolic",
        "sparse": "larger",
        ".": "directory",
        "none": "No such file",
    }
    for name, reason in (refused | {"x" * 300: "too long", "a\0b": "null"}).items():
        with pytest.raises(OSError, match=reason):
            read_bytes(tmp_path / name)


def test_files_of_the_kernel_have_no_size_and_are_read_up_to_the_limit():
    with pytest.raises(OSError, match="larger than"):
        read_bytes("/proc/self/maps", 100)


@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 5000, "{", "\xff"])
def test_json_that_is_none_is_an_error_of_ours(tmp_path: Path, text: str):
    (tmp_path / "a.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigurationError, match=r"is no JSON .*; do this"):
        read_json(tmp_path / "a.json", "do this")


def archive_of(parts: dict[str, bytes], **how) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", **how) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return stream.getvalue()


def test_an_archive_is_opened_where_all_that_it_holds_is_small():
    content = archive_of({"a": b"1" * 1000, "b": b"2" * 1000}, compression=zipfile.ZIP_DEFLATED)
    with open_archive(io.BytesIO(content), 2000) as archive:
        assert archive.read("b") == b"2" * 1000
    assert len(content) < 300
    with pytest.raises(ValueError, match="unpacked it is larger"):
        open_archive(io.BytesIO(content), 1999)


def test_the_directory_of_an_archive_is_not_read_where_it_is_large():
    whole = bytearray(archive_of({"a": b"1"}))
    struct.pack_into("<L", whole, len(whole) - 10, 2_000_000)
    with pytest.raises(ValueError, match="too many parts"):
        open_archive(io.BytesIO(bytes(whole)))
    # In the format for large files another record says how large it is.
    large = (
        b"PK\6\6"
        + struct.pack("<Q2H2L4Q", 44, 45, 45, 0, 0, 1, 1, 2_000_000, 0)
        + b"PK\6\7"
        + bytes(16)
    )
    with pytest.raises(ValueError, match="too many parts"):
        open_archive(
            io.BytesIO(
                bytes(whole[:-22]) + large + bytes(whole[-22:-10]) + b"\xff" * 4 + bytes(whole[-6:])
            )
        )


@hypothesis.settings(max_examples=50)
@hypothesis.given(st.data())
def test_a_damaged_archive_is_the_same_or_refused(data):
    whole = archive_of(
        {"a": b"some content", "b": b"other content" * 9}, compression=zipfile.ZIP_DEFLATED
    )
    damaged = damaged_by(data, whole)
    try:
        with open_archive(io.BytesIO(damaged)) as archive:
            found = {name: archive.read(name) for name in archive.namelist()}
    except (
        ValueError,
        RuntimeError,
        EOFError,
        NotImplementedError,
        OSError,
        zipfile.BadZipFile,
        zipfile.zlib.error,
    ):
        return
    assert set(found.values()) <= {b"some content", b"other content" * 9}


def damaged_by(data: st.DataObject, whole: bytes) -> bytes:
    """Bytes with a few others in their place, or without a part."""
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    begin, length = data.draw(st.integers(0, len(damaged))), data.draw(st.integers(0, 30))
    return bytes(damaged[:begin] + damaged[begin + length :])


def test_a_name_that_is_too_long_or_a_pipe_is_no_place_for_a_result(tmp_path: Path, pipe: Path):
    for path, reason in (
        (tmp_path / ("x" * 300), "too long"),
        (pipe, "a pipe or a device"),
        (Path("/dev/null"), "a pipe or a device"),
    ):
        with pytest.raises(ConfigurationError, match=f"cannot write .*{reason}"):
            require_writable(path)
    # The temporary file beside it has a name of its own.
    longest = tmp_path / f"{'x' * 250}.json"
    write_json(longest, [1])
    assert re.sub(r"\s", "", longest.read_text()) == "[1]"


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("before", [None, "old"])
def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path, error, before):
    path = tmp_path / "out.json"
    if before:
        path.write_text(before)

    def half(part: Path) -> None:
        part.write_text("half")
        raise error

    with pytest.raises(error):
        write_atomically(path, half)
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, [math.nan])
    assert [p.read_text() for p in tmp_path.iterdir()] == ([before] if before else [])
    write_json(path, [1])
    assert read_json(path, "") == [1]
    assert [p.name for p in tmp_path.iterdir()] == ["out.json"]


def test_places_that_cannot_be_written_are_named(tmp_path: Path):
    (tmp_path / "plain").touch()
    for name in (".", "no/file.json", "plain/file.json", "plain/no/file.json"):
        for write in (require_writable, lambda path: write_json(path, [])):
            with pytest.raises(ConfigurationError, match="cannot write"):
                write(tmp_path / name)
    assert [p.name for p in tmp_path.iterdir()] == ["plain"]


# --- locks ----------------------------------------------------------------------------------------


def test_a_lock_is_held_by_one_at_a_time_and_removed_with_its_end(tmp_path: Path):
    path = tmp_path / ".lock"
    for _ in range(2):
        with contextlib.suppress(RuntimeError), locked(path, "taken"):
            for _ in range(2):  # Who asked in vain has taken nothing away.
                with pytest.raises(ConfigurationError, match="taken"), locked(path, "taken"):
                    pass
            raise RuntimeError
        assert not path.exists()


def test_a_folder_that_takes_no_files_is_named(tmp_path: Path):
    (tmp_path / "file").touch()
    lock = locked(tmp_path / "file" / ".lock", "taken")
    with pytest.raises(ConfigurationError, match="cannot write"), lock:
        pass


def test_who_waits_gets_a_lock_in_the_end_and_nobody_with_them(tmp_path: Path, monkeypatch):
    """Each holder removes the file that others have opened already, or make again."""
    monkeypatch.setattr(files, "_PAUSE", 0.001)
    inside, overlaps, waits = [], [], []

    def work() -> None:
        for _ in range(8):
            with locked(tmp_path / ".lock", "taken", lambda: waits.append(1)):
                inside.append(1)
                time.sleep(0.001)
                overlaps.append(len(inside) > 1)
                inside.pop()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(overlaps) == 32
    assert waits
    assert not any(overlaps)
    assert not list(tmp_path.iterdir())


# --- the user's cache -----------------------------------------------------------------------------


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
    if sys.platform == "linux":
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
