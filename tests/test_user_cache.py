"""The folder of the cache is the user's alone, or there is none."""

from __future__ import annotations

import os
import stat

import pytest

from safe_envs import user_cache
from safe_envs.user_cache import VARIABLE, cache_folder


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
    monkeypatch.setattr(user_cache.sys, "platform", "linux")
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
