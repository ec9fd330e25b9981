from __future__ import annotations

from importlib import metadata
from pathlib import Path

import pytest

import safe_envs
from safe_envs.agents.jobs import store
from safe_envs.agents.jobs.store import json_checksum, package_versions, source_checksum


def test_the_checksum_changes_with_each_byte_and_name_of_the_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(store, "files", lambda package: tmp_path / package)
    (tmp_path / "safe_envs" / "scripts").mkdir(parents=True)
    file = tmp_path / "safe_envs" / "code.py"

    def checksums() -> tuple[str, str]:
        compute = source_checksum.__wrapped__
        return compute(), compute(scripts=False)

    file.write_text("a = 1")
    first = checksums()
    assert checksums() == first
    file.write_text("a = 2")
    second = checksums()
    file.rename(file.with_name("other.py"))
    third = checksums()
    assert len({*first, *second, *third}) == 3
    # Evaluations do not depend on the commands.
    (tmp_path / "safe_envs" / "scripts" / "command.py").write_text("b = 1")
    assert checksums()[0] != third[0]
    assert checksums()[1] == third[1]


def test_the_order_of_names_changes_no_checksum():
    assert json_checksum({"a": 1, "b": [2]}) == json_checksum({"b": [2], "a": 1})
    assert json_checksum({"a": 1}) != json_checksum({"a": 1.5})


def test_versions_are_those_of_all_that_results_depend_on():
    found = package_versions()
    assert {"python", "numpy", "safe-envs", "torch"} <= set(found)
    found.clear()
    assert package_versions()


def test_a_folder_that_is_only_on_the_path_has_no_version(monkeypatch: pytest.MonkeyPatch):
    def version(package: str) -> str:
        raise metadata.PackageNotFoundError(package)

    monkeypatch.setattr(metadata, "version", version)
    assert store._versions.__wrapped__()["safe-envs"] == safe_envs.__version__ == "0+unknown"
