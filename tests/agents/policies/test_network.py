"""Trained policies as data: what a model does, in any env of its problem, from a file that may come
from anybody."""

from __future__ import annotations

import hashlib
import os
import shutil

import gymnasium as gym
import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate, make_policy, make_problem, make_sb3_env, refine
from safe_envs.agents.policies.base import BLOCK
from safe_envs.agents.policies.network import load_policy, save_policy
from safe_envs.envs.spaces import center_and_half_width
from safe_envs.errors import InvalidInputError
from safe_envs.filters.learning.data import Signature, load, save

pytestmark = pytest.mark.slow

ENV_ID, PENDULUM = "safe_envs/StochasticDubins-v0", "safe_envs/Pendulum-v0"
OFF_POLICY = {"buffer_size": 10}
NN = torch.nn


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


def net(activation, arch):
    return {"policy_kwargs": {"net_arch": arch, "activation_fn": activation}}


@pytest.mark.parametrize(
    ("algorithm", "arguments"),
    [
        (PPO, {}),
        *((each, OFF_POLICY) for each in (SAC, TD3, DDPG)),
        *((PPO, net(each, {"pi": [16, 8], "vf": [4]})) for each in (NN.ReLU, NN.LeakyReLU, NN.ELU)),
        (A2C, net(NN.SiLU, [8])),
        (PPO, {"policy_kwargs": {"net_arch": [], "share_features_extractor": False}}),
        (SAC, {**OFF_POLICY, "policy_kwargs": {"net_arch": []}}),
        (A2C, {"use_sde": True, "policy_kwargs": {"squash_output": True}}),
        (PPO, {"use_sde": True}),
    ],
)
def test_policies_predict_like_their_models(problem, tmp_path, algorithm, arguments):
    model = small(algorithm, **arguments)
    save_policy(model, tmp_path / "new" / "folder", problem)
    assert_predicts_like(model, load_policy(tmp_path / "new" / "folder", problem), problem)
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
    first = load(tmp_path / "policy.npz").sha256
    assert_predicts_like(model, load_policy(tmp_path, problem), problem, envs.normalize_obs)
    assert np.abs(envs.normalize_obs(observations(problem))).max() == 1.5
    envs.norm_obs = False
    save_policy(model, tmp_path, problem, envs)
    assert_predicts_like(model, load_policy(tmp_path, problem), problem)
    assert load(tmp_path / "policy.npz").sha256 != first


def test_an_agent_that_is_trained_on_measurements_knows_of_which(tmp_path):
    measured = {"measurement": ["default", "twice=2*theta:noise=.1", "delay=1"]}
    env, problem = make_sb3_env(PENDULUM, 2, **measured), make_problem(PENDULUM, **measured)
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=0)
    save_policy(model, tmp_path, problem)
    seen, policy = env.reset(), load_policy(tmp_path, problem)
    wanted, _ = model.predict(seen, deterministic=True)
    np.testing.assert_allclose(policy.predict(seen)[0], wanted, atol=1e-5)
    for other in ({}, {"measurement": "default"}, {"measurement": ["default", "b=theta:noise=.2"]}):
        with pytest.raises(ConfigurationError, match="another problem"):
            load_policy(tmp_path, make_problem(PENDULUM, **other))


def test_evaluation_is_the_same_for_every_num_envs(saved, problem):
    given = {"options": {"horizon": 0.15}, "episodes": 131, "bounds": False, "record": True}
    first, *others = (
        evaluate(ENV_ID, str(saved), ["none", "scbf"], num_envs=n, **given) for n in (1000, 9, 130)
    )
    for other in others:
        assert (other.rows, other.config) == (first.rows, first.config)
        for name, recorder in first.trajectories.items():
            assert recorder.states.tobytes() == other.trajectories[name].states.tobytes()
    policy, many = make_policy(str(saved), problem), observations(problem)
    whole = policy.predict(many)[0]
    for start, count in ((0, 1), (1, 1), (7, 130), (BLOCK, 40), (250, 50)):
        rows = slice(start, start + count)
        policy.begin(range(start, start + count), seed=0)
        assert policy.predict(many[rows])[0].tobytes() == whole[rows].tobytes()


def test_the_folder_holds_a_file_that_says_what_it_is(saved, problem):
    assert [path.name for path in saved.iterdir()] == ["policy.npz"]
    found = load(saved / "policy.npz")
    assert (found.kind, found.details["activation"]) == ("policy", "tanh")
    assert found.signature == Signature.of(problem)
    by_folder, by_file = (make_policy(str(p), problem) for p in (saved, saved / "policy.npz"))
    many = observations(problem)
    np.testing.assert_array_equal(by_folder.predict(many)[0], by_file.predict(many)[0])
    digest = hashlib.sha256((saved / "policy.npz").read_bytes()).hexdigest()
    short = {"options": {"horizon": 0.1}, "episodes": 2}
    answer = evaluate(ENV_ID, str(saved), ["none"], **short)
    assert answer.config["policy"] == {"name": str(saved), "sha256": digest}
    assert len(refine(ENV_ID, str(saved), filters=["none"], **short).evaluations) == 3


QUADROTOR = "safe_envs/Quadrotor-v0"
BOXES = {ENV_ID: (-10.0, 10.0), QUADROTOR: [(0.0, 20.0), (-1.0, 1.0), (-0.5, 1.0), (-0.1, 0.1)]}


@pytest.fixture(
    scope="module",
    params=[(ENV_ID, PPO, {}), (QUADROTOR, SAC, OFF_POLICY)],
    ids=["ppo, m = 1", "sac, m = 4"],
)
def trained(request, tmp_path_factory):
    """A policy whose actions reach their bounds: the env's id and the folder."""
    env_id, algorithm, arguments = request.param
    folder, env = tmp_path_factory.mktemp("trained"), gym.make(env_id, input_bounds=BOXES[env_id])
    model = algorithm("MlpPolicy", env, device="cpu", seed=0, **arguments)
    last = model.policy.action_net if algorithm is PPO else model.policy.actor.mu
    with torch.no_grad():
        last.weight.mul_(300.0 if algorithm is PPO else 30.0)
    save_policy(model, folder, make_problem(env_id, input_bounds=BOXES[env_id]))
    return env_id, folder


def actions_in(trained, low, high):
    """What the policy does in a box: actions, and the inputs for which they stand there."""
    env_id, folder = trained
    problem = make_problem(env_id, input_bounds=np.transpose([low, high]).tolist())
    actions = make_policy(str(folder), problem).predict(observations(problem))[0]
    center, half = center_and_half_width(problem)
    return actions, center + np.array(half) * actions


@pytest.mark.parametrize(
    "change",
    [
        lambda low, high: (low + 0.45 * (high - low), high - 0.15 * (high - low)),
        lambda low, high: (3.0 * low - 1.0, 2.0 * high),
        lambda low, high: (high, high + 1.0),
    ],
    ids=["narrower", "wider", "beside"],
)
def test_another_box_gets_the_same_inputs_or_the_nearest_ones(trained, change):
    low, high = np.array(make_problem(trained[0], input_bounds=BOXES[trained[0]]).input_bounds).T
    least, most = change(low, high)
    alike, wanted = actions_in(trained, low, high)
    actions, found = actions_in(trained, least, most)
    assert (actions.dtype, actions.shape) == (np.float32, wanted.shape)
    assert np.abs(actions).max() <= 1.0
    assert (np.ptp(wanted, axis=0) > 0.8 * (high - low)).all()
    tolerance = 1e-6 * (high - low).max()
    np.testing.assert_allclose(found, np.clip(wanted, least, most), rtol=0, atol=tolerance)
    # An input with the same range keeps its actions.
    first = np.arange(len(low)) == 0
    mixed, _ = actions_in(
        trained, np.where(first, 1.5 * low, low), np.where(first, 1.5 * high, high)
    )
    np.testing.assert_allclose(mixed[:, 1:], alike[:, 1:], rtol=0, atol=1e-7)
    assert np.abs(mixed[:, 0] - alike[:, 0]).max() > 0.1


class Halved(FlattenExtractor):
    """Another extractor of features, though of the same width."""

    def forward(self, observations):
        return 0.5 * super().forward(observations)


class Derived(ActorCriticPolicy):
    """A policy class of somebody's own."""


def diverged(model):
    with torch.no_grad():
        model.policy.action_net.bias[0] = torch.nan


def mixed_activations(model):
    model.policy.mlp_extractor.policy_net[1] = NN.ReLU()


@pytest.mark.parametrize(
    ("model", "change", "fragment"),
    [
        ((PPO, Derived, {}), None, "Derived"),
        ((PPO, "MlpPolicy", {"features_extractor_class": Halved}), None, "Halved"),
        ((PPO, "MlpPolicy", {"activation_fn": NN.Softplus}), None, "Softplus"),
        ((PPO, "MlpPolicy", {"activation_fn": lambda: NN.ELU(0.5)}), None, r"ELU\(alpha=0\.5\)"),
        ((SAC, "MlpPolicy", None), None, "Sequential"),
        ((PPO, "MlpPolicy", {}), mixed_activations, "relu, tanh"),
        ((PPO, "MlpPolicy", {}), diverged, "diverged"),
    ],
)
def test_policies_that_numbers_do_not_describe_are_not_saved(
    problem, tmp_path, model, change, fragment
):
    algorithm, policy, kwargs = model
    arguments = {"use_sde": True, **OFF_POLICY} if kwargs is None else {"policy_kwargs": kwargs}
    made = algorithm(policy, gym.make(ENV_ID), device="cpu", **arguments)
    if change is not None:
        change(made)
    with pytest.raises(ConfigurationError, match=fragment):
        save_policy(made, tmp_path, problem)
    assert list(tmp_path.iterdir()) == []


def test_policies_of_other_problems_are_errors(saved, problem, tmp_path):
    for env_id, barrier, fragment in (
        ("safe_envs/DubinsDisk-v0", None, "StochasticDubins, that of DubinsDisk"),
        (ENV_ID, {"radius": 5.0}, "its observation: "),
        ("safe_envs/Scalar-v0", None, "its system: "),
    ):
        with pytest.raises(ConfigurationError, match=f"another problem: .*{fragment}"):
            make_policy(str(saved), make_problem(env_id, barrier=barrier))
    make_policy(str(saved), make_problem(ENV_ID, plant={"v": 1.5}, dt=0.01, horizon=1.0))
    with pytest.raises(InvalidInputError, match=r"\(4,\) or \(B, 4\)"):
        make_policy(str(saved), problem).predict(np.zeros((2, 3)))
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="file"):
        save_policy(small(), tmp_path / "file", problem)


def test_missing_files_are_errors(copy, problem, tmp_path):
    (copy / "policy.npz").unlink()
    for path in (copy, copy / "policy.npz", tmp_path, tmp_path / "none.npz"):
        with pytest.raises(ConfigurationError, match="does not exist"):
            make_policy(str(path), problem)
    (tmp_path / "config.json").touch()
    with pytest.raises(ConfigurationError, match="not finished"):
        make_policy(str(tmp_path), problem)
    (tmp_path / "policy.safetensors").touch()
    with pytest.raises(ConfigurationError, match="older version"):
        make_policy(str(tmp_path), problem)
    for name in ("x" * 300, "x/" * 3000, "x" * 10**5, "a\0b"):
        with pytest.raises(ConfigurationError, match=r"unknown policy|no such file") as raised:
            make_policy(name, problem)
        assert len(str(raised.value)) < 500


def moments(**changes):
    good = {"mean": 4 * [0.0], "var": 4 * [1.0], "clip": 1.0, "epsilon": 1e-8}
    return {"normalization": {**good, **changes}}


@pytest.mark.parametrize(
    ("details", "fragment"),
    [
        ({"activation": "relo"}, "'relu'"),
        ({"activation": ["tanh"]}, "TypeError"),
        ({"output": "none"}, "output = 'none'"),
        (moments(mean=[0.0], var=[1.0]), "incomplete or altered"),
        (moments(var=4 * [-1.0]), "the normalisation"),
        (moments(clip=0.0), "the normalisation"),
        (moments(mean=4 * ["a"]), "ValueError"),
        ({"box": [[-10.0, 10.0], [-10.0, 10.0]]}, "incomplete or altered"),
        ({"box": [[10.0, -10.0]]}, "incomplete or altered"),
        ({"features": None}, "its features: None"),
        (("weights_0", lambda a: np.full_like(a, np.nan)), "finite numbers"),
        (("biases_2", lambda a: np.full_like(a, np.inf)), "finite numbers"),
        (("weights_0", lambda a: a[:, :3]), "do not fit"),
        (("biases_0", lambda a: a[:1]), "do not fit"),
        (("weights_0", lambda a: a[0]), "do not fit"),
        (("input_scale", lambda a: 0.0 * a), "scales above 0"),
        (("biases_1", None), "KeyError"),
    ],
)
def test_content_that_makes_no_sense_is_refused(copy, problem, details, fragment):
    """Under the right checksum."""
    found = load(copy / "policy.npz")
    arrays = dict(found.arrays)
    if isinstance(details, tuple):
        name, change = details
        array = arrays.pop(f"actor_{name}")
        if change is not None:
            arrays[f"actor_{name}"] = change(array)
        details = {}
    details = {**found.details, **details}
    save(copy / "policy.npz", found.kind, found.signature, details, arrays)
    with pytest.raises(ConfigurationError, match=fragment):
        make_policy(str(copy), problem)


def test_other_files_and_pickles_are_no_policies(copy, problem):
    path = copy / "policy.npz"
    save(path, "transitions", Signature.of(problem), {}, {})
    with pytest.raises(ConfigurationError, match="transitions"):
        make_policy(str(copy), problem)
    torch.save({"actor_weights_0": torch.zeros(8, 4)}, path)
    with pytest.raises(ConfigurationError, match="no file of `safe-envs train`"):
        make_policy(str(copy), problem)
    for make in (
        lambda: os.mkfifo(path),
        lambda: path.symlink_to("/dev/zero"),
        lambda: (path.touch(), os.truncate(path, 10**12)),
    ):
        path.unlink()
        make()
        with pytest.raises(ConfigurationError, match=r"policy\.npz cannot be read: it is "):
            load_policy(copy, problem)


def damaged(data, whole):
    """Bytes with a few others in their place, or without a part."""
    found = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 3))):
        found[data.draw(st.integers(0, len(found) - 1))] = data.draw(st.integers(0, 255))
    begin, length = data.draw(st.integers(0, len(found))), data.draw(st.integers(0, 30))
    return bytes(found[:begin] + found[begin + length :])


odd = st.none() | st.floats() | st.integers() | st.text(max_size=3)
odd |= st.lists(st.floats(), max_size=4) | st.dictionaries(st.text(max_size=3), odd, max_size=2)


def changed(data, details, arrays):
    """Put something odd in the place of a detail, of a number, or of the shape of an array."""
    name = data.draw(st.sampled_from(sorted([*details, *arrays])))
    if name in details:
        details[name] = data.draw(odd)
    else:
        array = arrays.pop(name).astype(data.draw(st.sampled_from(["f4", "f8", "i4"])))
        if data.draw(st.booleans()):
            array = array.ravel()[: data.draw(st.integers(0, array.size))]
        elif array.dtype != np.int32:
            array.flat[data.draw(st.integers(0, array.size - 1))] = data.draw(st.floats())
        arrays[name] = array
    return details, arrays


@hypothesis.settings(
    max_examples=50, suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture]
)
@hypothesis.given(data=st.data())
def test_a_damaged_policy_is_the_same_or_refused_and_never_acts_beyond_the_box(
    saved, problem, tmp_path, data
):
    """The file itself is read by `safe_envs.filters.learning.data`; see its tests."""
    content, path = load(saved / "policy.npz"), tmp_path / "policy.npz"
    in_bytes = data.draw(st.booleans())
    if in_bytes:
        path.write_bytes(damaged(data, (saved / "policy.npz").read_bytes()))
    else:  # under the right checksum
        parts = changed(data, dict(content.details), dict(content.arrays))
        try:
            save(path, content.kind, content.signature, *parts)
        except ValueError:  # no JSON
            hypothesis.reject()
    try:
        policy, message = load_policy(path, problem), ""
    except ConfigurationError as error:
        policy, message = None, str(error)
    assert len(message) < 1500
    if policy is not None:
        many = observations(problem, 2)
        actions = policy.predict(many)[0]
        assert (abs(actions) <= 1.0).all()
        if in_bytes:
            np.testing.assert_array_equal(actions, load_policy(saved, problem).predict(many)[0])
