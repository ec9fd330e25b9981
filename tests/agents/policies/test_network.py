"""Trained policies as data."""

from __future__ import annotations

import hashlib
import shutil

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate, make_policy, make_problem, refine
from safe_envs.agents.policies.base import BLOCK
from safe_envs.agents.policies.network import load_policy, save_policy
from safe_envs.agents.policies.network_policy import NetworkPolicy
from safe_envs.errors import InvalidInputError
from safe_envs.filters.learning.data import Signature, load, save

pytestmark = pytest.mark.slow

ENV_ID = "safe_envs/StochasticDubins-v0"
OFF_POLICY = {"buffer_size": 10}
NN = torch.nn


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def problem():
    return make_problem(ENV_ID)


def small(algorithm=PPO, env=None, env_id=ENV_ID, **arguments):
    """A model whose actions vary: untrained ones of PPO and A2C hardly do."""
    model = algorithm(
        "MlpPolicy", gym.make(env_id) if env is None else env, device="cpu", seed=0, **arguments
    )
    with torch.no_grad():
        for parameter in model.policy.parameters():
            noise = torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
            parameter += 0.3 * noise / parameter.shape[-1] ** 0.5
    return model


@pytest.fixture(scope="module")
def saved(problem, tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved") / "ppo"
    save_policy(small(policy_kwargs={"net_arch": [8, 8]}), folder, problem)
    return folder


@pytest.fixture
def copy(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "copy")


def observations(problem, count=300):
    low, high = np.array([(f.low, f.high) for f in problem.features]).T
    return np.random.default_rng(0).uniform(low, high, (count, len(low))).astype(np.float32)


def assert_predicts_like(model, policy, problem, scaled=lambda given: given):
    many = observations(problem)
    for given in (many, many[:1], many[0]):
        wanted, _ = model.predict(scaled(given), deterministic=True)
        actions, state = policy.predict(given, "passed on")
        assert (actions.shape, actions.dtype, state) == (wanted.shape, wanted.dtype, "passed on")
        np.testing.assert_allclose(actions, wanted, rtol=0, atol=1e-6)
    assert np.ptp(policy.predict(many)[0]) > 0.1


@pytest.mark.parametrize(
    ("algorithm", "arguments"),
    [
        (PPO, {}),
        (A2C, {}),
        (SAC, OFF_POLICY),
        (TD3, OFF_POLICY),
        (DDPG, OFF_POLICY),
        *[
            (
                PPO,
                {
                    "policy_kwargs": {
                        "net_arch": {"pi": [16, 8], "vf": [4]},
                        "activation_fn": activation,
                    }
                },
            )
            for activation in (NN.ReLU, NN.LeakyReLU, NN.ELU, NN.SiLU)
        ],
        (PPO, {"policy_kwargs": {"net_arch": [], "share_features_extractor": False}}),
        (SAC, {**OFF_POLICY, "policy_kwargs": {"net_arch": []}}),
        (A2C, {"use_sde": True, "policy_kwargs": {"squash_output": True}}),
        (PPO, {"use_sde": True}),
    ],
)
def test_policies_predict_like_their_models(problem, tmp_path, algorithm, arguments):
    model = small(algorithm, **arguments)
    save_policy(model, tmp_path / "new" / "folder", problem)
    policy = load_policy(tmp_path / "new" / "folder", problem)
    assert isinstance(policy, NetworkPolicy)
    assert_predicts_like(model, policy, problem)
    found = load(tmp_path / "new" / "folder" / "policy.npz").details
    assert found["algorithm"] == algorithm.__name__
    assert found["output"] == ("tanh" if model.policy.squash_output else "clip")


@pytest.mark.parametrize("passed", [True, False])
def test_normalisation_is_part_of_the_policy(tmp_path, passed):
    env_id = "safe_envs/QuadrotorAltitude-v0"
    problem = make_problem(env_id)
    envs = VecNormalize(DummyVecEnv([lambda: gym.make(env_id)]), clip_obs=1.5, epsilon=1e-3)
    envs.obs_rms.update(observations(problem))
    model = small(SAC, envs, **OFF_POLICY)
    save_policy(model, tmp_path, problem, envs if passed else None)
    assert_predicts_like(model, load_policy(tmp_path, problem), problem, envs.normalize_obs)
    assert np.abs(envs.normalize_obs(observations(problem))).max() == 1.5
    envs.norm_obs = False
    save_policy(model, tmp_path, problem, envs)
    assert_predicts_like(model, load_policy(tmp_path, problem), problem)


@pytest.mark.parametrize(("algorithm", "arguments"), [(PPO, {}), (SAC, OFF_POLICY)])
def test_evaluation_is_the_same_for_every_num_envs(problem, tmp_path, algorithm, arguments):
    save_policy(small(algorithm, **arguments), tmp_path, problem)
    answers = [
        evaluate(
            ENV_ID,
            str(tmp_path),
            ["none", "scbf"],
            options={"horizon": 0.15},
            episodes=131,
            num_envs=n,
            record=True,
            bounds=False,
        )
        for n in (1000, 9, 130)
    ]
    for other in answers[1:]:
        assert (other.rows, other.config) == (answers[0].rows, answers[0].config)
        for name, recorder in answers[0].trajectories.items():
            assert recorder.states.tobytes() == other.trajectories[name].states.tobytes()
    one, all_of_them = (
        evaluate(
            ENV_ID,
            str(tmp_path),
            ["none"],
            options={"horizon": 0.3},
            episodes=5,
            num_envs=n,
            bounds=False,
        ).rows
        for n in (1, 5)
    )
    assert one == all_of_them


def test_an_episode_has_the_same_actions_in_every_wave(saved, problem):
    policy, many = make_policy(str(saved), problem), observations(problem)
    whole = policy.predict(many)[0]
    for start, count in ((0, 1), (1, 1), (7, 130), (BLOCK, 40), (250, 50)):
        policy.begin(range(start, start + count), seed=0)
        assert (
            policy.predict(many[start : start + count])[0].tobytes()
            == whole[start : start + count].tobytes()
        )


def test_every_path_of_a_policy_is_the_policy(saved, problem):
    wanted = make_policy(str(saved), problem).predict(observations(problem))[0]
    np.testing.assert_array_equal(
        make_policy(str(saved / "policy.npz"), problem).predict(observations(problem))[0], wanted
    )


def test_the_folder_holds_a_file_that_says_what_it_is(saved, problem):
    assert [path.name for path in saved.iterdir()] == ["policy.npz"]
    found = load(saved / "policy.npz")
    assert (found.kind, found.details["activation"]) == ("policy", "tanh")
    assert [found.arrays[f"actor_weights_{k}"].shape for k in range(3)] == [(8, 4), (8, 8), (1, 8)]
    assert found.details["features"] == ["x", "y", "cos_theta", "sin_theta"]
    assert found.details["observation"]["low"] == [-6.0, -6.0, -1.0, -1.0]
    assert found.signature == Signature.of(problem)
    digest = hashlib.sha256((saved / "policy.npz").read_bytes()).hexdigest()
    answer = evaluate(ENV_ID, str(saved), ["none"], options={"horizon": 0.1}, episodes=2)
    assert answer.config["policy"] == {"name": str(saved), "sha256": digest}
    assert (
        len(
            refine(
                ENV_ID, str(saved), filters=["none"], options={"horizon": 0.1}, episodes=2
            ).evaluations
        )
        == 3
    )


def test_another_normalisation_is_another_policy(problem, tmp_path):
    envs = VecNormalize(DummyVecEnv([lambda: gym.make(ENV_ID)]))
    model, sums = small(env=envs), []
    for i in range(2):
        envs.obs_rms.update(observations(problem))
        save_policy(model, tmp_path / str(i), problem)
        sums.append(load(tmp_path / str(i) / "policy.npz").sha256)
    assert sums[0] != sums[1]


def test_observations_of_another_shape_are_errors(saved, problem):
    with pytest.raises(InvalidInputError, match=r"\(4,\) or \(B, 4\)"):
        make_policy(str(saved), problem).predict(np.zeros((2, 3)))


class Halved(FlattenExtractor):
    """Another extractor of features, though of the same width."""

    def forward(self, observations):
        return 0.5 * super().forward(observations)


class Derived(ActorCriticPolicy):
    """A policy class of somebody's own."""


@pytest.mark.parametrize(
    ("algorithm", "policy", "arguments", "message"),
    [
        (PPO, Derived, {}, "it is a Derived"),
        (
            PPO,
            "MlpPolicy",
            {"policy_kwargs": {"features_extractor_class": Halved}},
            "the features extractor Halved",
        ),
        (
            PPO,
            "MlpPolicy",
            {"policy_kwargs": {"activation_fn": NN.Softplus}},
            "its activation is Softplus",
        ),
        (
            PPO,
            "MlpPolicy",
            {"policy_kwargs": {"activation_fn": lambda: NN.ELU(0.5)}},
            r"its activation is ELU\(alpha=0.5\)",
        ),
        (
            SAC,
            "MlpPolicy",
            {"use_sde": True, **OFF_POLICY},
            "it has a Sequential where a fully connected layer",
        ),
    ],
)
def test_unusual_policies_are_refused_with_the_reason(
    problem, tmp_path, algorithm, policy, arguments, message
):
    model = algorithm(policy, gym.make(ENV_ID), device="cpu", **arguments)
    with pytest.raises(ConfigurationError, match=f"cannot be saved as data: .*{message}.*--trust"):
        save_policy(model, tmp_path, problem)
    assert list(tmp_path.iterdir()) == []


def test_layers_that_differ_among_each_other_are_refused(problem, tmp_path):
    model = small()
    model.policy.mlp_extractor.policy_net[1] = NN.ReLU()
    with pytest.raises(ConfigurationError, match="several activations: relu, tanh"):
        save_policy(model, tmp_path, problem)


def test_diverged_policies_and_those_of_other_problems_are_not_saved(problem, tmp_path):
    model = small()
    with pytest.raises(
        ConfigurationError, match="the policy of PPO was trained for another observation space"
    ):
        save_policy(model, tmp_path, make_problem("ACC-v0"))
    with torch.no_grad():
        model.policy.action_net.bias[0] = torch.nan
    with pytest.raises(ConfigurationError, match="not all finite: its training diverged"):
        save_policy(model, tmp_path, problem)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_an_error(problem, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="file cannot be made"):
        save_policy(small(), tmp_path / "file", problem)


def test_policies_of_other_problems_are_errors(saved):
    for env_id, barrier, message in (
        (
            "safe_envs/DubinsDisk-v0",
            None,
            "its system: StochasticDubins, that of DubinsDisk: DubinsDisk",
        ),
        (ENV_ID, {"radius": 5.0}, "its observation: "),
        ("safe_envs/Scalar-v0", None, "its system: "),
    ):
        with pytest.raises(ConfigurationError, match=f"was trained for another problem: {message}"):
            make_policy(str(saved), make_problem(env_id, barrier=barrier))
    make_policy(str(saved), make_problem(ENV_ID, plant={"v": 1.5}, dt=0.01, horizon=1.0))


def test_missing_files_are_errors(copy, problem, tmp_path):
    (copy / "policy.npz").unlink()
    for path in (copy, copy / "policy.npz", tmp_path, tmp_path / "none.npz"):
        with pytest.raises(ConfigurationError, match="does not exist; `safe-envs train` writes"):
            make_policy(str(path), problem)
    (tmp_path / "config.json").touch()
    with pytest.raises(ConfigurationError, match=r"the training in .* is not finished"):
        make_policy(str(tmp_path), problem)
    (tmp_path / "policy.safetensors").touch()
    with pytest.raises(ConfigurationError, match="was saved by an older version"):
        make_policy(str(tmp_path), problem)


def test_other_files_of_this_project_are_no_policies(copy, problem):
    save(copy / "policy.npz", "transitions", Signature.of(problem), {}, {})
    with pytest.raises(ConfigurationError, match="holds transitions, and no policy"):
        make_policy(str(copy), problem)


def rewrite(folder, details=None, arrays=None):
    """Change what a policy holds, under the right checksum."""
    found = load(folder / "policy.npz")
    save(
        folder / "policy.npz",
        found.kind,
        found.signature,
        {**found.details, **(details or {})},
        found.arrays if arrays is None else arrays(found.arrays),
    )


@pytest.mark.parametrize(
    ("details", "message"),
    [
        ({"activation": "relo"}, "did you mean 'relu'"),
        ({"activation": ["tanh"]}, "TypeError"),
        ({"output": "none"}, "output = 'none'"),
        (
            {"normalization": {"mean": [0.0], "var": [1.0], "clip": 1.0, "epsilon": 1e-8}},
            "incomplete or altered",
        ),
        (
            {"normalization": {"mean": 4 * [0.0], "var": 4 * [-1.0], "clip": 1.0, "epsilon": 1e-8}},
            "the normalisation",
        ),
        (
            {"normalization": {"mean": 4 * [0.0], "var": 4 * [1.0], "clip": 0.0, "epsilon": 1e-8}},
            "the normalisation",
        ),
        (
            {"normalization": {"mean": 4 * ["a"], "var": 4 * [1.0], "clip": 1.0, "epsilon": 1e-8}},
            "ValueError",
        ),
        ({"normalization": 1.0}, "TypeError"),
        ({"box": [[-10.0, 10.0], [-10.0, 10.0]]}, "incomplete or altered"),
        ({"box": [[10.0, -10.0]]}, "incomplete or altered"),
        ({"box": 1.0}, "incomplete or altered"),
        ({"features": None}, "its features: None"),
    ],
)
def test_descriptions_that_make_no_sense_are_errors(copy, problem, details, message):
    rewrite(copy, details)
    with pytest.raises(ConfigurationError, match=message):
        make_policy(str(copy), problem)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("weights_0", lambda a: np.full_like(a, np.nan), "finite numbers"),
        ("biases_2", lambda a: np.full_like(a, np.inf), "finite numbers"),
        ("weights_0", lambda a: a[:, :3], "do not fit"),
        ("weights_1", lambda a: a[:, :3], "do not fit"),
        ("biases_0", lambda a: a[:1], "do not fit"),
        ("biases_0", lambda a: a[:, None], "do not fit"),
        ("weights_0", lambda a: a[0], "do not fit"),
        ("input_scale", lambda a: 0.0 * a, "scales above 0"),
        ("biases_1", lambda a: None, "KeyError"),
    ],
)
def test_arrays_that_make_no_sense_are_errors(copy, problem, name, change, message):
    def arrays(found):
        changed = {**found, f"actor_{name}": change(found[f"actor_{name}"])}
        return {key: value for key, value in changed.items() if value is not None}

    rewrite(copy, arrays=arrays)
    with pytest.raises(ConfigurationError, match=message):
        make_policy(str(copy), problem)


def test_a_pickle_in_the_place_of_a_policy_is_not_loaded(copy, problem):
    torch.save({"actor_weights_0": torch.zeros(8, 4)}, copy / "policy.npz")
    with pytest.raises(ConfigurationError, match="no file of `safe-envs train`"):
        make_policy(str(copy), problem)
