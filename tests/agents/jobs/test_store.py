from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safe_envs.agents.jobs import store as store_module
from safe_envs.agents.jobs.store import ResultStore
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


def test_results_of_other_options_are_not_overwritten(store: ResultStore):
    store.require_same_options(["one", "two"], {"seed": 3})
    with pytest.raises(ConfigurationError, match=r'holds one by other options: {"seed": 3}'):
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
    with pytest.raises(ConfigurationError, match=r"one\.json cannot be read"):
        store.read("one", OPTIONS)


def test_pipes_and_large_files_are_refused(store: ResultStore, monkeypatch: pytest.MonkeyPatch):
    os.mkfifo(store.path("pipe"))
    with pytest.raises(ConfigurationError, match="pipe or a device"):
        store.document("pipe")
    monkeypatch.setattr(store_module, "MOST_BYTES", 10)
    with pytest.raises(ConfigurationError, match="larger than"):
        store.document("one")


def test_a_full_disk_leaves_the_previous_result(store: ResultStore):
    with (
        no_file_larger_than(20),
        pytest.raises(ConfigurationError, match=r"one\.json: File too large"),
    ):
        store.keep("one", OPTIONS, {"numbers": [2.0]})
    assert store.read("one", OPTIONS) == {"configuration": OPTIONS, **CONTENT}
    assert [path.name for path in store.path("one").parent.iterdir()] == ["one.json"]


def test_data_that_is_no_json_leaves_nothing(store: ResultStore):
    with pytest.raises(ValueError, match="Out of range float"):
        store.keep("two", OPTIONS, {"x": float("nan")})
    assert not store.path("two").exists()


def test_a_folder_that_cannot_be(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="cannot be made"):
        ResultStore(tmp_path / "file")


def test_files_are_as_others_may_read_them(store: ResultStore):
    document = json.loads(store.path("one").read_text())
    assert set(document) == {"configuration", "numbers", "text", "sha256"}
