"""Policies that Stable-Baselines3 saved."""

from __future__ import annotations

import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3

from safe_envs import ConfigurationError
from safe_envs.agents import evaluate, make_policy, make_problem, refine

pytestmark = pytest.mark.slow

ENV_ID = "safe_envs/StochasticDubins-v0"
OPTIONS = {"horizon": 0.5}
OFF_POLICY = {"buffer_size": 500, "learning_starts": 50, "batch_size": 16}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Models that learned a little, and their files."""
    folder = tmp_path_factory.mktemp("models")
    models = {
        "ppo": PPO(
            "MlpPolicy",
            gym.make(ENV_ID, **OPTIONS),
            n_steps=128,
            batch_size=64,
            n_epochs=2,
            learning_rate=0.01,
            device="cpu",
            seed=0,
        ),
        "sac": SAC(
            "MlpPolicy",
            gym.make(ENV_ID, **OPTIONS),
            **OFF_POLICY,
            learning_rate=0.01,
            device="cpu",
            seed=0,
        ),
    }
    models["ppo"].learn(256)
    models["sac"].learn(120)
    for name, model in models.items():
        model.save(folder / f"{name}.zip")
    return {name: (model, str(folder / f"{name}.zip")) for name, model in models.items()}


def saved(tmp_path, algorithm, env, **arguments):
    path = tmp_path / "model.zip"
    model = algorithm("MlpPolicy", env, device="cpu", **arguments)
    model.save(path)
    return model, str(path)


def observations(count):
    rng = np.random.default_rng(0)
    problem = make_problem(ENV_ID)
    low, high = np.array([(f.low, f.high) for f in problem.features]).T
    return rng.uniform(low, high, (count, len(low))).astype(np.float32)


def assert_predicts_like(model, policy):
    for given in (observations(300), observations(1), observations(1)[0]):
        wanted, _ = model.predict(given, deterministic=True)
        actions, state = policy.predict(given, "passed on")
        assert actions.shape == wanted.shape
        assert state == "passed on"
        np.testing.assert_allclose(actions, wanted, rtol=1e-5, atol=1e-6)
    assert np.ptp(policy.predict(observations(300))[0]) > 0


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_loaded_policy_predicts_like_the_model(trained, name):
    model, path = trained[name]
    assert_predicts_like(model, make_policy(path, make_problem(ENV_ID), trust=True))


@pytest.mark.parametrize(
    ("algorithm", "arguments"),
    [
        (A2C, {}),
        (
            PPO,
            {"use_sde": True, "policy_kwargs": {"net_arch": [8], "activation_fn": torch.nn.ReLU}},
        ),
        (SAC, {"use_sde": True, **OFF_POLICY}),
        (TD3, OFF_POLICY),
        (DDPG, {**OFF_POLICY, "policy_kwargs": {"net_arch": [16, 16]}}),
    ],
)
def test_every_algorithm_with_continuous_actions_is_loaded(tmp_path, algorithm, arguments):
    model, path = saved(tmp_path, algorithm, gym.make(ENV_ID), **arguments)
    assert_predicts_like(model, make_policy(path, make_problem(ENV_ID), trust=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_evaluation_is_the_same_for_every_num_envs(trained, name):
    _, path = trained[name]
    answers = [
        evaluate(
            ENV_ID,
            path,
            ["none", "scbf"],
            trust=True,
            options={"horizon": 0.15},
            episodes=140,
            seed=2,
            num_envs=n,
            record=True,
            bounds=False,
        )
        for n in (1000, 9, 130)
    ]
    for other in answers[1:]:
        assert other.rows == answers[0].rows
        assert other.config == answers[0].config
        for filter_name, recorder in answers[0].trajectories.items():
            assert recorder.states.tobytes() == other.trajectories[filter_name].states.tobytes()
    few = [
        evaluate(
            ENV_ID,
            path,
            ["none"],
            trust=True,
            options=OPTIONS,
            episodes=12,
            seed=2,
            num_envs=n,
            bounds=False,
        ).rows
        for n in (1, 12)
    ]
    assert few[0] == few[1]


def test_an_episode_keeps_its_row_of_a_network_call(trained):
    # Rounding may depend on the size of a batch and on the row: here both do so coarsely.
    class Coarse:
        def predict(self, rows, state, start, deterministic):
            sizes.add(len(rows))
            return (
                np.linspace(-1.0, 1.0, len(rows), dtype=np.float32)[:, None] + 0.0 * rows[:, :1],
                None,
            )

    sizes = set()
    policy = make_policy(trained["ppo"][1], make_problem(ENV_ID), trust=True)
    policy._model = Coarse()
    rows = [
        evaluate(
            ENV_ID,
            policy,
            ["none"],
            options={"horizon": 0.1},
            episodes=200,
            num_envs=n,
            bounds=False,
        ).rows
        for n in (200, 1, 7, 128, 130)
    ]
    assert all(other == rows[0] for other in rows)
    assert len(sizes) == 1


def test_evaluation_of_a_file_and_of_the_model_agree(trained):
    model, path = trained["ppo"]
    by_file, by_model = (
        evaluate(ENV_ID, policy, trust=True, options=OPTIONS, episodes=20, bounds=False)
        for policy in (path, model)
    )
    for a, b in zip(by_file.rows, by_model.rows, strict=True):
        assert (a.policy, b.policy) == (path, "PPO")
        assert (a.safe, a.episodes) == (b.safe, b.episodes)
        assert a.return_mean == pytest.approx(b.return_mean, rel=1e-4)
    assert len(by_file.config["policy"]["sha256"]) == 64
    assert (
        evaluate(ENV_ID, path, trust=True, options=OPTIONS, episodes=1, bounds=False).config[
            "policy"
        ]
        == by_file.config["policy"]
    )


class Bomb:
    """Runs code where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_file_is_loaded_only_where_it_is_trusted(trained, tmp_path):
    problem, _, path = make_problem(ENV_ID), *trained["ppo"]
    model = PPO.load(path, device="cpu")
    model.bomb = Bomb(tmp_path / "exploded")
    model.save(tmp_path / "bomb.zip")
    for ask in (
        lambda: make_policy(str(tmp_path / "bomb.zip"), problem),
        lambda: evaluate(ENV_ID, str(tmp_path / "bomb.zip"), episodes=1),
        lambda: refine(ENV_ID, str(tmp_path / "bomb.zip"), episodes=1),
    ):
        with pytest.raises(
            ConfigurationError,
            match=r"bomb\.zip runs code that it contains; if you trust its source, pass --trust",
        ):
            ask()
    assert not (tmp_path / "exploded").exists()
    make_policy(str(tmp_path / "bomb.zip"), problem, trust=True)
    assert (tmp_path / "exploded").exists()
    refined = refine(
        ENV_ID, path, trust=True, filters=["none"], options={"horizon": 0.1}, episodes=1
    )
    assert len(refined.evaluations) == 3


def test_missing_files_and_files_of_another_kind_are_errors(tmp_path):
    problem = make_problem(ENV_ID)
    with pytest.raises(ConfigurationError, match="there is no such file"):
        make_policy(str(tmp_path / "none.zip"), problem)
    text = tmp_path / "text.zip"
    text.write_text("no archive")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("readme.txt", "an archive of something else")
    for path in (text, tmp_path / "other.zip"):
        with pytest.raises(ConfigurationError, match="not a policy that Stable-Baselines3 saved"):
            make_policy(str(path), problem)


@pytest.mark.parametrize(
    "changed",
    [
        {"data": b"no JSON"},
        {"data": b"[]"},
        {"data": b"{}"},
        {"data": b'{"policy_class": "x", "observation_space": 1, "action_space": 2}'},
        {"policy.pth": b"no weights"},
        {"policy.pth": None},
    ],
    ids=[
        "data no JSON",
        "data a list",
        "data empty",
        "data of other types",
        "weights garbage",
        "weights missing",
    ],
)
def test_damaged_archives_are_errors(trained, tmp_path, changed):
    with zipfile.ZipFile(trained["ppo"][1]) as archive:
        contents = {**{name: archive.read(name) for name in archive.namelist()}, **changed}
    path = tmp_path / "damaged.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in contents.items():
            if content is not None:
                archive.writestr(name, content)
    with pytest.raises(ConfigurationError, match=r"damaged\.zip"):
        make_policy(str(path), make_problem(ENV_ID), trust=True)


def test_policies_for_other_spaces_are_errors(trained, tmp_path):
    _, path = trained["ppo"]
    with pytest.raises(ConfigurationError, match="another observation space"):
        make_policy(path, make_problem("safe_envs/ACCGap-v0"), trust=True)
    with pytest.raises(ConfigurationError, match="another observation space, between"):
        make_policy(path, make_problem(ENV_ID, barrier={"radius": 5.0}), trust=True)
    with pytest.raises(ConfigurationError, match="another observation space"):
        evaluate("safe_envs/Scalar-v0", path, trust=True, episodes=1)


@pytest.mark.parametrize(
    "space",
    [gym.spaces.Box(-2.0, 2.0, (1,)), gym.spaces.Box(-1.0, 1.0, (2,)), gym.spaces.Discrete(3)],
)
def test_policies_for_other_actions_are_errors(tmp_path, space):
    env = gym.make(ENV_ID).unwrapped
    env.action_space = space
    _, path = saved(tmp_path, PPO, env)
    with pytest.raises(ConfigurationError, match="another action space"):
        make_policy(path, make_problem(ENV_ID), trust=True)
