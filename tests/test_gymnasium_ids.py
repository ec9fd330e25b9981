"""The ids are registered in whatever order this package and Gymnasium are imported."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import safe_envs
from safe_envs import gymnasium_ids

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]

ORDERS = {
    "the package first": "import safe_envs; import gymnasium as gym",
    "Gymnasium first": "import gymnasium as gym; import safe_envs",
    "a module of Gymnasium first": "import gymnasium.envs, safe_envs, gymnasium as gym",
    "the package, then a module of Gymnasium": (
        "import safe_envs; import gymnasium.envs; import gymnasium as gym"
    ),
    "only what needs Gymnasium": "from safe_envs import SafeEnv; import gymnasium as gym",
    "a module of the envs": "import safe_envs.envs.spec; import gymnasium as gym",
    "the package twice": (
        "import importlib, safe_envs; importlib.reload(safe_envs); import gymnasium as gym"
    ),
    "the package, forgotten and imported anew": (
        "import sys, safe_envs\n"
        "for n in [n for n in sys.modules if n.startswith('safe_envs')]: del sys.modules[n]\n"
        "import safe_envs; import gymnasium as gym"
    ),
    "by Gymnasium itself": "import gymnasium as gym; gym.make('safe_envs:safe_envs/Scalar-v0')",
}

WORK = """
{order}
import contextlib, io, sys
ids = [name for name in gym.registry if name.startswith("safe_envs/")]
assert len(ids) == {count}, ids
assert gym.make("safe_envs/Scalar-v0").reset(seed=0)
assert gym.make_vec("safe_envs/Scalar-v0", 2).num_envs == 2
assert gym.spec("safe_envs/Scalar-v0").max_episode_steps == 500
with contextlib.redirect_stdout(io.StringIO()) as printed:
    gym.pprint_registry()
assert "Scalar-v0" in printed.getvalue()
assert type(gym.__loader__) is type(gym.spaces.__loader__)
assert gym.__spec__.loader is gym.__loader__
assert not [f for f in sys.meta_path if type(f).__module__.startswith("safe_envs")]
"""


def finished(code, *flags):
    done = subprocess.run(
        [sys.executable, "-W", "error", *flags, "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    return done.returncode, done.stderr


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS.keys())
def test_every_id_is_there_in_every_order(order):
    # The id for any system is one more than those of systems.
    code = WORK.format(order=order, count=len(safe_envs.ENV_IDS) + 1)
    assert finished(code) == (0, "")


def test_the_package_alone_imports_neither_gymnasium_nor_numpy():
    code = """
import sys, safe_envs
safe_envs.ENV_IDS, safe_envs.ConfigurationError
assert not {"gymnasium", "numpy", "sympy", "importlib.metadata"} & set(sys.modules)
"""
    assert finished(code) == (0, "")


def test_a_folder_on_the_path_will_do_without_an_installation(tmp_path):
    # Without the packages of the environment and the checkout there is no metadata of this one.
    (tmp_path / "safe_envs").symlink_to(ROOT / "safe_envs")
    code = f"""
import sys
sys.path[:0] = [{str(tmp_path)!r}]
import safe_envs
assert safe_envs.__version__ == "0+unknown", safe_envs.__version__
assert safe_envs.ENV_IDS
"""
    assert finished(code, "-I", "-S") == (0, "")


def test_gymnasium_that_fails_to_import_leaves_the_finder_for_the_next_time(tmp_path):
    (tmp_path / "gymnasium.py").write_text("raise ImportError('broken')")
    code = f"""
import sys, safe_envs
sys.path.insert(0, {str(tmp_path)!r})
try:
    import gymnasium
except ImportError as error:
    assert str(error) == "broken"
sys.path.remove({str(tmp_path)!r})
import gymnasium as gym
assert "safe_envs/Scalar-v0" in gym.registry
"""
    assert finished(code) == (0, "")


def test_what_finds_gymnasium_can_be_copied():
    code = """
import copy, importlib.util, pickle, safe_envs
found = importlib.util.find_spec("gymnasium")
assert copy.deepcopy(found).origin == found.origin
assert pickle.loads(pickle.dumps(found)).origin == found.origin
"""
    assert finished(code) == (0, "")


def test_whoever_looks_for_gymnasium_finds_its_own_file(monkeypatch):
    monkeypatch.delitem(sys.modules, "gymnasium")
    finder = gymnasium_ids._GymnasiumFinder()
    monkeypatch.setattr(sys, "meta_path", [finder, *sys.meta_path])
    found = find_spec("gymnasium")
    assert found is not None
    assert found.origin
    assert found.origin.endswith("__init__.py")
    assert found.loader.get_filename() == found.origin
    assert finder.find_spec("numpy", None) is None
