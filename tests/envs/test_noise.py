"""Starts and noise are those of the streams that seed, episode and control period say."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils import seeding

from safe_envs import ConfigurationError
from safe_envs.dynamics.noise import NOISE, StreamReader, key_of, standard_normals
from safe_envs.envs.simulation import Simulation

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
