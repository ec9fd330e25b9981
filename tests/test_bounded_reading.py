"""Files of others: nothing but regular ones is read, and nothing large is unpacked before its size
is known."""

from __future__ import annotations

import io
import os
import re
import struct
import zipfile
from pathlib import Path

import hypothesis
import hypothesis.strategies as st
import pytest

from safe_envs.errors import ConfigurationError
from safe_envs.files import open_archive, read_bytes, read_json, require_writable, write_json


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
