"""Results in files: of one configuration, whole or not at all, and never altered unnoticed."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safe_envs.agents.jobs import store as store_module
from safe_envs.agents.jobs.store import (
    ResultStore,
    json_checksum,
    package_versions,
    source_checksum,
)
from safe_envs.errors import ConfigurationError
from tests.oracles.full_disk import no_file_larger_than

OPTIONS = {"options": {"seed": 3}, "source": "a1"}
CONTENT = {"numbers": [1.5, 0.1 + 0.2, None], "text": "ü"}


@pytest.fixture
def store(tmp_path: Path) -> ResultStore:
    found = ResultStore(tmp_path / "a" / "b")
    found.keep("one", OPTIONS, CONTENT)
    return found


def test_a_result_is_read_for_an_equal_configuration_only(store: ResultStore):
    assert store.read("one", OPTIONS) == {"configuration": OPTIONS, **CONTENT}
    assert store.read("one", {**OPTIONS, "source": "b2"}) is None
    assert store.read("two", OPTIONS) is None
    document = json.loads(store.path("one").read_text())
    assert set(document) == {"configuration", "numbers", "text", "sha256"}
    store.require_same_options(["one", "two"], {"seed": 3})
    with pytest.raises(ConfigurationError, match=r'one by other options: {"seed": 3}'):
        store.require_same_options(["two", "one"], {"seed": 4})


@given(data=st.data())
@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_character_that_was_changed_is_noticed(data: Any, store: ResultStore):
    path = store.path("one")
    content = path.read_text()
    try:
        place = data.draw(st.sampled_from([k for k, c in enumerate(content) if c.isalnum()]))
        new = data.draw(st.sampled_from([c for c in "09afz" if c != content[place]]))
        path.write_text(content[:place] + new + content[place + 1 :])
        with pytest.raises(ConfigurationError, match="damaged or altered"):
            store.document("one")
    finally:
        path.write_text(content)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[1]", "[" * 20_000, "null", "{}", '{"configuration": {}, "x": NaN, "sha256": ""}'],
)
def test_what_is_no_result_is_refused(text: str, store: ResultStore):
    store.path("one").write_text(text)
    with pytest.raises(ConfigurationError, match=r"one\.json"):
        store.read("one", OPTIONS)


def test_pipes_and_large_files_are_refused(store: ResultStore, monkeypatch: pytest.MonkeyPatch):
    os.mkfifo(store.path("pipe"))
    with pytest.raises(ConfigurationError, match="pipe"):
        store.document("pipe")
    monkeypatch.setattr(store_module, "MOST_BYTES", 10)
    with pytest.raises(ConfigurationError, match="larger"):
        store.document("one")


def test_what_cannot_be_written_leaves_what_was_there(store: ResultStore, tmp_path: Path):
    with no_file_larger_than(20), pytest.raises(ConfigurationError, match=r"one\.json"):
        store.keep("one", OPTIONS, {"numbers": [2.0]})
    with pytest.raises(ValueError, match="Out of range float"):
        store.keep("two", OPTIONS, {"x": float("nan")})
    assert store.read("one", OPTIONS) == {"configuration": OPTIONS, **CONTENT}
    assert [path.name for path in store.path("one").parent.iterdir()] == ["one.json"]
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="file"):
        ResultStore(tmp_path / "file")


def test_the_checksum_changes_with_each_byte_and_name_of_the_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(store_module, "files", lambda package: tmp_path / package)
    (tmp_path / "safe_envs" / "scripts").mkdir(parents=True)
    file = tmp_path / "safe_envs" / "code.py"

    def checksums() -> tuple[str, str]:
        source_checksum.cache_clear()
        return source_checksum(), source_checksum(scripts=False)

    try:
        file.write_text("a = 1")
        found = [checksums()]
        assert checksums() == found[0]
        file.write_text("a = 2")
        found.append(checksums())
        found.append((file.rename(file.with_name("other.py")), checksums())[1])
        assert len({each for pair in found for each in pair}) == 3
        # Evaluations do not depend on the commands.
        (tmp_path / "safe_envs" / "scripts" / "command.py").write_text("b = 1")
        assert [a == b for a, b in zip(checksums(), found[-1], strict=True)] == [False, True]
    finally:
        source_checksum.cache_clear()


def test_checksums_and_versions_are_of_all_that_results_depend_on():
    assert json_checksum({"a": 1, "b": [2]}) == json_checksum({"b": [2], "a": 1})
    assert json_checksum({"a": 1}) != json_checksum({"a": 1.5})
    found = package_versions()
    assert {"python", "numpy", "safe-envs", "torch"} <= set(found)
    found.clear()
    assert package_versions()
