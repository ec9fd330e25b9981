"""Replay of executed actions: which action, reward and cost a learner behind a filter learns on."""

from __future__ import annotations

import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from safe_envs import ConfigurationError
from safe_envs.agents import make_sb3_env
from safe_envs.agents.training.replay_buffer import (
    FilteredDictReplayBuffer,
    FilteredNStepReplayBuffer,
    FilteredReplayBuffer,
    replay_options,
)
from safe_envs.agents.training.sac_lagrangian import (
    CostReplayBuffer,
    FilteredCostReplayBuffer,
    with_costs,
)
from safe_envs.plugins import load_object
from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper

pytestmark = pytest.mark.slow

ENV_ID = "safe_envs/StochasticDubins-v0"
BOX = (-3.0, 5.0)
SETTINGS = {
    "buffer_size": 600,
    "learning_starts": 20,
    "batch_size": 8,
    "train_freq": 4,
    "device": "cpu",
    "seed": 3,
}
SPACES = (gym.spaces.Box(-1.0, 1.0, (2,)), gym.spaces.Box(-1.0, 1.0, (2,)))
TWO_INPUTS = ((0.0, 4.0), (-3.0, 5.0))


def make(horizon=0.5, filtered=True, input_bounds=BOX):
    env = gym.make(ENV_ID, horizon=horizon, input_bounds=input_bounds)
    return Monitor(SafetyFilterWrapper(env, "scbf") if filtered else env)


def several(count=3, filtered=True):
    """Envs of which each ends its episodes at other steps."""
    return DummyVecEnv([lambda k=k: make(0.25 + 0.1 * k, filtered) for k in range(count)])


def native():
    return VecMonitor(make_sb3_env(ENV_ID, 3, "scbf", horizon=0.25, input_bounds=BOX))


class Witness(BaseCallback):
    """Keeps what the learner proposed and what the simulations were given (of native ones: what
    infos say) at every step."""

    def __init__(self):
        super().__init__()
        self.proposed, self.executed, self.intervened, self.done = [], [], [], []

    def _on_step(self):
        envs = [env.unwrapped for env in getattr(self.training_env.unwrapped, "envs", [])]
        executed = [env.normalized_action(env.executed) for env in envs] or [
            (info["safe_action"] - 1) / 4 for info in self.locals["infos"]
        ]
        self.proposed.append(self.locals["buffer_actions"])
        self.executed.append(np.clip(executed, -1.0, 1.0))
        self.intervened.append([info.get("intervention") for info in self.locals["infos"]])
        self.done.append(self.locals["dones"])
        return True

    def actions(self):
        return np.array(self.proposed, dtype=np.float32), np.array(self.executed).astype(np.float32)


def learned(algorithm, env, **arguments):
    model = algorithm("MlpPolicy", env, **SETTINGS, policy_kwargs={"net_arch": [8]}, **arguments)
    model.learn(120, callback=(witness := Witness()))
    return model, witness


def stored(model):
    return model.replay_buffer.actions[: model.replay_buffer.size()]


def assert_same_learning(a, b):
    for u, v in zip(a.policy.parameters(), b.policy.parameters(), strict=True):
        assert torch.equal(u, v)
    for name in ("observations", "actions", "rewards", "next_observations", "dones", "timeouts"):
        assert getattr(a.replay_buffer, name).tobytes() == getattr(b.replay_buffer, name).tobytes()
    assert a.replay_buffer.pos == b.replay_buffer.pos > 0


@pytest.mark.parametrize(
    ("algorithm", "make_envs"),
    [(SAC, several), (SAC, native), (TD3, lambda: several(1)), (DDPG, native)],
)
def test_executed_actions_are_stored_also_at_the_end_of_episodes(algorithm, make_envs):
    env = make_envs()
    noise = None if algorithm is SAC else NormalActionNoise(np.zeros(1), np.full(1, 0.5))
    model, witness = learned(algorithm, env, action_noise=noise, **replay_options(env))
    proposed, executed = witness.actions()
    done = np.array(witness.done)
    differs = np.abs(proposed - executed)[..., 0] > 1e-3
    assert np.all(np.any(done & differs, axis=0))
    assert np.any(~done & differs)
    assert stored(model).tobytes() == executed.tobytes()
    # Where the filter does nothing they are the proposals but for rounding.
    free = ~np.array(witness.intervened)
    assert np.any(free)
    np.testing.assert_allclose(executed[free], proposed[free], rtol=0, atol=2e-7)


def test_proposed_is_what_stable_baselines_stores():
    plain, _ = learned(SAC, several())
    proposed, witness = learned(SAC, several(), **replay_options(several(), "proposed"))
    executed, _ = learned(SAC, several(), **replay_options(several()))
    assert_same_learning(plain, proposed)
    assert stored(proposed).tobytes() == witness.actions()[0].tobytes()
    assert not torch.equal(
        next(executed.policy.critic.parameters()), next(plain.policy.critic.parameters())
    )


def test_both_stores_each_step_with_either_action():
    model, witness = learned(SAC, several(), **replay_options(several(), "both"))
    proposed, executed = witness.actions()
    buffer = model.replay_buffer
    assert buffer.size() == 2 * len(proposed)
    assert stored(model)[0::2].tobytes() == executed.tobytes()
    assert stored(model)[1::2].tobytes() == proposed.tobytes()
    for name in ("observations", "next_observations", "rewards", "dones", "timeouts"):
        rows = getattr(buffer, name)[: buffer.size()]
        assert rows[0::2].tobytes() == rows[1::2].tobytes()


@pytest.mark.parametrize(
    ("algorithm", "action"), [(SAC, "executed"), (TD3, "proposed"), (SAC, "the class alone")]
)
def test_without_a_filter_nothing_changes(algorithm, action):
    free, arguments = several(filtered=False), {"replay_buffer_class": FilteredReplayBuffer}
    if action != "the class alone":
        arguments = replay_options(free, action)
    plain, _ = learned(algorithm, several(filtered=False))
    ours, _ = learned(algorithm, free, **arguments)
    assert type(ours.replay_buffer) is FilteredReplayBuffer
    assert_same_learning(plain, ours)


def test_n_step_returns():
    env = several()
    filtered, witness = learned(SAC, env, **replay_options(env, n_steps=3, gamma=0.9))
    assert stored(filtered).tobytes() == witness.actions()[1].tobytes()
    assert filtered.gamma == filtered.replay_buffer.gamma == 0.9
    plain, _ = learned(SAC, several(filtered=False), n_steps=3, gamma=0.9)
    ours, _ = learned(SAC, several(filtered=False), **replay_options(env, n_steps=3, gamma=0.9))
    assert_same_learning(plain, ours)


def test_small_memory_and_normalised_observations_and_rewards_leave_the_actions():
    options = replay_options(several())
    model, witness = learned(SAC, VecNormalize(several()), **options)
    assert stored(model).tobytes() == witness.actions()[1].tobytes()
    options["replay_buffer_kwargs"]["handle_timeout_termination"] = False
    model, witness = learned(SAC, several(), optimize_memory_usage=True, **options)
    assert stored(model).tobytes() == witness.actions()[1].tobytes()


def test_ppo_keeps_the_proposals_and_their_probabilities():
    class BeforeTheUpdate(BaseCallback):
        def _on_step(self):
            nominal.append([info["nominal_action"] for info in self.locals["infos"]])
            interventions.append([info["intervention"] for info in self.locals["infos"]])
            return True

        def _on_rollout_end(self):
            rollout = self.model.rollout_buffer
            actions.append(rollout.actions.copy())
            observations, sampled = (
                torch.as_tensor(rows.reshape(-1, rows.shape[-1]))
                for rows in (rollout.observations, rollout.actions)
            )
            with torch.no_grad():
                _, log_probs, _ = self.model.policy.evaluate_actions(observations, sampled)
            np.testing.assert_allclose(
                log_probs.numpy(), rollout.log_probs.ravel(), rtol=1e-5, atol=1e-5
            )

    nominal, interventions, actions = [], [], []
    PPO("MlpPolicy", several(), n_steps=32, batch_size=48, n_epochs=2, device="cpu", seed=0).learn(
        192, callback=BeforeTheUpdate()
    )
    center, half = np.mean(BOX), np.ptp(BOX) / 2
    assert np.any(interventions)
    assert len(actions) == 2
    np.testing.assert_allclose(
        np.array(nominal), center + half * np.clip(np.concatenate(actions), -1.0, 1.0), atol=1e-5
    )


def test_saving_and_loading(tmp_path):
    model, _ = learned(SAC, several(), **replay_options(several(), "both"))
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    again = SAC.load(tmp_path / "model.zip", env=several(), device="cpu")
    assert again.replay_buffer.size() == 0
    assert again.replay_buffer.action == "both"
    again.load_replay_buffer(tmp_path / "buffer.pkl")
    assert stored(again).tobytes() == stored(model).tobytes()
    before = again.replay_buffer.size()
    again.learn(30, callback=(witness := Witness()), reset_num_timesteps=False)
    assert stored(again)[before::2].tobytes() == witness.actions()[1].tobytes()


def buffer_of(
    envs=3, action="executed", kind=FilteredReplayBuffer, input_bounds=TWO_INPUTS, **arguments
):
    given = {"device": "cpu", "n_envs": envs, "action": action, "input_bounds": input_bounds}
    return kind(20 * envs, *SPACES, **given, **arguments)


def add(buffer, infos, rewards=0.0):
    count = len(infos)
    rng = np.random.default_rng(1)
    proposed = rng.uniform(-1.0, 1.0, (count, 2))
    seen, done = np.zeros((count, 2)), np.zeros(count, dtype=bool)
    buffer.add(seen, seen, proposed, np.full(count, rewards), done, infos)
    return proposed.astype(np.float32)


def test_physical_actions_are_mapped_to_the_unit_box():
    # So far that it is beyond 1 in single precision as well.
    beyond = 4.0 + 1e-6
    buffer = buffer_of()
    add(buffer, [{"safe_action": np.array(u)} for u in ([0.0, 5.0], [beyond, 1.0], [1.0, -1.0])])
    assert buffer.actions[0].tolist() == [[-1.0, 1.0], [1.0, 0.0], [-0.5, -0.5]]


def test_each_env_without_a_filter_keeps_its_proposal():
    buffer = buffer_of()
    proposed = add(buffer, [{}, {"safe_action": np.array([2.0, 1.0])}, {"cost": 0.0}])
    assert buffer.actions[0].tolist() == [proposed[0].tolist(), [0.0, 0.0], proposed[2].tolist()]


class View(dict):
    """An info that is one row of a batch, of which the row itself holds only what is given."""

    def __init__(self, batch, index, **given):
        super().__init__(given)
        self.batch, self.index = batch, index


def test_infos_of_one_batch_are_read_at_once():
    batch = {"safe_action": np.array([[2.0, 1.0], [4.0, 5.0], [0.0, -3.0]])}
    buffer = buffer_of()
    add(buffer, [View(batch, k) for k in (0, 2, 1)])
    assert buffer.actions[0].tolist() == [[0.0, 0.0], [-1.0, -1.0], [1.0, 1.0]]


def test_a_full_buffer_starts_again():
    buffer = buffer_of(envs=1, action="both")
    for k in range(11):
        add(buffer, [{"safe_action": np.array([0.1 * k, 0.0])}])
    assert (buffer.full, buffer.pos, buffer.size()) == (True, 2, 20)
    assert buffer.actions[:3:2, 0, 0].tolist() == pytest.approx([-0.5, -0.95])
    assert pickle.loads(pickle.dumps(buffer)).actions.tobytes() == buffer.actions.tobytes()


def test_options_of_a_problem_and_of_any_env_of_it():
    env = make()
    vector = SafetyFilterVectorWrapper(gym.make_vec(ENV_ID, num_envs=2, input_bounds=BOX), "scbf")
    problem, normalised = env.unwrapped.problem, VecNormalize(several())
    for source in (problem, env, vector, several(), normalised, native()):
        assert replay_options(source, "both") == {
            "replay_buffer_class": FilteredReplayBuffer,
            "replay_buffer_kwargs": {"input_bounds": (BOX,), "action": "both"},
        }


BOXES = [(0.0, 4.0), ((0.0, 4.0),), ((0.0, 4.0), (5.0, -3.0)), ((0.0, 4.0), (0.0, np.inf))]
BOXES += ["b", ((0,), (1, 2))]
SMALL = {"optimize_memory_usage": True, "handle_timeout_termination": False}


def of_several_bounds():
    return DummyVecEnv([make, lambda: make(input_bounds=(-2.0, 2.0))])


@pytest.mark.parametrize(
    ("call", "fragment"),
    [
        *((lambda box=box: buffer_of(input_bounds=box), "input_bounds = ") for box in BOXES),
        (lambda: buffer_of(action="excuted"), "'executed'"),
        (lambda: buffer_of(action=None), "action = None"),
        (lambda: buffer_of(action="both", **SMALL), "optimize_memory_usage"),
        (lambda: buffer_of(action="both", kind=FilteredNStepReplayBuffer, n_steps=2), "n_steps"),
        (lambda: replay_options(make(), n_steps=0), "n_steps = 0"),
        *(
            (lambda u=u: add(buffer_of(envs=1), [{"safe_action": np.array(u)}]), r"\[4.0, 5.0\]")
            for u in ([4.1, 0.0], [2.0, -30.0], [np.nan, 0.0])
        ),
        (lambda: replay_options(gym.make("CartPole-v1")), "not one of this project's envs"),
        (lambda: replay_options(DummyVecEnv([lambda: gym.make("CartPole-v1")])), "not one of"),
        (lambda: replay_options(None), "not one of this project's envs"),
        (lambda: replay_options(of_several_bounds()), r"\(-3.0, 5.0\),\), \(\(-2.0, 2.0\)"),
    ],
)
def test_what_does_not_fit_is_refused(call, fragment):
    with pytest.raises(ConfigurationError, match=fragment):
        call()


def third_party():
    """Gymnasium's own pendulum behind a filter; its actions are torques in [-2, 2]."""
    spec = load_object("examples/pendulum_v1.py:spec")
    view = {name: getattr(spec, name) for name in ("model", "barriers", "state_fn", "action_map")}
    env = gym.make("Pendulum-v1", max_episode_steps=25)
    return Monitor(SafetyFilterWrapper(env, spec.filter, **view))


@pytest.mark.parametrize(
    ("algorithm", "make_envs"),
    [(SAC, several), (TD3, make), (DDPG, lambda: DummyVecEnv([third_party]))],
)
def test_the_class_alone_stores_what_was_executed(algorithm, make_envs):
    """One argument; plain Stable-Baselines3 stores something else."""
    net = {"net_arch": [8]}
    model = algorithm(
        "MlpPolicy", make_envs(), **SETTINGS, policy_kwargs=net, replay_buffer_class=Recording
    )
    model.learn(120)
    buffer = model.replay_buffer
    assert buffer.unit
    assert len(buffer.unit) == buffer.size()
    np.testing.assert_allclose(stored(model), np.array(buffer.unit), rtol=0, atol=1e-6)
    assert np.abs(stored(model) - np.array(buffer.proposals)).max() > 0.1


class Recording(FilteredReplayBuffer):
    """Keeps what was proposed and, computed from the infos and known bounds, executed."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.proposals, self.unit = [], []

    def add(self, obs, next_obs, action, reward, done, infos):
        ours = self.observation_space.shape != (3,)  # of the third-party pendulum
        center, half = (1.0, 4.0) if ours else (0.0, 2.0)
        self.proposals.append(action.copy())
        self.unit.append([(info["safe_action"] - center) / half for info in infos])
        super().add(obs, next_obs, action, reward, done, infos)


class Halved(gym.ActionWrapper):
    def action(self, action):
        return action / 2


def test_wrappers_around_the_filter_that_change_actions():
    def hidden(around):
        env = SafetyFilterWrapper(gym.make(ENV_ID, horizon=0.5, input_bounds=BOX), "scbf")
        return Monitor(around(env))

    def rescaled(env):
        return gym.wrappers.RescaleAction(env, np.float32(-2.0), np.float32(2.0))

    one = {"replay_buffer_class": FilteredReplayBuffer}
    # From end to end it is the same action in [-1, 1].
    model, witness = learned(SAC, hidden(rescaled), **one)
    np.testing.assert_allclose(stored(model), witness.actions()[1], rtol=0, atol=1e-6)
    for around in (Halved, lambda env: Halved(rescaled(env))):
        with pytest.raises(ConfigurationError, match="wrapper around the filter"):
            learned(SAC, hidden(around), **one)
    wide = {"replay_buffer_kwargs": {"input_bounds": [(1.0 - 2.0, 1.0 + 2.0)]}}
    model = SAC("MlpPolicy", hidden(Halved), **one, **wide, buffer_size=9, device="cpu")
    model.env.envs[0].unwrapped.reset(seed=0)
    executed = {"safe_action": np.array([0.0]), "nominal_action": np.array([2.0])}
    executed["input_bounds"] = np.array([BOX])
    seen, ends = np.zeros((1, 4)), np.zeros(1)
    model.replay_buffer.add(seen, seen, np.array([[0.5]]), ends, ends, [executed])
    assert stored(model).tolist() == [[[-0.5]]]


def other_bounds(filtered=True):
    return make(filtered=filtered, input_bounds=(-2.0, 2.0))


def in_units(witness, center=0.0, half=2.0):
    """Executed inputs in [-1, 1] of `other_bounds`, as the infos have them."""
    return (np.array(witness.inputs) - center) / half


class Inputs(BaseCallback):
    """Keeps the inputs that infos report."""

    def __init__(self):
        super().__init__()
        self.inputs = []

    def _on_step(self):
        self.inputs.append([info["safe_action"] for info in self.locals["infos"]])
        return True


@pytest.mark.parametrize(("options", "saved_filtered"), [(True, False), (False, True)])
def test_the_env_of_a_learner_may_be_exchanged(tmp_path, options, saved_filtered):
    env = make(filtered=saved_filtered)
    arguments = replay_options(env) if options else {"replay_buffer_class": FilteredReplayBuffer}
    model, _ = learned(SAC, env, **arguments)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")

    def goes_on(learner):
        before = learner.replay_buffer.size()
        learner.learn(40, callback=(inputs := Inputs()), reset_num_timesteps=False)
        rows, wanted = stored(learner)[before:], in_units(inputs)
        assert np.abs(wanted).max() > 0.2
        np.testing.assert_allclose(rows, wanted, rtol=0, atol=1e-6)

    goes_on(SAC.load(tmp_path / "model.zip", env=other_bounds(), device="cpu"))
    again = SAC.load(tmp_path / "model.zip", env=other_bounds(), device="cpu")
    again.load_replay_buffer(tmp_path / "buffer.pkl")
    goes_on(again)
    model.set_env(other_bounds())
    goes_on(model)


class Keyed(gym.ObservationWrapper):
    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gym.spaces.Dict({"all": env.observation_space})

    def observation(self, observation):
        return {"all": observation}


@pytest.mark.parametrize("action", ["executed", "both"])
def test_observations_with_keys(tmp_path, action):
    env = Keyed(make())
    arguments = replay_options(env.unwrapped, action)
    plain, _ = learned(SAC, make(), **arguments)
    model = SAC("MultiInputPolicy", env, **SETTINGS, policy_kwargs={"net_arch": [8]}, **arguments)
    model.learn(120)
    assert type(model.replay_buffer) is FilteredDictReplayBuffer
    assert stored(model).tobytes() == stored(plain).tobytes()
    rows = model.replay_buffer.observations["all"]
    assert rows.tobytes() == plain.replay_buffer.observations.tobytes()
    again = pickle.loads(pickle.dumps(model.replay_buffer))
    assert again.actions.tobytes() == model.replay_buffer.actions.tobytes()
    with pytest.raises(ConfigurationError, match="derive a buffer for them from FilteredDict"):
        SAC("MultiInputPolicy", env, **SETTINGS, **replay_options(env.unwrapped, n_steps=3))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("kind", ["vector_entry_point", "sync"])
def test_infos_of_vector_envs_of_gymnasium(kind, mode):
    """As loops of one's own add them, without Stable-Baselines3's envs."""
    settings = {"horizon": 0.25, "input_bounds": BOX}
    if kind == "sync":
        settings |= {
            "wrappers": [lambda env: SafetyFilterWrapper(env, "scbf")],
            "vector_kwargs": {"autoreset_mode": AutoresetMode(mode)},
        }
        envs = gym.make_vec(ENV_ID, 3, "sync", **settings)
    else:
        envs = gym.make_vec(ENV_ID, 3, kind, autoreset_mode=mode, **settings)
        envs = SafetyFilterVectorWrapper(envs, "scbf")
    spaces = envs.single_observation_space, envs.single_action_space
    buffer = FilteredCostReplayBuffer(90, *spaces, device="cpu", n_envs=3)
    observation, _ = envs.reset(seed=0)
    envs.action_space.seed(0)
    ends, intervened = 0, False
    for k in range(20):
        proposed = envs.action_space.sample()
        after, reward, terminated, truncated, infos = envs.step(proposed)
        done = terminated | truncated
        buffer.add(observation, after, proposed, reward, terminated, infos)
        last = infos["final_info"] if mode == "SameStep" and done.any() else infos
        for i in range(3):
            info = last if done[i] else infos
            wanted = (info["safe_action"][i] - 1.0) / 4.0
            np.testing.assert_allclose(buffer.actions[k, i], wanted, rtol=0, atol=1e-6)
            assert buffer.costs[k, i] == info["cost"][i]
            intervened |= np.abs(wanted - proposed[i]).max() > 0.1
        ends, observation = ends + done.sum(), after
    assert ends >= 3
    assert intervened


def test_each_env_gets_its_own_penalty_back():
    given = {"safe_action": np.array([2.0, 1.0])}
    batch = {"intervention_penalty": np.array([0.5, 1.0, 2.0]), "safe_action": np.full((3, 2), 1.0)}
    for infos, own in (
        ([{**given, "intervention_penalty": 0.5}, {}, given], [3.5, 3.0, 3.0]),
        ([View(batch, k) for k in (0, 2, 1)], [3.5, 5.0, 4.0]),
        ([View({}, k, **given, intervention_penalty=float(k)) for k in range(3)], [3.0, 4.0, 5.0]),
        ([given] * 3, [3.0] * 3),
    ):
        buffer = buffer_of()
        add(buffer, infos, rewards=[3.0] * 3)
        assert buffer.rewards[0].tolist() == own


def filled(penalty, action="executed", n_steps=1, kind=None):
    """A buffer after episodes of random actions under a penalty on interventions, fed with native
    infos or those of another kind."""
    env = make_sb3_env(
        ENV_ID, 3, "scbf", intervention_penalty=penalty, horizon=0.25, input_bounds=BOX, seed=0
    )
    options = replay_options(env, action, n_steps, gamma=0.9)
    spaces = (env.observation_space, env.action_space)
    buffer = options["replay_buffer_class"](
        300, *spaces, device="cpu", n_envs=3, **options["replay_buffer_kwargs"]
    )
    last = env.reset()
    for proposed in np.random.default_rng(0).uniform(-1.0, 1.0, (24, 3, 1)).astype(np.float32):
        observations, rewards, dones, infos = env.step(proposed)
        given = [kind(info) for info in infos] if kind else infos
        buffer.add(last, observations, proposed, rewards, dones, given)
        last = observations
    return buffer


@pytest.mark.parametrize("kind", [None, dict], ids=["native", "dicts"])
def test_a_penalty_belongs_to_the_proposal(kind):
    buffers = filled(0.0), filled(2.0, "proposed"), filled(2.0, kind=kind)
    own, penalised, executed, both = (
        buffer.rewards[: buffer.size()] for buffer in (*buffers, filled(2.0, "both", kind=kind))
    )
    assert np.any(own - penalised > 0.1)
    np.testing.assert_allclose(executed, own, rtol=1e-5, atol=1e-6)
    assert both[0::2].tobytes() == executed.tobytes()
    assert both[1::2].tobytes() == penalised.tobytes()


def test_n_step_returns_of_executed_actions_are_without_the_penalty():
    def returns(buffer):
        np.random.seed(0)  # noqa: NPY002  (of which Stable-Baselines3 samples)
        return buffer.sample(200).rewards.numpy()

    free, executed, proposed = (
        returns(filled(c, action, 3))
        for c, action in ((0.0, "executed"), (2.0, "executed"), (2.0, "proposed"))
    )
    np.testing.assert_allclose(executed, free, rtol=1e-5, atol=1e-6)
    assert np.any(free - proposed > 0.1)


ONE_INPUT = (gym.spaces.Box(-1.0, 1.0, (2,)), gym.spaces.Box(-1.0, 1.0, (1,)))


def fill(buffer, steps, first=0):
    """Add steps whose numbers tell step and env: 10 k + i."""
    for k in range(first, first + steps):
        number = 10.0 * k + np.arange(3)
        observations = np.stack([number, number], axis=1)
        infos = [
            {"cost": n, "safe_action": np.array([4.0]), "nominal_action": np.array([1.0])}
            for n in number.tolist()
        ]
        buffer.add(
            observations,
            observations + 0.5,
            np.full((3, 1), -0.5, dtype=np.float32),
            -number,
            np.zeros(3, dtype=bool),
            infos,
        )
    return buffer


def plain(kind=CostReplayBuffer, rows=7, **arguments):
    return kind(rows * 3, *ONE_INPUT, device="cpu", n_envs=3, **arguments)


@pytest.mark.parametrize("steps", [5, 7, 12])
@pytest.mark.parametrize("small", [False, True])
def test_costs_are_those_of_the_sampled_steps(steps, small):
    memory = {"optimize_memory_usage": True, "handle_timeout_termination": False} if small else {}
    buffer = fill(plain(**memory), steps)
    np.random.seed(4)  # noqa: NPY002
    steps, costs = buffer.sample(200), buffer.last_sample().costs
    assert buffer.last_sample().steps is steps
    assert costs.shape == (200, 1)
    np.testing.assert_array_equal(costs, -steps.rewards)
    np.testing.assert_array_equal(costs[:, 0], steps.observations[:, 0])
    assert len(set(costs.ravel().tolist())) > 3


def test_it_draws_what_stable_baselines3_draws():
    batches, left = [], []
    for kind in (ReplayBuffer, CostReplayBuffer):
        buffer = fill(plain(kind), 9)
        np.random.seed(4)  # noqa: NPY002
        batches.append([buffer.sample(16) for _ in range(3)])
        left.append(np.random.random())  # noqa: NPY002
    for theirs, ours in zip(*batches, strict=True):
        for a, b in zip(theirs, ours, strict=True):
            assert (a is None and b is None) or (a == b).all()
    assert left[0] == left[1]


@pytest.mark.parametrize(
    ("action", "rows", "actions"),
    [("executed", 1, [1.0]), ("proposed", 1, [-0.5]), ("both", 2, [1.0, -0.5])],
)
def test_a_filtered_step_has_its_cost_in_each_row(action, rows, actions):
    buffer = fill(plain(FilteredCostReplayBuffer, input_bounds=((0.0, 4.0),), action=action), 2)
    assert buffer.pos == 2 * rows
    np.testing.assert_array_equal(
        buffer.costs[: 2 * rows], np.repeat([[0, 1, 2], [10, 11, 12]], rows, axis=0)
    )
    np.testing.assert_array_equal(buffer.actions[:rows, 0, 0], actions)


def test_classes_have_a_counterpart_with_costs():
    assert with_costs(ReplayBuffer) is CostReplayBuffer
    assert with_costs(FilteredReplayBuffer) is FilteredCostReplayBuffer
    assert with_costs(FilteredCostReplayBuffer) is FilteredCostReplayBuffer
    for kind in (NStepReplayBuffer, FilteredNStepReplayBuffer):
        with pytest.raises(ConfigurationError, match="n_steps = 1"):
            with_costs(kind)


def test_a_step_without_cost_is_an_error_and_there_is_no_batch_before_the_first():
    buffer = plain()
    step = np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((3, 1)), np.zeros(3)
    with pytest.raises(ConfigurationError, match="cost"):
        buffer.add(*step, np.zeros(3, dtype=bool), [{"cost": 0.0}, {}, {"cost": 1.0}])
    with pytest.raises(ConfigurationError, match="sample"):
        buffer.last_sample()
