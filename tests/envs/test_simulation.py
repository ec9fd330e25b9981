"""Steps, ends of episodes and breakdowns at their edges, for one env and for a batch alike."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, NumericalError, SafeEnv, SafeVectorEnv, define_problem
from safe_envs.dynamics.noise import NOISE, StreamReader, key_of, standard_normals
from safe_envs.problem.signals import Feature

x, v, u = sp.symbols("x v u", real=True)
ENVS = [SafeEnv, lambda problem, **arguments: SafeVectorEnv(problem, 2, **arguments)]
both = pytest.mark.parametrize("make", ENVS, ids=["scalar", "batch"])


def first(found: Any) -> Any:
    """The first entry of a batch, or the value itself."""
    return np.ravel(found)[0]


def act(env, action):
    """Step with the same action everywhere; the numbers of the first env."""
    _, reward, terminated, truncated, info = env.step(np.full(env.action_space.shape, action))
    return (
        first(reward),
        first(terminated),
        first(truncated),
        {key: first(info[key]) for key in ("violation", "cost", "episode_cost")},
    )


def walker(**changes):
    """x' = u, which moves by exactly .5 in a step of the largest action."""
    system = ControlAffineSDE((x,), (u,), [0], [1], [0])
    numbers: dict[str, Any] = {
        "input_bounds": (-1, 1),
        "start": [0.5],
        "dt": 0.5,
        "horizon": 2.0,
        **changes,
    }
    return define_problem(system, 1 - x, **numbers)


@both
def test_the_edge_of_the_safe_set_is_safe(make):
    env = make(walker())
    env.reset(seed=0)
    *_, at_edge = act(env, 1.0)
    assert first(env.state) == 1.0
    assert at_edge == {"violation": False, "cost": 0.0, "episode_cost": 0.0}
    *_, beyond = act(env, 1.0)
    assert beyond == {"violation": True, "cost": 1.0, "episode_cost": 1.0}


@both
def test_the_edge_of_the_goal_is_the_goal_and_that_of_the_workspace_inside(make):
    for changes, ends in (({"goal": x - 1}, True), ({"workspace": {x: (-1.0, 1.0)}}, False)):
        env = make(walker(**changes))
        env.reset(seed=0)
        _, terminated, *_ = act(env, 1.0)
        assert first(env.state) == 1.0
        assert terminated == ends


@both
@pytest.mark.parametrize(("most", "steps"), [(None, 4), (3, 3), (4, 4), (100, 4)])
def test_an_episode_lasts_to_the_horizon_at_most(make, most, steps):
    env = make(walker(), max_episode_steps=most)
    env.reset(seed=0)
    assert [bool(act(env, -1.0)[2]) for _ in range(steps)] == [False] * (steps - 1) + [True]


@both
def test_actions_beyond_the_box_are_clipped_to_it(make):
    for action, low, high in (
        (1e200, -1.0, 3.0),
        (-1e200, -1.0, 3.0),
        (7.0, -5.0, -4.0),
        (1.0 + 1e-9, 0.0, 1.0),
    ):
        env = make(walker(input_bounds=(low, high), horizon=5.0))
        env.reset(seed=0)
        act(env, action)
        bound = high if action > 0 else low
        assert first(env.executed) == pytest.approx(bound, rel=1e-15)
        assert first(env.state) == pytest.approx(0.5 + 0.5 * bound, rel=1e-15)


def swinging(noise: float, substeps: int):
    """A stiff oscillator with noise that depends on its state and is shared by both states."""
    system = ControlAffineSDE(
        (x, v), (u,), [v, -30 * sp.sin(x)], [0, 1 + x**2], [[noise * v, noise], [noise, noise * x]]
    )
    return define_problem(
        system,
        9 - x,
        input_bounds=(-2, 2),
        start=[0.4, -0.3],
        dt=0.2,
        horizon=2.0,
        substeps=substeps,
    )


def rate(state, force):
    return np.array([state[1], -30 * math.sin(state[0]) + (1 + state[0] ** 2) * force])


def by_hand(state, force, dt, substeps, draws=None, noise=0.0):
    """Classical Runge-Kutta steps, or those of Euler and Maruyama."""
    h, state = dt / substeps, np.array(state)
    for k in range(substeps):
        if draws is not None:
            sigma = noise * np.array([[state[1], 1.0], [1.0, state[0]]])
            state = state + h * rate(state, force) + math.sqrt(h) * sigma @ draws[k]
            continue
        k1 = rate(state, force)
        k2 = rate(state + h / 2 * k1, force)
        k3 = rate(state + h / 2 * k2, force)
        k4 = rate(state + h * k3, force)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state


@both
@pytest.mark.parametrize("substeps", [1, 2, 5])
def test_envs_take_the_substeps_of_their_problem_without_noise(make, substeps):
    env = make(swinging(0.0, substeps))
    env.reset(seed=0)
    act(env, 0.5)
    expected = by_hand([0.4, -0.3], 1.0, 0.2, substeps)
    np.testing.assert_allclose(np.reshape(env.state, (-1, 2))[0], expected, rtol=1e-12)
    # The number of them tells: a step more or less is seen.
    assert abs(by_hand([0.4, -0.3], 1.0, 0.2, substeps + 1) - expected).max() > 1e-6


@both
@pytest.mark.parametrize("substeps", [1, 3])
def test_envs_take_the_substeps_of_their_problem_with_noise(make, substeps):
    env = make(swinging(0.3, substeps))
    env.reset(seed=6)
    uniforms = StreamReader().seek(key_of(6), 0, NOISE).uniforms((1, 2 * substeps))
    drawn = standard_normals(uniforms).reshape(substeps, 2)
    act(env, 0.5)
    expected = by_hand([0.4, -0.3], 1.0, 0.2, substeps, drawn, 0.3)
    np.testing.assert_allclose(np.reshape(env.state, (-1, 2))[0], expected, rtol=1e-12)


def forgetful():
    """x + dt x' is 0, without x in it, and v + dt v' the input alone."""
    system = ControlAffineSDE((x, v), (u,), [-4 * x, -4 * v], [0, 4], [0, sp.Float(1e-30)])
    return define_problem(
        system, 9 - v, input_bounds=(-2, 2), start=[0.4, -0.3], dt=0.25, horizon=2.0
    )


@both
def test_a_state_that_forgets_all_within_a_step_is_a_batch_like_others(make):
    env = make(forgetful())
    env.reset(seed=0)
    for action in (0.5, -0.25):
        act(env, action)
        np.testing.assert_allclose(
            np.reshape(env.state, (-1, 2)),
            [[0.0, 2 * action]] * (1 if isinstance(env, SafeEnv) else 2),
            atol=1e-20,
        )


def diverging(**changes):
    """x' = u beside v' = v^3, which is infinite after .5 s."""
    system = ControlAffineSDE((x, v), (u,), [0, v**3], [1, 0], [0, 0])
    numbers: dict[str, Any] = {
        "input_bounds": (-1, 1),
        "start": [0.0, 1.0],
        "dt": 0.25,
        "horizon": 100.0,
        **changes,
    }
    return define_problem(system, 1000 - x, **numbers)


@both
@pytest.mark.parametrize(
    "changes",
    [
        {"features": (Feature("x", x, -9.0, 9.0),)},
        {"features": (Feature("x", x, -9.0, 9.0), Feature("w", sp.tanh(v), -1.0, 1.0))},
        {"features": (Feature("w", 1 / (1 + v**2), 0.0, 1.0),)},
        {"workspace": {v: (-1e6, 1e6)}, "dt": 1e10, "horizon": 1e12},
        {},
    ],
    ids=["unobserved", "bounded", "vanishing", "out of the workspace", "observed"],
)
def test_a_state_that_diverges_is_an_error_whatever_is_observed(make, changes):
    env = make(diverging(**changes))
    env.reset(seed=0)
    with pytest.raises(NumericalError, match=r"finite numbers|broke down"):
        [act(env, 0.0) for _ in range(20)]
