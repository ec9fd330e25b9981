"""Policies of measured envs: those of the full state refuse, others see what is measured."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs import ConfigurationError
from safe_envs.agents.policies.registry import make_policy
from tests.conftest import problem_of

PENDULUM, ACC = "safe_envs/Pendulum-v0", "safe_envs/ACC-v0"


@pytest.mark.parametrize(
    ("env_id", "name"), [(PENDULUM, "nominal"), (ACC, "clf"), ("safe_envs/Scalar-v0", "best")]
)
def test_policies_of_the_full_state_refuse_a_measurement(env_id, name):
    # The number of channels is that of the features: nobody would notice.
    problem = problem_of(env_id, measurement="default")
    assert len(problem.measurement.channels) == len(problem.features)
    with pytest.raises(
        ConfigurationError, match=r"act on the full state, and .* is measured; give"
    ):
        make_policy(name, problem)
    make_policy(name, problem.unmeasured)


@pytest.mark.parametrize("name", ["zero", "random"])
def test_other_policies_take_any_sensor(name):
    problem = problem_of(PENDULUM, measurement=["default", "x=theta:noise=1"])
    policy = make_policy(name, problem)
    policy.begin(range(2), 0)
    assert policy.predict(np.zeros((2, 3)))[0].shape == (2, 1)


def test_a_function_sees_what_is_measured():
    problem = problem_of(PENDULUM, measurement=["theta:noise=1"])
    policy = make_policy(lambda observation: -observation, problem)
    assert policy.predict(np.array([0.5]))[0].tolist() == [-0.5]


@pytest.mark.slow
def test_an_agent_that_is_trained_on_measurements_knows_of_which(tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")
    from safe_envs.agents.policies.network import load_policy, save_policy
    from safe_envs.agents.training.vec_env import make_sb3_env

    measured = {"measurement": ["default", "twice=2*theta:noise=.1", "delay=1"]}
    env = make_sb3_env(PENDULUM, 2, **measured)
    model = sb3.PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=0)
    model.learn(64)
    problem = problem_of(PENDULUM, **measured)
    save_policy(model, tmp_path, problem)
    policy = load_policy(tmp_path, problem)
    seen = env.reset()
    np.testing.assert_allclose(
        policy.predict(seen)[0], model.predict(seen, deterministic=True)[0], atol=1e-5
    )
    for other in ({}, {"measurement": "default"}, {"measurement": ["default", "b=theta:noise=.2"]}):
        with pytest.raises(ConfigurationError, match="was trained for another problem"):
            load_policy(tmp_path, problem_of(PENDULUM, **other))
