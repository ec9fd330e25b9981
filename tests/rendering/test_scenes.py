from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import Barrier, ConfigurationError, ControlAffineSDE, SafeEnv, SafetyProblem
from safe_envs.problem.signals import Feature, Variable
from safe_envs.problem.starts import Start
from safe_envs.rendering import style
from safe_envs.rendering.scenes import make_scene
from safe_envs.rendering.scenes.quadrotor import rotation
from tests.conftest import problem_of
from tests.rendering.drawn import SCENE, shown, stepped


def drawn(problem) -> SafeEnv:
    env = SafeEnv(problem, render_mode="rgb_array")
    env.reset(seed=0)
    return env


def is_near(pixels, color, most=60) -> bool:
    """Whether some pixel has nearly a colour."""
    return bool((np.abs(pixels.astype(int) - color).sum(axis=-1) < most).any())


def test_the_disk_is_to_scale():
    from safe_envs.rendering.picture import Picture

    for radius in (1.0, 2.5):
        env = drawn(problem_of("safe_envs/DubinsDisk-v0", radius=radius, start=[0.0, 0.0, 1.0]))
        frame = env.render()
        picture = Picture(env.problem)
        axes = picture._scene._plane.background(picture._canvas, env.viewer._histories[0].snapshot)
        assert axes.scale[0] == pytest.approx(axes.scale[1])
        for angle in (0.3, 2.0, 4.0):
            x, y = axes.place(radius * np.cos(angle), radius * np.sin(angle))
            around = frame[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2]
            assert is_near(around, style.EDGE), "the edge is not where h = 0"
            for share, safe in ((0.97, True), (1.03, False)):
                x, y = axes.place(share * radius * np.cos(angle), share * radius * np.sin(angle))
                pixel = frame[int(y), int(x)].astype(int)
                assert (pixel[1] > pixel[0]) == safe, "green within, reddish beyond"


def test_obstacles_and_goal_are_to_scale():
    env = drawn(problem_of("safe_envs/DubinsObstacle-v0", radius=0.7))
    frame = env.render()
    scene = env.viewer._picture._scene
    axes = next(iter(scene._plane._views))
    assert [circle.radius for circle in scene._obstacles] == pytest.approx([0.7])
    assert scene._disks["goal"].radius == pytest.approx(0.3)
    center = env.state[3:5]
    x, y = axes.place(center[0], center[1] - 0.7)
    assert is_near(frame[int(y) - 3 : int(y) + 4, int(x)], style.VIOLATION)
    x, y = axes.place(3.0, 1.5 - 0.3)
    assert is_near(frame[int(y) - 3 : int(y) + 4, int(x)], style.GOAL)


def test_regions_are_outlined_to_scale():
    problem = problem_of("safe_envs/DubinsReach-v0")
    frames = []
    for regions in ({}, problem.regions):
        env = drawn(replace(problem, regions=regions))
        frames.append(env.render().astype(int))
    scene = env.viewer._picture._scene
    axes = next(iter(scene._plane._views))
    rows, columns = np.nonzero((frames[0] != frames[1]).any(axis=-1))
    x, y = axes.place(-0.6, 1.1)
    radius = 0.4 * axes.scale[0]
    assert columns.min() == pytest.approx(x - radius, abs=2)
    assert columns.max() == pytest.approx(x + radius, abs=2)
    assert rows.max() == pytest.approx(y + radius, abs=2)


def test_required_gap_is_where_the_barrier_vanishes():
    road = make_scene(problem_of("safe_envs/ACC-v0", tau=1.5))
    states = np.array([[20.0, 20.0, 100.0], [10.0, 20.0, 3.0]])
    np.testing.assert_allclose(road.required(states), [30.0, 15.0], atol=1e-3)
    road = make_scene(problem_of("safe_envs/ACCGap-v0", distance=12.0))
    np.testing.assert_allclose(road.required(np.array([[20.0, 30.0]])), [12.0], atol=1e-3)


def own_problem(**changes) -> SafetyProblem:
    """A problem of a user: a mass whose drag is a state, with two barriers."""
    p, v, c, force = sp.symbols("p v c force", real=True)
    system = ControlAffineSDE((p, v, c), (force,), [v, -c * v, 0], [0, 1, 0], [0, 0, 0])
    given = {
        "name": "mine",
        "plant": system,
        "model": system,
        "barriers": (Barrier(1 - p**2 - v**2 / 4), Barrier(2 - c * v, "drag")),
        "states": tuple(Variable(s, -3.0, 3.0) for s in (p, v, c)),
        "inputs": (Variable(force, -1.0, 2.0, "N"),),
        "reward": sp.Integer(0),
        "nominal": (sp.Integer(1),),
        "starts": {"origin": Start.at((0.0, 0.0, 1.0))},
        "dt": 0.1,
        "horizon": 2.0,
    }
    return SafetyProblem(**{**given, **changes})


@pytest.mark.parametrize("plane", [None, ("p", "v")])
def test_any_problem_is_drawn(plane):
    env = drawn(own_problem(plane=plane))
    first = env.render()
    assert shown(first[:, SCENE], style.EDGE) > 20
    assert (stepped(env, 3, 1.0).render()[:, SCENE] != first[:, SCENE]).any()


@pytest.mark.parametrize("plane", [None, ("p", "v")])
def test_states_without_bounds_are_drawn(plane):
    p, v, c = own_problem().plant.states
    states = tuple(Variable(s, -np.inf, np.inf) for s in (p, v, c))
    features = (Feature("p", p, -1.0, 1.0),)
    env = drawn(own_problem(plane=plane, states=states, features=features))
    before = env.render()
    assert (stepped(env, 30, 1.0).render()[:, SCENE] != before[:, SCENE]).any()
    assert env.state[0] > 2.0


@pytest.mark.parametrize(
    ("scene", "fragment"), [("top", "top-view"), ("road", "p, v, c"), ("pendulum", "'theta'")]
)
def test_a_wrong_scene_is_named(scene, fragment):
    env = drawn(own_problem(scene=scene))
    with pytest.raises(ConfigurationError, match=fragment):
        env.render()


def four_states(**changes) -> SafetyProblem:
    """A cart with a pole, without a workspace, whose barriers vanish at other scales than 1."""
    x, v, theta, rate, force = sp.symbols("x v theta rate force", real=True)
    system = ControlAffineSDE(
        (x, v, theta, rate), (force,), [v, 0, rate, 9 * theta], [0, 1, 0, -1], [0, 0, 0, 0]
    )
    given = {
        "plant": system,
        "model": system,
        "barriers": (Barrier(900 - x**2, "track"), Barrier(0.04 - theta**2 - rate**2, "capacity")),
        "states": tuple(Variable(s, -np.inf, np.inf) for s in system.states),
        "starts": {"aside": Start.at((20.0, 0.0, 0.05, 0.0))},
    }
    return own_problem(**{**given, **changes})


def test_states_without_a_workspace_are_shown_with_the_edges_of_the_safe_set():
    scene = make_scene(four_states())
    x, v, theta, rate = (scene.range_of(i) for i in range(4))
    assert x[0] < 20.0
    assert 30.0 < x[1] < 50.0
    assert v == (-1.0, 1.0)
    assert -1.0 < theta[0] < 0.05 < 0.2 < theta[1] < 1.0
    assert -1.0 < rate[0] < -0.19
    assert 0.19 < rate[1] < 1.0
    u = sp.Symbol("u")
    spread = Start((sp.Float(0), 6 * u - 3, sp.Float(0), sp.Float(0)), (u,))
    low, high = make_scene(four_states(starts={"spread": spread})).range_of(1)
    assert low <= -3.0
    assert high >= 3.0


def test_an_obstacle_is_outlined_where_the_first_violation_was():
    env = drawn(problem_of("safe_envs/DubinsObstacle-v0", radius=0.7))
    state = env.state.copy()
    ahead = np.array(state)
    ahead[3:5] += (1.5, -2.0)

    def outlined(*states):
        env.viewer.restart([states[0]], [0.0], [0])
        for k, each in enumerate(states[1:], start=1):
            env.viewer.advance([each], [0.05 * k], [[0.0]])
        frame = env.render()
        axes = next(iter(env.viewer._picture._scene._plane._views))
        x, y = axes.place(state[3] - 0.7, state[4])
        around = frame[int(y) - 1 : int(y) + 2, int(x) - 3 : int(x) + 4]
        return is_near(around, style.mix(style.VIOLATION, style.PAPER, 0.6), 90)

    hit = np.array(state)
    hit[:2] = state[3:5] + 0.1
    away = np.array(ahead)
    away[:2] = ahead[3:5] + 3.0
    assert outlined(hit, away)
    apart = np.array(state)
    apart[:2] = state[3:5] + 3.0
    assert not outlined(apart, away), "there was no violation"


def test_the_drawn_quadrotor_leans_where_its_thrust_goes():
    plant = problem_of("safe_envs/Quadrotor-v0").plant
    by_name = {s.name: s for s in plant.states}
    for angles in np.random.default_rng(0).uniform(-1.4, 1.4, (5, 3)):
        at = dict(zip((by_name[name] for name in ("phi", "theta", "psi")), angles, strict=True))
        push = np.array(plant.numeric(plant.input_matrix).subs(at), dtype=float)[3:6].sum(axis=1)
        turned = rotation(*angles)
        assert turned[:, 2] == pytest.approx(push / np.linalg.norm(push))
        assert turned @ turned.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(turned) == pytest.approx(1.0)
