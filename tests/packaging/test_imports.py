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
assert not loaded(*LIBRARIES, "numpy", "gymnasium", "rich", "safe_envs.agents"), "completion"
cli.app(["--help"], standalone_mode=False)
assert not loaded(*LIBRARIES, "numpy", "gymnasium", "rich", "safe_envs.agents"), "help"
for command in ("evaluate", "verify", "identify", "train"):
    cli.app([command, "--help"], standalone_mode=False)
assert not loaded("safe_envs.agents", "torch", "matplotlib", "pygame"), "help of a command"

import safe_envs.agents

HEAVY = ("torch", "stable_baselines3", "matplotlib", "proxsuite", "pygame")
assert not loaded(*HEAVY), "the packages"

from safe_envs.wrappers import SafetyFilter
import sympy as sp

x, y, u = sp.symbols("x y u", real=True)
system = safe_envs.ControlAffineSDE([x, y], [u], [-x, -y], [1, 1])
one = SafetyFilter(system, [1 - x, 1 + x, 2 - y], "cbf:alpha=0.5", (-1, 1)).filter([0.9, 0], [1.0])
assert one.feasible and one.active[0]
assert not loaded("numba", "qpsolvers", "daqp", *HEAVY), "several constraints on one input"

import gymnasium as gym
from safe_envs import SafeEnv

env = SafeEnv(gym.make("safe_envs/Scalar-v0").unwrapped.problem, render_mode="rgb_array")
env.reset(seed=0)
assert not loaded("pygame", "torch", "matplotlib"), "an env that draws nothing yet"
env.render()
assert loaded("pygame")
"""


ORDERS = {
    "the package first": "import safe_envs; import gymnasium as gym",
    "Gymnasium first": "import gymnasium as gym; import safe_envs",
    "only what needs Gymnasium": "from safe_envs import SafeEnv; import gymnasium as gym",
    "the package, forgotten and imported again": (
        "import sys, safe_envs, importlib.util; importlib.util.find_spec('gymnasium')\n"
        "for n in [n for n in sys.modules if n.startswith('safe_envs')]: del sys.modules[n]\n"
        "import safe_envs; import gymnasium as gym"
    ),
    "by Gymnasium itself": "import gymnasium as gym; gym.make('safe_envs:safe_envs/Scalar-v0')",
}
REGISTERED = """
import sys
ids = [name for name in gym.registry if name.startswith("safe_envs/")]
assert len(ids) == {count}, ids  # One more than those of systems: that of any system.
assert gym.make("safe_envs/Scalar-v0").reset(seed=0)
assert type(gym.__loader__) is type(gym.spaces.__loader__)
assert not [f for f in sys.meta_path if type(f).__module__.startswith("safe_envs")]
"""


def finished(code: str, *flags: str) -> str:
    """Run a fresh process; return what it printed."""
    done = subprocess.run(
        [sys.executable, "-W", "error", *flags, "-c", code],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_nothing_is_imported_before_it_is_needed():
    assert finished(STAGES).count("Usage: ") == 5


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS.keys())
def test_every_id_is_there_in_every_order(order: str):
    finished(order + REGISTERED.format(count=len(safe_envs.ENV_IDS) + 1))


def test_what_a_package_has_can_be_used_as_its_attribute():
    code = """
import safe_envs, safe_envs.wrappers
safe_envs.envs, safe_envs.agents, safe_envs.filters.conditions
for name in ("no_such", "__wrapped__"):
    assert not hasattr(safe_envs, name)
"""
    finished(code)
    assert {"__version__", "SafetyFilter", "ENV_IDS"} <= set(dir(safe_envs))
    assert all(hasattr(safe_envs, name) for name in dir(safe_envs))


def test_a_folder_on_the_path_will_do_without_an_installation(tmp_path: Path):
    # Without the packages of the environment and the checkout there is no metadata of this one.
    (tmp_path / "safe_envs").symlink_to(Path(safe_envs.__file__).parent)
    code = f"""
import sys
sys.path[:0] = [{str(tmp_path)!r}]
import safe_envs
assert safe_envs.__version__ == "0+unknown", safe_envs.__version__
assert safe_envs.ENV_IDS
"""
    finished(code, "-I", "-S")


def test_the_package_works_from_a_zip_file(tmp_path: Path):
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
    assert "safe_envs/Scalar-v0" in finished(code)
