from __future__ import annotations

from pathlib import Path

import pytest

from safe_envs.agents.jobs.job import outcome_of
from safe_envs.agents.sweeps.spec import absolute, read_by, sweep_of, with_imported

FILES = {
    "mine.py": (
        "import os, numpy as np, near.inner\nfrom other import x\nfrom bare import part\ndef"
        " problem():\n    import late, broken"
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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in {
        **FILES,
        "unused.py": "",
        "near/unused.py": "",
        "numpy/unused.py": "",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_what_a_file_imports_from_its_folder_is_found_without_running_it(folder: Path):
    found = with_imported(folder / "mine.py")
    assert sorted(str(path.relative_to(folder)) for path in found) == sorted(FILES)
    assert with_imported(folder / "none.py") == [folder / "none.py"]


def test_paths_mean_the_same_in_every_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "ppo").mkdir()
    monkeypatch.chdir(tmp_path)
    given = {
        "filter": "ddscbf:file=a.npz+bayesian-scbf:file=in/b.npz:delta=0.1",
        "policy": "ppo",
        "system": "mine.py:problem",
    }
    first, second = tmp_path / "a.npz", tmp_path / "in" / "b.npz"
    found = absolute({**given, "seed": 1})
    assert found == {
        "filter": f"ddscbf:file={first}+bayesian-scbf:file={second}:delta=0.1",
        "policy": str(tmp_path / "ppo"),
        "system": f"{tmp_path / 'mine.py'}:problem",
        "seed": 1,
    }
    monkeypatch.chdir("/")
    assert absolute(found) == found
    assert list(read_by({"filter": found["filter"], "policy": "nominal"})) == [first, second]
    assert absolute({"filter": "none", "policy": "nominal"}) == {
        "filter": "none",
        "policy": "nominal",
    }


def test_a_cell_is_known_by_what_its_system_imports(folder: Path):
    document = {"fixed": {"system": f"{folder / 'mine.py'}:problem", "filter": "scbf"}}
    (cell,) = sweep_of(document).cells
    (folder / "near" / "deep" / "end.py").write_text("y = 2")
    assert sweep_of(document).cells[0].key != cell.key
    assert "another content in" in str(outcome_of(cell).error)
    assert "end.py" in str(outcome_of(cell).error)


def test_a_condition_of_ones_own_is_a_file_of_the_cell(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = absolute({"filter": "scbf+mine.py:Eager:gain=2", "policy": "nominal"})
    assert settings["filter"] == f"scbf+{tmp_path / 'mine.py'}:Eager:gain=2"
    assert list(read_by(settings)) == [tmp_path / "mine.py"]


def test_the_code_of_installed_conditions_and_policies_counts(tmp_path: Path, monkeypatch):
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "__init__.py").write_text("")
    code = tmp_path / "my_package" / "inner.py"
    alone = tmp_path / "my_policies.py"
    code.write_text("from safe_envs.wrappers import CBF as Mine")
    alone.write_text("import numpy\n\n\ndef still(x):\n    return 0 * x")
    meta = tmp_path / "mine-1.0.dist-info"
    meta.mkdir()
    (meta / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (meta / "entry_points.txt").write_text("[safe_envs.conditions]\nmine = my_package.inner:Mine\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    fixed = {"env": "Scalar-v0", "policy": "my_policies:still"}
    for text in ("mine:alpha=2", "my_package.inner:Mine:alpha=2"):
        (cell,) = sweep_of({"fixed": {**fixed, "filter": text}}).cells
        assert set(cell.files) == {str(code), str(code.parent / "__init__.py"), str(alone)}
    keys = {cell.key}
    for file in (code, alone):
        file.write_text(file.read_text() + "\n")
        keys |= {each.key for each in sweep_of({"fixed": {**fixed, "filter": text}}).cells}
    assert len(keys) == 3
    names = {"fixed": {"env": "Scalar-v0", "filter": "safe_envs.wrappers:CBF"}}
    assert not sweep_of(names).cells[0].files
