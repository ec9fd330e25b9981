"""A lock is held by one at a time, and by nobody who has ended."""

from __future__ import annotations

import pytest

from safe_envs import ConfigurationError, files
from safe_envs.files import locked


def test_one_at_a_time(tmp_path):
    path = tmp_path / ".lock"
    for _ in range(2):
        with locked(path, "taken"):
            with pytest.raises(ConfigurationError, match="taken"), locked(path, "taken"):
                pass
            # Who asked in vain has taken nothing away.
            with pytest.raises(ConfigurationError, match="taken"), locked(path, "taken"):
                pass
        assert not path.exists()


def test_an_error_releases_it(tmp_path):
    with pytest.raises(RuntimeError), locked(tmp_path / ".lock", "taken"):
        raise RuntimeError
    with locked(tmp_path / ".lock", "taken"):
        pass


def test_a_file_that_the_holder_removed_meanwhile_locks_nobody_out(tmp_path, monkeypatch):
    """Between the opening of the file and its lock, who had it may end, and a third may make
    another file."""
    path, lock, calls = tmp_path / ".lock", files._lock, []

    def late(file):
        if not calls:
            path.unlink()
        calls.append(file)
        lock(file)

    monkeypatch.setattr(files, "_lock", late)
    with locked(path, "taken"):
        assert len(calls) == 2
        with pytest.raises(ConfigurationError, match="taken"), locked(path, "taken"):
            pass


def test_a_folder_that_takes_no_files_is_named(tmp_path):
    (tmp_path / "file").touch()
    with (
        pytest.raises(ConfigurationError, match="cannot write"),
        locked(tmp_path / "file" / ".lock", "taken"),
    ):
        pass


def test_who_waits_gets_the_lock_in_the_end(tmp_path, monkeypatch):
    path, events = tmp_path / ".lock", []
    holder = locked(path, "taken")
    holder.__enter__()

    def released(_):
        events.append("slept")
        holder.__exit__(None, None, None)

    monkeypatch.setattr(files.time, "sleep", released)
    with locked(path, "taken", lambda: events.append("told")):
        assert events == ["told", "slept"]
        with pytest.raises(ConfigurationError, match="taken"), locked(path, "taken"):
            pass
    assert not path.exists()
