"""Models of Stable-Baselines3, as objects and as files: what they were trained on is used where it
can be, and refused where not."""

from __future__ import annotations

import dataclasses
import io
import os
import pickle
import sys
import types
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.save_util import save_to_zip_file
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize

from safe_envs import ConfigurationError, InvalidInputError, SystemDefinitionWarning
from safe_envs.agents import evaluate, make_policy, make_problem, make_sb3_env, refine
from safe_envs.agents.policies.names import statistics_file
from safe_envs.agents.policies.network import load_policy, save_policy
from safe_envs.envs.spaces import action_box, observation_box
from safe_envs.plugins import load_object
from safe_envs.wrappers import SafetyFilterWrapper

pytestmark = pytest.mark.slow

ENV_ID = "safe_envs/StochasticDubins-v0"
PROBLEM = make_problem(ENV_ID)
PROBLEM_SPACES = observation_box(PROBLEM), action_box(PROBLEM)
OBSERVATIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (150, 4)).astype(np.float32)
SHORT = {"episodes": 3, "options": {"horizon": 0.2}, "bounds": False, "best": False}
OFF_POLICY = {"buffer_size": 100, "learning_starts": 10, "batch_size": 8}


def single():
    return gym.make(ENV_ID, horizon=0.5)


def normalized(**arguments):
    return VecNormalize(DummyVecEnv([single]), **arguments)


def ppo(env, policy="MlpPolicy", **arguments):
    net = {"net_arch": [8]}
    model = PPO(policy, env, n_steps=32, batch_size=32, n_epochs=1, policy_kwargs=net, device="cpu")
    return model.learn(32, **arguments)


def sac(env, **arguments):
    net = {"net_arch": [8]}
    model = SAC("MlpPolicy", env, policy_kwargs=net, device="cpu", **OFF_POLICY)
    return model.learn(32, **arguments)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    model, path = ppo(single()), tmp_path_factory.mktemp("trained") / "ppo.zip"
    model.save(path)
    return model, str(path)


def acted(given, problem=PROBLEM):
    return make_policy(given, problem, trust=True).predict(OBSERVATIONS)[0]


def assert_same(given, wanted):
    np.testing.assert_allclose(acted(given), wanted, rtol=1e-5, atol=1e-6)


def plain_actions(model, observations=OBSERVATIONS):
    return model.predict(observations, deterministic=True)[0]


RELU = {"net_arch": [8], "activation_fn": torch.nn.ReLU}


@pytest.mark.parametrize(
    ("algorithm", "arguments"),
    [
        (PPO, {}),
        (A2C, {}),
        (PPO, {"use_sde": True, "policy_kwargs": RELU}),
        (SAC, OFF_POLICY),
        (SAC, {"use_sde": True, **OFF_POLICY}),
        (TD3, OFF_POLICY),
        (DDPG, {**OFF_POLICY, "policy_kwargs": {"net_arch": [16, 16]}}),
    ],
)
def test_every_algorithm_with_continuous_actions_is_loaded(tmp_path, algorithm, arguments):
    model = algorithm("MlpPolicy", single(), device="cpu", seed=0, **arguments)
    model.save(tmp_path / "model.zip")
    policy = make_policy(str(tmp_path / "model.zip"), PROBLEM, trust=True)
    for given in (OBSERVATIONS, OBSERVATIONS[:1], OBSERVATIONS[0]):
        actions, state = policy.predict(given, "passed on")
        assert state == "passed on"
        assert actions.shape == plain_actions(model, given).shape
        np.testing.assert_allclose(actions, plain_actions(model, given), rtol=1e-5, atol=1e-6)
    assert np.ptp(acted(model)) > 0


def test_an_episode_keeps_its_row_of_a_network_call(trained):
    # Rounding may depend on the size of a batch and on the row: here both do so coarsely.
    class Coarse:
        def predict(self, rows, state, start, deterministic):
            sizes.add(len(rows))
            return np.linspace(-1.0, 1.0, len(rows), dtype="f4")[:, None] + 0.0 * rows[:, :1], None

    sizes = set()
    policy = make_policy(trained[1], PROBLEM, trust=True)
    policy._model = Coarse()
    given = {"options": {"horizon": 0.1}, "episodes": 200, "bounds": False}
    rows = [evaluate(ENV_ID, policy, ["none"], num_envs=n, **given).rows for n in (200, 1, 7, 130)]
    assert all(other == rows[0] for other in rows)
    assert len(sizes) == 1


def test_evaluations_of_a_file_and_of_the_model_agree(tmp_path):
    scaled = normalized()
    model, path = ppo(scaled), str(tmp_path / "model.zip")
    model.save(path)
    scaled.save(tmp_path / "vecnormalize.pkl")
    by_file, by_model = (evaluate(ENV_ID, p, trust=True, **SHORT) for p in (path, model))
    for a, b in zip(by_file.rows, by_model.rows, strict=True):
        assert (a.policy, b.policy) == (path, "PPO")
        assert (a.safe, a.episodes) == (b.safe, b.episodes)
        assert a.return_mean == pytest.approx(b.return_mean, rel=1e-4)
    policy = by_file.config["policy"]
    assert (len(policy["sha256"]), len(policy["statistics_sha256"])) == (64, 64)
    assert evaluate(ENV_ID, path, trust=True, **SHORT).config["policy"] == policy


class Bomb:
    """Runs code where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_file_is_loaded_only_where_it_is_trusted(trained, tmp_path):
    model = PPO.load(trained[1], device="cpu")
    model.bomb = Bomb(tmp_path / "exploded")
    path = str(tmp_path / "bomb.zip")
    model.save(path)
    for ask in (
        lambda: make_policy(path, PROBLEM),
        lambda: evaluate(ENV_ID, path, episodes=1),
        lambda: refine(ENV_ID, path, episodes=1),
    ):
        with pytest.raises(ConfigurationError, match=r"bomb\.zip .*--trust"):
            ask()
    assert not (tmp_path / "exploded").exists()
    make_policy(path, PROBLEM, trust=True)
    assert (tmp_path / "exploded").exists()


def archive_of(**parts):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name.replace("_", "."), content)
    return stream.getvalue()


BOMB = archive_of(data=bytes(101_000_000), policy_pth=b"")
SPACES = b'{"policy_class": "x", "observation_space": 1, "action_space": 2}'
NO_POLICY, NOT_READ = "is not a policy", "cannot be read as a policy"
ARCHIVES = {
    "empty": (b"", NO_POLICY),
    "text": (b"no archive", NO_POLICY),
    "nothing": (b"PK\5\6" + bytes(18), NO_POLICY),
    "other": (archive_of(readme_txt=b"an archive of something else"), NO_POLICY),
    "directory": (
        archive_of(data=b"{}", policy_pth=b"").replace(b"PK\1\2", b"PK\0\2"),
        NO_POLICY,
    ),
    "truncated": (archive_of(data=b"{}", policy_pth=b"\0" * 1000)[:-100], NO_POLICY),
    "bomb": (BOMB, NO_POLICY),
    "bomb within": (archive_of(data=b"{}", policy_pth=BOMB), NO_POLICY),
    **{
        f"data {data[:20]!r}": (archive_of(data=data, policy_pth=b"no tensors"), NOT_READ)
        for data in (b"{}", b"[]", b"no JSON", b"9" * 5000, SPACES)
    },
    "serialized": (
        archive_of(data=b'{"policy_class": {":serialized:": "x"}}', policy_pth=b""),
        NOT_READ,
    ),
}


@pytest.mark.parametrize(("content", "fragment"), ARCHIVES.values(), ids=ARCHIVES)
def test_archives_that_are_damaged_or_bombs_are_refused(tmp_path, content, fragment):
    assert len(content) < 200_000
    (tmp_path / "policy.zip").write_bytes(content)
    with pytest.raises(ConfigurationError, match=rf"policy\.zip.*{fragment}"):
        make_policy(str(tmp_path / "policy.zip"), PROBLEM, trust=True)


@pytest.mark.parametrize("weights", [b"no weights", None])
def test_a_model_without_its_weights_is_refused(trained, tmp_path, weights):
    with zipfile.ZipFile(trained[1]) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()} | {
            "policy.pth": weights
        }
    with zipfile.ZipFile(tmp_path / "damaged.zip", "w") as archive:
        for name, content in contents.items():
            if content is not None:
                archive.writestr(name, content)
    with pytest.raises(ConfigurationError, match=r"damaged\.zip"):
        make_policy(str(tmp_path / "damaged.zip"), PROBLEM, trust=True)


def test_files_that_are_none(tmp_path):
    with pytest.raises(ConfigurationError, match=r"none\.zip"):
        make_policy(str(tmp_path / "none.zip"), PROBLEM)
    os.mkfifo(tmp_path / "pipe.zip")
    with pytest.raises(ConfigurationError, match=NO_POLICY):
        make_policy(str(tmp_path / "pipe.zip"), PROBLEM, trust=True)


def test_statistics_of_observations_are_used_wherever_they_are(tmp_path):
    scaled = normalized()
    model, path = ppo(scaled), tmp_path / "model.zip"
    wanted = plain_actions(model, scaled.normalize_obs(OBSERVATIONS))
    assert np.abs(wanted - plain_actions(model)).max() > 1e-3
    assert_same(model, wanted)
    model.save(path)
    scaled.save(tmp_path / "vecnormalize.pkl")
    assert_same(str(path), wanted)
    save_policy(model, tmp_path / "folder", PROBLEM)
    assert_same(str(tmp_path / "folder"), wanted)
    again = VecNormalize.load(str(tmp_path / "vecnormalize.pkl"), DummyVecEnv([single]))
    assert_same(type(model).load(path, env=again), wanted)
    copied = pickle.loads(pickle.dumps(make_policy(str(path), PROBLEM, True)))
    np.testing.assert_array_equal(copied.predict(OBSERVATIONS)[0], acted(model))
    # A later training does not change what was made.
    policy = make_policy(model, PROBLEM)
    scaled.obs_rms.update(np.full((1000, 4), 5.0))
    np.testing.assert_allclose(policy.predict(OBSERVATIONS)[0], wanted, rtol=1e-5, atol=1e-6)


def test_a_model_without_its_statistics_is_refused(tmp_path):
    path = tmp_path / "model.zip"
    ppo(normalized()).save(path)
    loaded = PPO.load(path, device="cpu")
    bare = PPO.load(path, env=single(), device="cpu")
    for given in (str(path), loaded, bare):
        with pytest.raises(ConfigurationError, match="VecNormalize"):
            acted(given)
    with pytest.raises(ConfigurationError, match="VecNormalize"):
        save_policy(loaded, tmp_path / "folder", PROBLEM)
    # The way out, and a training that goes on without.
    assert_same(loaded.policy, plain_actions(loaded))
    bare.learn(32)
    assert_same(bare, plain_actions(bare))
    # Normalised rewards alone change nothing.
    scaled = normalized(norm_obs=False)
    model = ppo(scaled)
    assert_same(model, plain_actions(model))
    model.save(path)
    scaled.save(tmp_path / "vecnormalize.pkl")
    assert_same(str(path), plain_actions(model))


def test_checkpoints_have_statistics_of_their_own(tmp_path):
    class Remember(CheckpointCallback):
        def _on_step(self):
            answer = super()._on_step()
            if self.n_calls % self.save_freq == 0:
                rows = scaled.normalize_obs(OBSERVATIONS)
                wanted[self.num_timesteps] = plain_actions(self.model, rows)
            return answer

    wanted, scaled = {}, normalized()
    sac(scaled, callback=Remember(16, tmp_path, save_vecnormalize=True))
    assert len(wanted) == 2
    for steps, actions in wanted.items():
        assert_same(str(tmp_path / f"rl_model_{steps}_steps.zip"), actions)
    (tmp_path / "rl_model_vecnormalize_32_steps.pkl").unlink()
    (tmp_path / "rl_model_16_steps.zip").rename(tmp_path / "best_model.zip")
    for name in ("rl_model_32_steps.zip", "best_model.zip"):
        with pytest.raises(ConfigurationError, match="not clear which statistics"):
            acted(str(tmp_path / name))


@pytest.mark.parametrize(
    ("model", "files", "found"),
    [
        ("model", ["vecnormalize.pkl"], "vecnormalize.pkl"),
        ("model", ["normalization.pkl"], "normalization.pkl"),
        ("best_model", ["Env-v0/vecnormalize.pkl", "Env-v0/args.yml"], "Env-v0/vecnormalize.pkl"),
        ("a", ["a_vecnormalize.pkl", "b_vecnormalize.pkl", "b.zip"], "a_vecnormalize.pkl"),
        ("a", ["vec_normalize_a.pkl", "vecnormalize.pkl"], "vec_normalize_a.pkl"),
        ("rl_model_9_steps", ["rl_model_vecnormalize_9_steps.pkl", "x_norm.pkl"], 0),
        ("rl_model_9_steps", ["vecnormalize.pkl", "rl_model_vecnormalize_8_steps.pkl"], None),
        ("model", ["rl_model_replay_buffer_9_steps.pkl", "other.pkl"], None),
        ("a", ["b_vecnormalize.pkl", "b.zip"], None),
        ("model", ["run1/normalization.pkl", "logs/ppo/vecnormalize.pkl"], None),
        ("model", ["run1/vecnormalize.pkl", "run1/model.zip"], None),
    ],
)
def test_which_file_holds_the_statistics(tmp_path, model, files, found):
    for name in (f"{model}.zip", *files):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    wanted = files[0] if found == 0 else found
    if wanted is None and "vecnormalize.pkl" in files:
        with pytest.raises(ConfigurationError, match="not clear which statistics"):
            statistics_file(tmp_path / f"{model}.zip")
    else:
        answer = statistics_file(tmp_path / f"{model}.zip")
        assert answer == (None if wanted is None else tmp_path / wanted)


def test_statistics_are_code_and_may_be_of_something_else(tmp_path):
    model = sac(single())
    model.save(tmp_path / "model.zip")
    beside = tmp_path / "vecnormalize.pkl"
    other = VecNormalize(DummyVecEnv([lambda: gym.make("safe_envs/Scalar-v0")]))
    infinite = normalized()
    infinite.obs_rms.mean[:] = np.nan
    for content in (b"no pickle", pickle.dumps(3), pickle.dumps(other), pickle.dumps(infinite)):
        beside.write_bytes(content)
        with pytest.raises(ConfigurationError, match="does not hold the statistics"):
            acted(str(tmp_path / "model.zip"))
    with pytest.raises(ConfigurationError, match="pass --trust"):
        make_policy(str(tmp_path / "model.zip"), PROBLEM)
    # Such a file next to a model that saw none is of another training.
    plain = ppo(single())
    plain.save(tmp_path / "model.zip")
    assert_same(str(tmp_path / "model.zip"), plain.predict(OBSERVATIONS, deterministic=True)[0])


class Halved(gym.ActionWrapper):
    def action(self, action):
        return action / 2


class Turned(gym.ObservationWrapper):
    def observation(self, observation):
        low = self.observation_space.low  # which wrappers may look at
        return -observation + 0.0 * low


class Counting(gym.ObservationWrapper):
    steps = 0

    def observation(self, observation):
        self.steps += 1
        return observation + self.steps


class Privileged(gym.ObservationWrapper):
    def observation(self, observation):
        return observation + self.unwrapped.state[0]


class Slow(gym.Wrapper):
    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, 2.0 * float(reward), terminated, truncated, info


def rescaled(env):
    return wrappers.RescaleAction(env, np.float32(-2.0), np.float32(2.0))


def squeezed(env):
    return wrappers.RescaleObservation(env, np.float32(-1.0), np.float32(1.0))


def keyed(env):
    space = gym.spaces.Dict({"all": env.observation_space})
    return wrappers.TransformObservation(env, lambda row: {"all": row}, space)


def several(env):
    return rescaled(Turned(squeezed(Halved(env))))


def filtered(env):
    return SafetyFilterWrapper(env, "scbf")


@pytest.mark.parametrize(
    "around",
    [rescaled, squeezed, keyed, Halved, Turned, wrappers.NormalizeObservation, several, filtered],
)
def test_functions_of_observations_and_actions_are_taken_up(around):
    env = around(single())
    model = ppo(env, "MultiInputPolicy" if around is keyed else "MlpPolicy")
    env.reset()
    found = acted(model)
    np.testing.assert_array_equal(acted(model), found)  # and nothing has changed meanwhile

    class Fixed(gym.Env):
        """Shows one observation, and keeps the action."""

        observation_space, action_space = (
            env.unwrapped.observation_space,
            env.unwrapped.action_space,
        )

        def reset(self, **_):
            return OBSERVATIONS[i], {}

        def step(self, action):
            self.action = action
            return OBSERVATIONS[i], 0.0, False, False, {}

    if around not in (wrappers.NormalizeObservation, filtered):
        wrapped = around(Fixed())
        for i in range(5):
            observation, _ = wrapped.reset()
            wrapped.step(model.predict(observation, deterministic=True)[0])
            np.testing.assert_allclose(found[i], wrapped.unwrapped.action, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("around", "says"),
    [
        (Counting, "trained behind Counting, which is no function"),
        (Privileged, "Privileged, which is no function of what it is given alone .Attribute"),
        (lambda env: wrappers.DelayObservation(env, 1), "trained behind DelayObservation"),
        (lambda env: wrappers.StickyAction(env, 0.5), "trained behind StickyAction"),
        (lambda env: wrappers.RepeatAction(env, 3), "trained behind RepeatAction"),
        (lambda env: wrappers.MaxAndSkipObservation(env, 3), "trained behind MaxAndSkipObs"),
        (lambda env: VecFrameStack(DummyVecEnv([lambda: env]), 2), "trained behind VecFrameStack"),
        (
            lambda _: DummyVecEnv([lambda: wrappers.NormalizeObservation(single())] * 2),
            "trained behind NormalizeObservation",
        ),
        (lambda env: DummyVecEnv([single, lambda: Turned(env)]), "different wrappers"),
    ],
)
def test_what_is_no_function_is_refused(around, says, tmp_path):
    env = around(single())
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu")
    with pytest.raises(ConfigurationError, match=says):
        acted(model)
    with pytest.raises(ConfigurationError, match=says):
        save_policy(model, tmp_path, PROBLEM)


def test_a_file_holds_no_wrappers_and_an_unknown_one_is_named(tmp_path):
    for around in (Halved, Turned):
        with pytest.raises(ConfigurationError, match="a file of a policy does not hold"):
            save_policy(ppo(around(single())), tmp_path, PROBLEM)
    ppo(rescaled(single())).save(tmp_path / "model.zip")
    with pytest.raises(ConfigurationError, match=r"another action space.*PPO\.load\(file, env=env"):
        acted(str(tmp_path / "model.zip"))
    with pytest.warns(SystemDefinitionWarning, match="trained behind Slow, which is not there"):
        acted(ppo(Slow(single())))


class Remote(VecEnv):
    """An env that answers to questions as SubprocVecEnv does, and is out of reach."""

    closed = False

    def __init__(self, make):
        self._inner = DummyVecEnv([make])
        super().__init__(1, self._inner.observation_space, self._inner.action_space)
        for name in ("reset", "step_async", "step_wait", "env_method", "set_attr"):
            setattr(self, name, getattr(self._inner, name))

    reset = step_async = step_wait = env_method = set_attr = None

    def close(self):
        self.closed = True

    def get_attr(self, name, indices=None):
        return self._asked(self._inner.get_attr, name)

    def has_attr(self, name):
        return self._asked(self._inner.has_attr, name)

    def env_is_wrapped(self, kind, indices=None):
        return self._asked(self._inner.env_is_wrapped, kind)

    def _asked(self, question, what):
        if self.closed:
            raise EOFError
        return question(what)


def test_envs_in_other_processes_are_asked(third_party):
    spec, _ = third_party
    envs = Remote(lambda: gym.make(ENV_ID, horizon=0.5, input_bounds=(-2.0, 4.0)))
    model = ppo(envs)
    wanted, _ = model.predict(OBSERVATIONS, deterministic=True)
    # The same inputs, in the bounds -10 and 10.
    assert_same(model, (1.0 + 3.0 * wanted) / 10.0)
    envs.close()
    assert_same(model, wanted)
    model = ppo(Remote(lambda: Turned(gym.make("Pendulum-v1"))))
    with pytest.raises(ConfigurationError, match="ObservationWrapper in another process"):
        evaluate("Pendulum-v1", model, filter_spec=spec, episodes=1)


def test_an_action_stands_for_an_input(tmp_path):
    """Of the input bounds of the training, as in a folder of this project."""
    narrow = make_problem(ENV_ID, input_bounds=(-2.0, 4.0))
    model = ppo(make_sb3_env(ENV_ID, 2, "scbf", input_bounds=(-2.0, 4.0)))
    save_policy(model, tmp_path, narrow)
    for other in (narrow, PROBLEM, make_problem(ENV_ID, input_bounds=(0.0, 0.5))):
        wanted = load_policy(tmp_path, other).predict(OBSERVATIONS)[0]
        np.testing.assert_allclose(acted(model, other), wanted, rtol=1e-5, atol=1e-6)
    with pytest.raises(ConfigurationError, match="trained with the input bounds"):
        save_policy(model, tmp_path, PROBLEM)


class Said:
    """A policy of no library, which says what it is for."""

    action_space = gym.spaces.Box(-3.0, 3.0, (1,))

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        raise NotImplementedError


def for_actions(space):
    """A model of an env like ours with other actions."""
    env = single()
    env.unwrapped.action_space = space
    return PPO("MlpPolicy", env.unwrapped, device="cpu")


TWIN = dataclasses.replace(PROBLEM, name="twin")
OTHER = {
    "env": (lambda: ppo(gym.make("safe_envs/Scalar-v0")), PROBLEM, "observation space"),
    "policy": (lambda: ppo(gym.make("safe_envs/Scalar-v0")).policy, PROBLEM, "observation space"),
    "bounds": (lambda: ppo(single()), make_problem(ENV_ID, barrier={"radius": 5.0}), "observation"),
    "system": (lambda: ppo(single()), TWIN, "another env: its system: StochasticDubins"),
    "said": (Said, PROBLEM, "Said .* action space"),
    **{
        str(space): (lambda space=space: for_actions(space), PROBLEM, "action space")
        for space in (
            gym.spaces.Box(-2.0, 2.0, (1,)),
            gym.spaces.Box(-1.0, 1.0, (2,)),
            gym.spaces.Discrete(3),
        )
    },
}


@pytest.mark.parametrize(("make", "problem", "fragment"), OTHER.values(), ids=OTHER)
def test_models_of_another_env_are_refused(make, problem, fragment, tmp_path):
    model = make()
    with pytest.raises(ConfigurationError, match=fragment):
        make_policy(model, problem)
    if not isinstance(model, PPO):
        return
    with pytest.raises(ConfigurationError, match=fragment):
        save_policy(model, tmp_path / "folder", problem)
    if problem is not TWIN:  # which a file does not name
        model.save(tmp_path / "model.zip")
        with pytest.raises(ConfigurationError, match=fragment):
            make_policy(str(tmp_path / "model.zip"), problem, trust=True)


class Keyed(gym.ObservationWrapper):
    """A pendulum whose observations have names."""

    def __init__(self, **arguments):
        super().__init__(PendulumEnv(**arguments))
        parts = {"turn": gym.spaces.Box(-1.0, 1.0, (2,)), "rate": gym.spaces.Box(-8.0, 8.0, (1,))}
        self.observation_space = gym.spaces.Dict(parts)

    def observation(self, observation):
        return {"turn": observation[:2], "rate": observation[2:]}


class Heavier(PendulumEnv):
    """Another env with the same spaces."""


@pytest.fixture
def third_party():
    """The specification of Pendulum-v1, and of a registered pendulum with named observations."""
    gym.register("Keyed-v0", Keyed, max_episode_steps=10)
    gym.register("Heavier-v0", Heavier, max_episode_steps=10)
    spec = load_object("examples/pendulum_v1.py:spec")

    def state(o):
        return np.stack([np.arctan2(o["turn"][..., 1], o["turn"][..., 0]), o["rate"][..., 0]], -1)

    yield spec, dataclasses.replace(spec, state_fn=state)
    del gym.registry["Keyed-v0"], gym.registry["Heavier-v0"]


def test_third_party_envs_are_checked_too(third_party):
    spec, _ = third_party
    for given, says in (
        (ppo(gym.make("Heavier-v0")), "trained on another env: Heavier-v0, and not Pendulum-v1"),
        (ppo(gym.make("MountainCarContinuous-v0")), "another observation space"),
        (ppo(single()), "another observation space"),
    ):
        with pytest.raises(ConfigurationError, match=says):
            evaluate("Pendulum-v1", given, filter_spec=spec, episodes=1)


@pytest.mark.filterwarnings("ignore:Keyed lies between")
def test_observations_with_keys(third_party, tmp_path):
    """Of a third-party env: policies by name, functions, models and their files."""
    _, spec = third_party
    model = ppo(gym.make("Keyed-v0"), "MultiInputPolicy")
    model.save(tmp_path / "model.zip")

    def rows(policy):
        found = evaluate("Keyed-v0", policy, filter_spec=spec, episodes=3, trust=True, num_envs=2)
        return [{**row.as_dict(), "policy": ""} for row in found.rows]

    assert rows("zero") == rows(lambda observation: np.zeros_like(observation["rate"]))
    assert len({str(rows(name)) for name in ("zero", "random", "nominal")}) == 3
    assert rows(model) == rows(str(tmp_path / "model.zip"))
    with pytest.raises(InvalidInputError, match=r"failed on observations \{'rate': of shape"):
        rows(lambda observation: observation["speed"])


class Recalling(ActorCriticPolicy):
    """Adds to its action a tenth for each step of the episode that it remembers."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        actions, _ = super().predict(observation, None, episode_start, deterministic)
        known = np.zeros(len(actions)) if state is None else state[0]
        known = np.where(episode_start, 0.0, known)
        return actions + 0.1 * known[:, None], (known + 1.0,)


def test_a_recurrent_policy_keeps_its_memory_also_in_a_file(tmp_path):
    model = ppo(single(), Recalling)
    model.save(tmp_path / "model.zip")
    plain, _ = model.policy.predict(OBSERVATIONS, None, np.ones(150), True)
    for given in (model, str(tmp_path / "model.zip")):
        policy = make_policy(given, PROBLEM, trust=True)
        policy.begin(range(500, 650), 0)
        state, start = None, np.ones(150, dtype=bool)
        for step in range(3):
            actions, state = policy.predict(OBSERVATIONS, state, start)
            wanted = plain + 0.1 * np.where(np.arange(150) < 50, step, 0.0)[:, None]
            np.testing.assert_allclose(actions, wanted, rtol=1e-5, atol=1e-6)
            start = np.arange(150) >= 50
        with pytest.raises(InvalidInputError, match="hidden state is of 2 blocks"):
            policy.predict(OBSERVATIONS[:3], state, start[:3])
    by_object, by_file = (
        evaluate(ENV_ID, given, ["none"], trust=True, **SHORT).rows[0].return_mean
        for given in (model, str(tmp_path / "model.zip"))
    )
    assert by_object == by_file


class Linear(BasePolicy):
    """As the policies of ARS: without a learning rate."""

    def __init__(self, observation_space, action_space):
        super().__init__(observation_space, action_space)
        self.layer = torch.nn.Linear(4, 1)

    def _predict(self, observation, deterministic=False):
        return self.layer(observation)


def test_a_policy_is_loaded_without_a_learning_rate_and_not_without_its_module(
    tmp_path, monkeypatch
):
    module = types.ModuleType("gone")
    kind = module.Gone = type("Gone", (Linear,), {"__module__": "gone"})
    monkeypatch.setitem(sys.modules, "gone", module)
    policy, path = kind(*PROBLEM_SPACES), str(tmp_path / "model.zip")
    data = dict(zip(("observation_space", "action_space"), PROBLEM_SPACES, strict=True))
    data |= {"policy_class": kind, "policy_kwargs": {}}
    save_to_zip_file(path, data, {"policy": policy.state_dict()})
    assert_same(path, policy.predict(OBSERVATIONS)[0])
    monkeypatch.delitem(sys.modules, "gone")
    with pytest.raises(ConfigurationError, match="module gone"):
        acted(path)


def test_policies_of_sb3_contrib(tmp_path):
    contrib = pytest.importorskip("sb3_contrib")
    recurrent = {"n_steps": 32, "batch_size": 32, "n_epochs": 1}
    for model in (
        contrib.RecurrentPPO("MlpLstmPolicy", single(), **recurrent, device="cpu"),
        contrib.ARS("LinearPolicy", single(), device="cpu"),
        contrib.ARS("MlpPolicy", single(), device="cpu"),
    ):
        model.learn(32).save(tmp_path / "model.zip")
        by_object, by_file = (
            evaluate(ENV_ID, given, ["none"], trust=True, **SHORT).rows[0].return_mean
            for given in (model, str(tmp_path / "model.zip"))
        )
        assert by_object == by_file
