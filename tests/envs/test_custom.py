"""User-defined systems behind `gym.make`: from a file, a module, and under an id of their own."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from gymnasium.utils.env_checker import check_env

import safe_envs
from safe_envs import ConfigurationError, SafetyProblem, SystemDefinitionError, define_problem
from safe_envs.envs.registered import Custom
from safe_envs.plugins import load_object
from safe_envs.problem.factory import load_system
from safe_envs.registry import make_problem
from safe_envs.systems import CUSTOM_ID

STATEMENT = """
import sympy as sp
from safe_envs import ControlAffineSDE, define_problem

x, u, s = sp.symbols("x u s", real=True)

def problem(*, edge: float = 1.0):
    system = ControlAffineSDE((x,), (u,), [x], [1], [s], {s: 0.1})
    given = dict(start=[(-0.5, 0.5)], dt=0.05, horizon=1.0, workspace={x: (-5, 5)})
    return define_problem(system, SIGN * (edge - x), input_bounds=(-5, 5), **given)

ready = problem()
number = 3
def wrong():
    return 3
"""


def place(folder: Path, name: str = "problem", statement: str = STATEMENT) -> str:
    path = folder / "mine.py"
    path.write_text(statement.replace("SIGN", "1"))
    return f"{path}:{name}"


def stated_here(*, edge: float = 1.0) -> SafetyProblem:
    x, u = sp.symbols("x u", real=True)
    system = safe_envs.ControlAffineSDE((x,), (u,), [x], [1], [0])
    return define_problem(
        system,
        edge - x,
        input_bounds=(-5, 5),
        start=[0.2],
        dt=0.05,
        horizon=1.0,
        workspace={x: (-5, 5)},
    )


@pytest.fixture
def my_id():
    yield "my_lab/Mine-v0"
    gym.registry.pop("my_lab/Mine-v0", None)


def test_the_arguments_of_every_env_hold_for_it(tmp_path):
    env = gym.make(CUSTOM_ID, system=place(tmp_path), noise=0.3, edge=2.0, dt=0.1, start=[0.1])
    problem = env.unwrapped.problem  # pyright: ignore[reportAttributeAccessIssue]
    (barrier,) = problem.barriers
    assert barrier.expression.subs({sp.Symbol("x", real=True): 0}) == 2.0
    assert (problem.dt, problem.start) == (0.1, "given")
    assert list(problem.plant.parameters.values()) == [0.3]
    check_env(env.unwrapped, skip_render_check=True)


def test_a_batch_follows_the_scalar_env(tmp_path):
    system = place(tmp_path, "ready")
    env, envs = (
        gym.make(CUSTOM_ID, system=system),
        gym.make_vec(CUSTOM_ID, num_envs=2, system=system),
    )
    env.reset(seed=3)
    envs.reset(seed=3)
    for _ in range(5):
        one, many = env.step(np.array([0.5])), envs.step(np.full((2, 1), 0.5))
    assert np.array_equal(one[0], many[0][0])


def test_registered_by_its_place_or_its_function(tmp_path, my_id):
    for system in (place(tmp_path), stated_here):
        safe_envs.register(my_id, system)
        env = gym.make(my_id, edge=3.0)
        again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))  # pyright: ignore[reportOptionalMemberAccess]
        assert again.unwrapped.problem.barriers == env.unwrapped.problem.barriers  # pyright: ignore[reportAttributeAccessIssue]
        assert gym.make_vec(my_id, num_envs=2).reset(seed=0)[0].shape == (2, 1)
        gym.registry.pop(my_id)


def test_a_file_that_changed_is_read_anew(tmp_path):
    system = place(tmp_path)
    assert load_system(system)().horizon == 1.0
    Path(system.rpartition(":")[0]).write_text(
        STATEMENT.replace("SIGN", "1").replace("horizon=1.0", "horizon=22.0")
    )
    assert load_system(system)().horizon == 22.0


def test_modules_beside_the_file_can_be_imported(tmp_path):
    (tmp_path / "beside_it.py").write_text("EDGE = 1.5")
    text = STATEMENT.replace("edge: float = 1.0", "edge: float = EDGE")
    problem = load_system(place(tmp_path, statement=f"from beside_it import EDGE\n{text}"))()
    assert problem.barriers[0].expression.has(sp.Float(1.5))


BESIDE, BARRIER = "from beside_it import EDGE", "from safe_envs import Barrier"


def own(folder: Path, text: str, name: str = "problem") -> str:
    (folder / "beside_it.py").write_text("EDGE = 1.5")
    (folder / "own.py").write_text(text)
    return f"{folder / 'own.py'}:{name}"


@pytest.mark.parametrize(
    ("text", "name", "error", "fragment"),
    [
        (STATEMENT, "problems", ConfigurationError, "did you mean 'problem'"),
        (STATEMENT, "number", ConfigurationError, "is int"),
        (STATEMENT, "wrong", ConfigurationError, "returned int"),
        (STATEMENT, "", ConfigurationError, "own.py"),
        ("\nimport sympyy", "problem", ConfigurationError, "line 2: ModuleNotFoundError"),
        ("1 / 0", "problem", ConfigurationError, "line 1: ZeroDivisionError"),
        ("def problem():\n    1 / 0", "problem", ConfigurationError, "line 2: ZeroDivisionError"),
        ("def problem():\n    raise SystemExit(0)", "problem", ConfigurationError, "SystemExit"),
        (f"def problem():\n    {BESIDE}\n    return EDGE", "problem", ConfigurationError, "float"),
        ("def problem(*, radius): pass", "problem", ConfigurationError, "'radius'"),
        (f"{BARRIER}\n\nBarrier('x')", "problem", SystemDefinitionError, "own.py in line 3"),
        (STATEMENT.replace("(edge - x)", "(x - edge)"), "problem", SystemDefinitionError, "sign"),
    ],
)
def test_what_is_no_statement_is_explained(tmp_path, text, name, error, fragment):
    before = list(sys.path)
    with pytest.raises(error, match=fragment):
        load_system(own(tmp_path, text.replace("SIGN", "1"), name))()
    assert sys.path == before


@pytest.mark.parametrize(
    "given",
    [lambda: None, 3, "nowhere.py:problem", "no_such_module:problem", "no_colon", stated_here()],
)
def test_what_cannot_be_registered_is_refused(given, my_id):
    with pytest.raises(ConfigurationError):
        safe_envs.register(my_id, given)
    assert my_id not in gym.registry


def test_the_arguments_of_the_env_itself_reach_it(tmp_path):
    system = place(tmp_path)
    env = Custom(system, max_episode_steps=3)
    env.reset(seed=0)
    assert [env.step([0.0])[3] for _ in range(3)] == [False, False, True]
    envs = gym.make_vec(
        CUSTOM_ID, num_envs=1, system=system, autoreset_mode="SameStep", horizon=0.1
    )
    envs.reset(seed=0)
    assert "final_info" not in envs.step([[0.0]])[4]
    assert "final_info" in envs.step([[0.0]])[4]


def test_neighbours_of_one_name_in_two_folders_are_told_apart(tmp_path):
    found = []
    for number in (1, 2):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "same_name.py").write_text(f"EDGE = {number}")
        (folder / "own.py").write_text("from same_name import EDGE")
        found.append(load_object(f"{folder / 'own.py'}:EDGE"))
    assert found == [1, 2]


def test_ids_of_others_are_not_replaced(tmp_path, my_id):
    with pytest.raises(ConfigurationError, match="is taken"):
        safe_envs.register("Pendulum-v1", place(tmp_path))
    for edge in ("1.0", "2.0"):
        safe_envs.register(
            my_id,
            place(
                tmp_path, statement=STATEMENT.replace("edge: float = 1.0", f"edge: float = {edge}")
            ),
        )


@pytest.mark.parametrize("make", [gym.make, partial(gym.make_vec, num_envs=2)])
@pytest.mark.parametrize("given", [{}, *({"system": s} for s in ("", None, 3, stated_here))])
def test_the_id_for_any_system_asks_for_one(make, given):
    with pytest.raises(ConfigurationError, match=r"FILE.py:NAME"):
        make(CUSTOM_ID, **given)


def test_an_installed_system_goes_by_its_name(tmp_path, monkeypatch):
    (tmp_path / "carts-1.0.dist-info").mkdir()
    (tmp_path / "carts-1.0.dist-info" / "METADATA").write_text("Name: carts\nVersion: 1.0\n")
    (tmp_path / "carts-1.0.dist-info" / "entry_points.txt").write_text(
        "[safe_envs.systems]\ncart = carts_of_a_test:problem\n"
    )
    (tmp_path / "carts_of_a_test.py").write_text(STATEMENT.replace("SIGN", "1"))
    monkeypatch.syspath_prepend(tmp_path)
    problem = make_problem(CUSTOM_ID, system="cart", edge=2.0, noise=0.3)
    assert list(problem.plant.parameters.values()) == [0.3]
    assert gym.make(CUSTOM_ID, system="cart", edge=2.0, noise=0.3).unwrapped.problem == problem  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ConfigurationError, match="has no 'card'; did you mean 'cart'"):
        make_problem(CUSTOM_ID, system="card")
