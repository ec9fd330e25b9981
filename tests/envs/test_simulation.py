"""Steps, ends of episodes and breakdowns at their edges, for one env and for a batch alike."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from gymnasium.utils import seeding

from safe_envs import (
    ConfigurationError,
    ControlAffineSDE,
    NumericalError,
    SafeEnv,
    SafeVectorEnv,
    define_problem,
)
from safe_envs.dynamics.noise import NOISE, StreamReader, key_of, standard_normals
from safe_envs.envs.episode import DelayLine
from safe_envs.envs.simulation import Simulation
from safe_envs.problem.signals import Feature
from tests.conftest import problem_of

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


# Envs execute what was sent a while ago, at limited rates, and say so.


PENDULUM = "safe_envs/Pendulum-v0"


def trajectory(problem, actions, seed=3):
    env = SafeEnv(problem)
    env.reset(seed=seed)
    found = [env.state]
    for action in actions:
        env.step(action)
        found.append(env.state)
    return np.array(found)


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("delay", [1, 4])
def test_a_delayed_env_is_one_under_shifted_inputs_to_the_last_bit(noise, delay):
    problem = problem_of(PENDULUM, noise=noise)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (30, 1))
    shifted = np.concatenate([np.zeros((delay, 1)), actions[:-delay]])
    late = trajectory(problem.configured(delay=delay), actions)
    np.testing.assert_array_equal(late, trajectory(problem, shifted))
    assert not np.array_equal(late, trajectory(problem, actions))


def test_no_delay_is_the_env_without_the_option():
    assert SafeEnv(problem_of(PENDULUM, delay=0)).problem == problem_of(PENDULUM)


def test_the_resting_input_is_within_the_bounds_nearest_to_zero():
    env = SafeEnv(problem_of(PENDULUM, input_bounds=(1.0, 4.0), delay=2))
    _, info = env.reset(seed=0)
    assert (info["sent_action"], info["executed_action"]) == ([1.0], [1.0])
    executed = [env.step([1.0])[4]["executed_action"].item() for _ in range(4)]
    assert executed == [1.0, 1.0, 4.0, 4.0]


@pytest.mark.parametrize("num_envs", [None, 2])
def test_inputs_and_rates_stay_within_their_bounds(num_envs):
    """And go as far as the rate allows."""
    problem = problem_of(PENDULUM, delay=2, slew_limit=(-30.0, 70.0))
    env = SafeEnv(problem) if num_envs is None else SafeVectorEnv(problem, num_envs)
    (low, high), rng = problem.input_bounds[0], np.random.default_rng(0)
    down, up = -30.0 * problem.dt, 70.0 * problem.dt
    for seed in range(5):
        env.reset(seed=seed)
        sent, last = [np.zeros(env.action_space.shape)] * 2, np.zeros(env.action_space.shape)
        for k in range(100):
            given = rng.uniform(-1.0, 1.0, last.shape) if k % 20 < 10 else np.sign(last)
            *_, terminated, truncated, info = env.step(given)
            wanted, now = sent.pop(0), info["executed_action"]
            sent.append(info["sent_action"])
            expected = np.clip(wanted, np.maximum(low, last + down), np.minimum(high, last + up))
            np.testing.assert_allclose(now, expected, rtol=0, atol=1e-13)
            assert ((low <= now) & (now <= high)).all()
            if np.any(terminated | truncated):
                break
            last = now
        assert k > 20


def test_what_is_under_way_is_nobody_elses_array():
    line, given = DelayLine(2, (0.0,), num_envs=3), np.ones(3)
    line.exchange((given,))
    given[:] = 9.0
    np.testing.assert_array_equal(line.under_way[-1], [np.ones(3)])


@pytest.mark.parametrize(
    ("options", "fragment"),
    [
        ({"delay": -1}, "delay = -1"),
        ({"delay": 1.5}, "delay = 1.5"),
        ({"delay": 10**6}, "1000"),
        ({"model_delay": True}, "model_delay = True"),
        ({"slew_limit": (1.0, 2.0)}, "slew_limit"),
        ({"slew_limit": "fast"}, "'fast'"),
        ({"rate_limit": (-1.0, float("nan"))}, "rate_limit"),
        ({"rate_limit": [(-1, 1), (-1, 1)]}, "1 inputs"),
    ],
)
def test_other_values_are_refused(options, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        problem_of(PENDULUM, **options)


# Starts and noise are those of the streams that seed, episode and control period say.


ENV_ID = "safe_envs/StochasticDubins-v0"


class Expected:
    """Noise by the definition, period by period."""

    def __init__(self, channels):
        self.channels, self.reader, self.rows = channels, StreamReader(), {}

    def __call__(self, key, episode, period):
        stream = key, int(episode)
        if stream not in self.rows:
            uniforms = self.reader.seek(*stream, NOISE).uniforms((1500, self.channels))
            self.rows[stream] = standard_normals(uniforms)
        return self.rows[stream][period]


def expected_state(problem, seed, episode, periods):
    """The state of an env after so many control periods with the input 0."""
    simulation = Simulation(problem, "floats")
    reader, key = StreamReader(), key_of(seed)
    x = simulation.starts.draw(reader, key, episode)
    noise = Expected(simulation.integrator.channels)
    for k in range(periods):
        x = simulation.integrator.step(x, [0.0], noise(key, episode, k).tolist())
    return np.array(x)


def zero(env):
    return np.zeros(env.action_space.shape)


def at_random(env_id, periods, resets=0.02, num_envs=4):
    """A batch whose envs are reset, and one of them seeded, now and then.

    Returns:
        Their states, and seed, episode and period of each.
    """
    env = gym.make_vec(env_id, num_envs, horizon=1e3, noise=0.01, max_episode_steps=350).unwrapped
    rng, seeds, episodes = np.random.default_rng(0), np.arange(num_envs), np.zeros(num_envs, int)
    env.reset(seed=0)
    for k in range(periods):
        due = rng.random(num_envs) < resets
        due[0] = False
        if due.any():
            env.reset(options={"reset_mask": due})
            episodes += due
        if k % 150 == 149:
            mask = np.arange(num_envs) == 1
            env.reset(seed=[k] * num_envs, options={"reset_mask": mask})
            seeds[1], episodes[1] = k, 0
        restarts = env.episodes.ended.copy()
        env.step(zero(env))
        episodes += restarts
    return env, seeds, episodes


@pytest.mark.parametrize("env_id", [ENV_ID, "safe_envs/Scalar-v0"])
def test_the_noise_of_a_batch_is_that_of_seed_episode_and_period(env_id):
    """Beyond the 256 periods for which noise is drawn at once."""
    env, seeds, episodes = at_random(env_id, 620)
    assert env.episodes.steps.max() > 256 or env_id == ENV_ID
    assert episodes.max() > 10
    for i, (seed, episode) in enumerate(zip(seeds, episodes, strict=True)):
        expected = expected_state(env.problem, int(seed), episode, env.episodes.steps[i])
        np.testing.assert_allclose(env.state[i], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("last", [7, 300])
def test_a_scalar_env_counts_its_episodes(last):
    """Also in episodes that are played on after their end."""
    env, seed = gym.make(ENV_ID, horizon=12.0).unwrapped, 2**64 + 5
    for episode in range(3):
        env.reset(seed=seed if episode == 0 else None)
        np.testing.assert_array_equal(env.state, expected_state(env.problem, seed, episode, 0))
        for _ in range(last):
            env.step(zero(env))
        np.testing.assert_array_equal(env.state, expected_state(env.problem, seed, episode, last))


def test_a_vector_env_counts_the_episodes_of_each_env():
    envs = gym.make_vec(ENV_ID, num_envs=3, max_episode_steps=4).unwrapped
    problem = envs.problem
    envs.reset(seed=6)
    for _ in range(4 + 1 + 2):
        envs.step(zero(envs))
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    for _ in range(2):
        envs.step(zero(envs))
    np.testing.assert_array_equal(envs.episodes.steps, [4, 2, 4])
    for i, (episode, periods) in enumerate([(1, 4), (2, 2), (1, 4)]):
        np.testing.assert_allclose(
            envs.state[i], expected_state(problem, 6 + i, episode, periods), rtol=1e-12
        )
    envs.reset(seed=[9, None, 9])
    for i, (seed, episode) in enumerate([(9, 0), (7, 3), (9, 0)]):
        np.testing.assert_array_equal(envs.state[i], expected_state(problem, seed, episode, 0))


def test_without_a_seed_that_of_gymnasium_is_taken():
    env, envs = gym.make(ENV_ID), gym.make_vec(ENV_ID, num_envs=2).unwrapped
    env.reset()
    seed = env.unwrapped.np_random_seed
    np.testing.assert_array_equal(
        env.unwrapped.state, expected_state(env.unwrapped.problem, seed, 0, 0)
    )
    envs.reset()
    assert len({seed, *envs.np_random_seed}) == 3
    for x, chosen in zip(envs.state, envs.np_random_seed, strict=True):
        assert chosen > 2**64
        np.testing.assert_array_equal(x, expected_state(envs.problem, chosen, 0, 0))


def test_np_random_is_seeded_as_gymnasium_does_and_left_alone():
    env, envs = gym.make(ENV_ID).unwrapped, gym.make_vec(ENV_ID, num_envs=2).unwrapped
    env.reset(seed=5)
    envs.reset(seed=5)
    first = envs.np_random
    for _ in range(3):
        env.step(zero(env))
        envs.step(zero(envs))
    env.reset()
    assert all(a is b for a, b in zip(first, envs.np_random, strict=True))
    for i, generator in enumerate((env.np_random, *envs.np_random)):
        fresh, _ = seeding.np_random((5, 5, 6)[i])
        assert generator.bit_generator.state == fresh.bit_generator.state
    envs.reset(seed=[None, 8])
    assert envs.np_random[0] is first[0]
    assert envs.np_random[1] is not first[1]
    assert envs.np_random_seed == (5, 8)


def test_a_generator_that_is_set_gives_each_episode_a_key():
    def states(seed):
        env = gym.make(ENV_ID).unwrapped
        env.np_random = np.random.default_rng(seed)
        found = []
        for _ in range(2):
            env.reset()
            found.append(env.state)
            env.step(zero(env))
            found.append(env.state)
        assert env.np_random_seed == -1
        env.reset(seed=4)
        np.testing.assert_array_equal(env.state, expected_state(env.problem, 4, 0, 0))
        return np.array(found)

    np.testing.assert_array_equal(states(1), states(1))
    assert len(np.unique(np.concatenate([states(1), states(2)]), axis=0)) == 8


def test_a_restored_env_goes_on_with_the_noise_of_its_seed():
    envs, others = (gym.make_vec(ENV_ID, num_envs=3).unwrapped for _ in range(2))
    envs.reset(seed=1)
    for _ in range(5):
        envs.step(zero(envs))
    snapshot = envs.snapshot()
    for k in range(30):
        envs.step(zero(envs))
        if k == 0:
            after = envs.state
    others.restore(snapshot, seed=1)
    for _ in range(30):
        others.step(zero(others))
    np.testing.assert_array_equal(envs.state, others.state)
    # Without a seed, the noise is fresh.
    envs.restore(snapshot)
    envs.step(zero(envs))
    assert (envs.state != after).any(axis=1).all()


def test_negative_seeds_change_nothing():
    envs = gym.make_vec(ENV_ID, num_envs=2).unwrapped
    with pytest.raises(ConfigurationError, match="seed = -1"):
        envs.reset(seed=-1)
    envs.reset(seed=3)
    with pytest.raises(ConfigurationError, match="seed = -1"):
        envs.reset(seed=[5, -1])
    assert envs.np_random_seed == (3, 4)
