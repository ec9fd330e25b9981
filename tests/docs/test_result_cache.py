"""What the site reuses from one build to the next."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from safe_envs.files import VARIABLE, cache_folder

HOOKS = Path(__file__).parents[2] / "docs" / "hooks"


@pytest.fixture
def hook(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The module, with a folder and a project of its own."""
    monkeypatch.syspath_prepend(HOOKS)
    module = import_module("result_cache")
    monkeypatch.setattr(module, "FOLDER", tmp_path / "results")
    monkeypatch.setattr(module, "_used", set())
    of_code(module, monkeypatch, "first")
    return module


def of_code(module: Any, monkeypatch: pytest.MonkeyPatch, start: str, now: str = "") -> None:
    """Let the code have been one at the start of the build, and be another one now."""
    monkeypatch.setattr(module, "_checksum_at_start", lambda: start)
    monkeypatch.setattr(module, "code_checksum", lambda: now or start)


def fail() -> Any:
    raise AssertionError("it was computed again")


def test_a_result_is_computed_once_for_an_example_and_its_code(
    hook: Any, monkeypatch: pytest.MonkeyPatch
):
    found = {"page.md": "text", "picture.png": b"\x89PNG\xff", "each": [["one", "two"]]}
    assert hook.cached(["python", "1"], lambda: found) == found
    assert hook.cached(["python", "1"], fail) == found
    assert hook.cached(["python", "2"], lambda: "other") == "other"
    of_code(hook, monkeypatch, "second")
    assert hook.cached(["python", "1"], lambda: "after the change") == "after the change"
    monkeypatch.setattr(hook, "_packages", lambda: ["numpy 99"])
    assert hook.cached(["python", "1"], lambda: "after an upgrade") == "after an upgrade"


def test_a_result_of_code_that_was_edited_meanwhile_is_not_reused(
    hook: Any, monkeypatch: pytest.MonkeyPatch
):
    of_code(hook, monkeypatch, "first", now="second")
    assert hook.cached("example", lambda: 1) == 1
    assert hook.cached("example", lambda: 2) == 2


def test_a_file_that_cannot_be_read_is_replaced(hook: Any):
    hook.cached("example", lambda: 1)
    (path,) = hook.FOLDER.iterdir()
    path.write_text("{")
    assert hook.cached("example", lambda: 2) == 2
    assert hook.cached("example", fail) == 2


def test_examples_see_no_tables_of_the_user(
    hook: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "user"))
    for name in ("values", "compiled"):
        folder = cache_folder(name)
        assert folder is not None
        (folder / "entry").write_text("of the user")

    def names() -> list[str]:
        folders = [cache_folder(name) for name in ("values", "compiled")]
        return [path.name for folder in folders if folder for path in folder.iterdir()]

    assert hook.cached("names", names) == ["entry"]  # That of the compiled programs.
    assert os.environ[VARIABLE] == str(tmp_path / "user")
    monkeypatch.setenv(VARIABLE, "")
    assert hook.cached("names without a cache", names) == []


def test_what_a_build_did_not_ask_for_is_forgotten(hook: Any, monkeypatch: pytest.MonkeyPatch):
    hook.cached("old", lambda: 1)
    monkeypatch.setattr(hook, "_used", set())
    hook.cached("new", lambda: 2)
    hook.forget_unused()
    assert hook.cached("new", fail) == 2
    assert hook.cached("old", lambda: 3) == 3


def test_checksum_is_of_code_examples_and_hooks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.syspath_prepend(HOOKS)
    module = import_module("result_cache")
    monkeypatch.setattr(module, "ROOT", tmp_path)
    for folder in ("examples", "docs/hooks"):
        (tmp_path / folder).mkdir(parents=True)
        before = module.code_checksum()
        (tmp_path / folder / "new.py").write_text("x = 1\n")
        after = module.code_checksum()
        assert after != before
        (tmp_path / folder / "new.py").write_text("x = 2\n")
        assert module.code_checksum() not in (before, after)
    cache = tmp_path / "examples" / "__pycache__"
    cache.mkdir()
    before = module.code_checksum()
    (cache / "new.pyc").write_text("compiled")
    assert module.code_checksum() == before


def test_checksum_is_of_the_package_that_is_imported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.syspath_prepend(HOOKS)
    module = import_module("result_cache")
    there = module.find_spec("safe_envs")
    package = tmp_path / "safe_envs"
    package.mkdir()
    before = module.code_checksum()
    monkeypatch.setattr(there, "submodule_search_locations", [str(package)])
    monkeypatch.setattr(module, "find_spec", lambda name: there)
    (package / "data.yml").write_text("a: 1\n")
    one = module.code_checksum()
    (package / "data.yml").write_text("a: 2\n")
    assert len({before, one, module.code_checksum()}) == 3
