"""`safe-envs cache`."""

from __future__ import annotations

import pytest

from safe_envs.files import CONTENTS, VARIABLE, cache_folder, entries
from tests.scripts.conftest import strictly


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    for name in ("values", "closed-loops"):
        (cache_folder(name) / f"{'0' * 64}.npz").write_bytes(b"x" * 1500)
    (cache_folder("values") / "mine.npz").write_bytes(b"x")


def test_it_shows_what_is_kept_and_clears_it(cache, safe_envs_command):
    status, out, _ = safe_envs_command("cache --json cache.json")
    assert status == 0
    assert "In all 3 kB of at most 2 GB" in out
    found = strictly("cache.json")
    assert {each["name"]: each["entries"] for each in found["contents"]} == {
        name: int(name in ("values", "closed-loops")) for name in CONTENTS
    }
    assert (found["bytes"], found["removed_bytes"]) == (3000, None)
    status, out, _ = safe_envs_command("cache --clear")
    assert (status, "Removed: 3 kB." in out) == (0, True)
    assert not any(entries(name) for name in CONTENTS)
    assert (cache_folder("values") / "mine.npz").exists()


def test_without_a_cache_it_says_so(monkeypatch, safe_envs_command):
    monkeypatch.setenv(VARIABLE, "")
    status, out, _ = safe_envs_command("cache --clear")
    assert (status, "Nothing is kept" in out) == (0, True)
