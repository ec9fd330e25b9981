"""What is imported, and when: each stage of one fresh process has only what it needs."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import safe_envs

pytestmark = pytest.mark.slow

STAGES = """
import sys


def loaded(*names):
    return [name for name in names if name in sys.modules]


from safe_envs.scripts import cli

LIBRARIES = ("sympy", "scipy", "torch", "matplotlib", "pygame")
assert not loaded(*LIBRARIES, "safe_envs.agents"), "the command line, for completion"
for command in ("evaluate", "verify", "identify", "train", "render"):
    cli.app([command, "--help"], standalone_mode=False)
assert not loaded("safe_envs.agents", "torch", "matplotlib", "pygame"), "help"

import safe_envs.agents

HEAVY = ("torch", "stable_baselines3", "matplotlib", "proxsuite", "pygame")
assert not loaded(*HEAVY), "the packages"

from safe_envs.engine.qp import dispatch

box = ([0.0, 0.0], [-1.0, -1.0], [1.0, 1.0], [1.0, 1.0], [1.0, 1.0])
assert dispatch.project_floats([[1.0, 0.2], [-1.0, 0.1]], [-0.5, 0.9], *box)[3]
assert not loaded("scipy", "daqp", *HEAVY), "QPs of two inputs that can be met"
assert not dispatch.project_floats([[1.0, 0.2], [-1.0, 0.1]], [-0.5, 0.1], *box)[3]
assert not loaded("scipy", *HEAVY), "QPs of two inputs"
box = ([0.0] * 3, [-1.0] * 3, [1.0] * 3, [1.0] * 3, [1.0, 1.0])
rows = [[1.0, 0.2, 0.0], [0.3, 1.0, 0.1]]
assert dispatch.project_floats(rows, [-0.5, -0.5], *box)[2] == [True, True]
assert loaded("daqp")
assert not loaded("scipy", *HEAVY), "QPs of three inputs"
assert dispatch.project_floats(rows, [-0.5, -0.5], *box, "proxqp")[2] == [True, True]
assert loaded("proxsuite")

import gymnasium as gym
from safe_envs import SafeEnv

env = SafeEnv(gym.make("safe_envs/Scalar-v0").unwrapped.problem, render_mode="rgb_array")
env.reset(seed=0)
assert not loaded("pygame", "torch", "matplotlib"), "an env that draws nothing yet"
env.render()
assert loaded("pygame")
"""


def test_nothing_is_imported_before_it_is_needed():
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", STAGES],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("Usage: ") == 5


def test_what_a_package_has_can_be_used_as_its_attribute():
    code = """
import safe_envs, safe_envs.wrappers
safe_envs.envs, safe_envs.agents, safe_envs.filters.conditions
for name in ("no_such", "__wrapped__"):
    assert not hasattr(safe_envs, name)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_what_the_package_has_is_listed():
    assert {"__version__", "SafetyFilter", "ENV_IDS"} <= set(dir(safe_envs))
    assert all(hasattr(safe_envs, name) for name in dir(safe_envs))


def test_the_package_works_from_a_zip_file(tmp_path):
    source = Path(safe_envs.__file__).parent
    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        for path in (*source.rglob("*.py"), *source.rglob("*.json")):
            archive.write(path, path.relative_to(source.parent))
    code = f"""
import sys
sys.path.insert(0, {str(tmp_path / "all.zip")!r})
import safe_envs
assert "all.zip" in safe_envs.__file__
sys.argv = ["safe-envs", "list"]
from safe_envs.scripts.cli import main
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "safe_envs/Scalar-v0" in done.stdout
