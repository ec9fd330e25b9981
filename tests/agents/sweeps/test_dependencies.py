"""What the result of a cell hangs on: settings, versions, and the files that it reads."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from safe_envs.agents.jobs.job import outcome_of
from safe_envs.agents.sweeps.spec import Cell, sweep_of
from safe_envs.errors import ConfigurationError

FILES = {
    "mine.py": (
        "import os, numpy as np, near.inner\nfrom other import x\nfrom bare import part\n"
        "def problem():\n    import late, broken"
    ),
    "near/__init__.py": "from . import beside",
    "near/beside.py": "from .deep.end import y",
    "near/inner.py": "",
    "near/deep/__init__.py": "",
    "near/deep/end.py": "from ..inner import z\nimport near",
    "other.py": "import mine\nx = '\\d'",
    "bare/part.py": "",
    "late.py": "",
    "broken.py": "(",
}
UNUSED = dict.fromkeys(["unused.py", "near/unused.py", "numpy/unused.py"], "")
SMALL: dict[str, Any] = {"env": "Scalar-v0", "filter": "none", "episodes": 2, "horizon": 0.02}


def cell_of(fixed: dict[str, Any]) -> Cell:
    (cell,) = sweep_of({"fixed": fixed}).cells
    return cell


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in (FILES | UNUSED).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_cell_is_known_by_its_settings_and_versions():
    cell = cell_of(SMALL)
    assert cell.key == cell_of(dict(reversed(SMALL.items()))).key
    assert cell.key == replace(cell, engine="numpy").key
    assert cell.key != cell_of({**SMALL, "seed": 1}).key
    other = replace(cell, versions={**cell.versions, "numpy": "0"})
    assert cell.key != other.key
    # A worker with other versions computes nothing.
    assert "numpy" in str(outcome_of(other).error)
    assert outcome_of(cell).error is None


def test_what_a_system_imports_from_its_folder_counts_without_running_it(folder: Path):
    cell = cell_of({"system": "mine.py:problem", "filter": "scbf"})
    assert cell.settings["system"] == f"{folder / 'mine.py'}:problem"
    assert set(cell.files) == {str(folder / name) for name in FILES}
    end = folder / "near" / "deep" / "end.py"
    end.write_text("y = 2")
    assert cell_of({"system": "mine.py:problem", "filter": "scbf"}).key != cell.key
    # Nor does a worker with other files compute anything.
    for damage in (lambda: None, end.unlink):
        damage()
        assert str(end) in str(outcome_of(cell).error)


def test_paths_mean_the_same_in_every_process(folder: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("a.npz", "near/b.npz", "ppo/policy.npz"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()
    text = "ddscbf:file={}+bayesian-scbf:file={}:delta=0.1+scbf+{}:Eager:gain=2"
    near, far = [
        text.format(*(f"{place}{name}" for name in ("a.npz", "near/b.npz", "other.py")))
        for place in ("", f"{folder}/")
    ]
    cell = cell_of({"env": "Scalar-v0", "filter": near, "policy": "ppo"})
    assert (cell.settings["filter"], cell.settings["policy"]) == (far, str(folder / "ppo"))
    read = ["a.npz", "near/b.npz", "ppo/policy.npz", *FILES.keys() - {"near/unused.py"}]
    assert set(cell.files) == {str(folder / name) for name in read}
    own = cell_of({**SMALL, "policy": "other.py:x"})
    assert own.settings["policy"] == f"{folder / 'other.py'}:x"
    assert str(folder / "other.py") in own.files
    monkeypatch.chdir("/")
    assert cell_of({"env": "Scalar-v0", "filter": far, "policy": str(folder / "ppo")}) == cell


def test_the_code_of_installed_conditions_and_policies_counts(tmp_path: Path, monkeypatch):
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "__init__.py").write_text("")
    code, alone = tmp_path / "my_package" / "inner.py", tmp_path / "my_policies.py"
    code.write_text("from safe_envs.wrappers import CBF as Mine")
    alone.write_text("import numpy\n\n\ndef still(x):\n    return 0 * x")
    meta = tmp_path / "mine-1.0.dist-info"
    meta.mkdir()
    (meta / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (meta / "entry_points.txt").write_text("[safe_envs.conditions]\nmine = my_package.inner:Mine\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    fixed = {"env": "Scalar-v0", "policy": "my_policies:still"}
    for text in ("mine:alpha=2", "my_package.inner:Mine:alpha=2"):
        cell = cell_of({**fixed, "filter": text})
        assert set(cell.files) == {str(code), str(code.parent / "__init__.py"), str(alone)}
    keys = {cell.key}
    for file in (code, alone):
        file.write_text(file.read_text() + "\n")
        keys.add(cell_of({**fixed, "filter": text}).key)
    assert len(keys) == 3
    assert not cell_of({"env": "Scalar-v0", "filter": "safe_envs.wrappers:CBF"}).files


@pytest.mark.parametrize(
    "fixed",
    [
        {"env": "Scalar-v0", "filter": "ddscbf:file=pipe.py"},
        {"env": "Scalar-v0", "filter": "none", "policy": "pipe.py"},
        {"system": "pipe.py:problem", "filter": "none"},
    ],
)
def test_files_that_a_sweep_reads_are_regular_ones(fixed, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe.py")
    with pytest.raises(ConfigurationError, match="pipe or a device"):
        sweep_of({"fixed": fixed})
