"""Only `safe_envs` is installed; the links at the top level of a checkout are short cuts."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
LINKS = ("wrappers", "agents", "scripts")


def run(folder: Path, *arguments: str, path: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def tracked(*patterns: str) -> list[str]:
    """Return the lines "MODE HASH STAGE\tPATH" of tracked files."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a git checkout")
    answer = subprocess.run(
        ["git", "ls-files", "-s", *patterns], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return answer.stdout.splitlines()


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Make a user's project with folders of the same names, and `safe_envs` as it is installed."""
    for name in LINKS:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("mine = True\n")
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "safe_envs").symlink_to(ROOT / "safe_envs", target_is_directory=True)
    return tmp_path


def test_a_project_with_folders_of_the_same_names_imports_and_runs_the_command(project: Path):
    path = os.pathsep.join([".", "site"])
    code = """
import agents, scripts, wrappers
import safe_envs.agents, safe_envs.scripts.cli, safe_envs.wrappers
assert wrappers.mine and agents.mine and scripts.mine
assert "site" in safe_envs.wrappers.SafetyFilterWrapper.__init__.__code__.co_filename
import runpy, sys
sys.argv[1:] = ["evaluate", "Scalar-v0", "--episodes", "5"]
runpy.run_module("safe_envs", run_name="__main__")
"""
    assert "safe_envs/Scalar-v0" in run(project, "-c", code, path=path)


def test_links_give_the_same_objects_as_the_package(tmp_path: Path):
    code = """
import importlib, inspect, pickle
from wrappers import CBF, SafetyMonitor
from wrappers.monitor import SafetyMonitor as of_submodule
import wrappers.monitor, agents.evaluation.statistics, scripts.cli
import safe_envs.wrappers, safe_envs.agents.evaluation.statistics, safe_envs.scripts.cli

assert CBF is safe_envs.wrappers.CBF
assert SafetyMonitor is of_submodule is safe_envs.wrappers.SafetyMonitor
assert wrappers is safe_envs.wrappers
assert agents.evaluation.statistics is safe_envs.agents.evaluation.statistics
assert scripts.cli is safe_envs.scripts.cli
assert pickle.loads(pickle.dumps(CBF(2.0))) == CBF(2.0)
for module in (wrappers, wrappers.monitor, agents.evaluation.statistics):
    name = module.__name__
    assert name.startswith("safe_envs.")
    assert module.__spec__.name == name
    assert module.__spec__.loader is module.__loader__
    assert inspect.getsource(module)
    assert importlib.reload(module) is module
try:
    import wrappers.no_such_module
except ModuleNotFoundError as error:
    assert error.name == "safe_envs.wrappers.no_such_module"
else:
    raise AssertionError
"""
    run(tmp_path, "-c", code, path=str(ROOT))


@pytest.mark.parametrize(
    ("script", "shown"),
    [(["scripts/evaluate.py", "--help"], "Usage"), (["-m", "scripts.listing"], "Scalar-v0")],
)
def test_a_command_runs_as_a_script_of_the_checkout(script: list[str], shown: str):
    assert shown in run(ROOT, *script, path=str(ROOT))


@pytest.mark.parametrize("name", LINKS)
def test_links_are_relative_and_tracked_as_links(name: str):
    (line,) = tracked(name)
    assert line.startswith("120000 ")
    assert os.readlink(ROOT / name) == f"safe_envs/{name}"


def test_a_clone_without_links_works(tmp_path: Path):
    tracked()
    clone = tmp_path / "clone"
    subprocess.run(
        ["git", "clone", "--quiet", "-c", "core.symlinks=false", str(ROOT), str(clone)],
        check=True,
        timeout=60,
    )
    assert not (clone / "wrappers").is_symlink()
    code = """
import runpy, sys
import safe_envs.wrappers
print(safe_envs.wrappers.__file__)
sys.argv[1:] = ["list"]
runpy.run_module("safe_envs", run_name="__main__")
"""
    answer = run(clone, "-c", code, path=str(clone))
    assert answer.startswith(str(clone))
    assert "Scalar-v0" in answer


def test_packages_and_data_of_the_wheel_are_complete():
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert setuptools["packages"]["find"]["include"] == ["safe_envs*"]
    data = {
        found
        for package, patterns in setuptools["package-data"].items()
        for pattern in patterns
        for found in (ROOT / package.replace(".", "/")).glob(pattern)
    }
    for line in tracked("safe_envs"):
        path = ROOT / line.split("\t")[1]
        if path.suffix == ".py":
            assert (path.parent / "__init__.py").is_file(), f"{path} is in no package"
        else:
            assert path in data, f"{path} is in no pattern of package-data"
