"""Filters over envs that know nothing of this project: Gymnasium's own, scalar and in batches."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from safe_envs import (
    ConfigurationError,
    ControlAffineSDE,
    InvalidInputError,
    RelativeDegreeError,
    SystemDefinitionError,
    SystemDefinitionWarning,
)
from safe_envs.problem.backup import Backup, BackupLaw
from safe_envs.wrappers import (
    ActionMap,
    FilterSpec,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    SafetyMonitor,
)

theta, rate, torque = sp.symbols("theta rate torque", real=True)
x, v, force = sp.symbols("x v force", real=True)

PENDULUM = {
    "model": ControlAffineSDE((theta, rate), (torque,), [rate, 15 * sp.sin(theta)], [0, 3], [0, 0]),
    "barriers": 4 - rate**2 + 30 * (1 - sp.cos(theta)),
    "state_fn": lambda o: np.stack([np.arctan2(o[..., 1], o[..., 0]), o[..., 2]], axis=-1),
}
CAR = {
    # Its acceleration is .0015 times the action: the model has it in units of the slope's .0025.
    "model": ControlAffineSDE((x, v), (force,), [v, -0.0025 * sp.cos(3 * x)], [0, 0.0025], [0, 0]),
    "barriers": -0.0002 - v**2 / 2 - 0.0025 / 3 * sp.sin(3 * x),
    "state_fn": lambda o: o,
    "action_map": ActionMap.scaled(0.6),
    "dt": 1.0,
}
FILTER = "cbf:alpha=2:sampling_margin=15"


def spun(observation: np.ndarray) -> np.ndarray:
    """Torque that swings the pendulum up for ever."""
    return 2 * np.tanh(3 * observation[..., 2:])


def car(condition="cbf:alpha=0.05", **view):
    return SafetyFilterWrapper(gym.make("MountainCarContinuous-v0"), condition, **{**CAR, **view})


def smallest_h(env: gym.Env, episodes: int = 3) -> float:
    found = np.inf
    for seed in range(episodes):
        observation, _ = env.reset(seed=seed)
        info, truncated = {}, False
        while not truncated:
            observation, _, _, truncated, info = env.step(spun(observation))
        found = min(found, info["h_min"])
    return found


def test_a_filter_keeps_the_pendulum_slow_at_the_top():
    assert smallest_h(SafetyMonitor(gym.make("Pendulum-v1"), FilterSpec(**PENDULUM))) < -30
    assert smallest_h(SafetyFilterWrapper(gym.make("Pendulum-v1"), FILTER, **PENDULUM)) > 0


def test_a_backup_keeps_the_pendulum_slow():
    """Full torque against the motion below, where the pendulum hangs."""
    slow = sp.Integer(50) - rate**2 / 2 - 15 * (1 + sp.cos(theta))
    brake = BackupLaw("brake", (-2 * rate,), terminal=slow)
    view = {**PENDULUM, "barriers": 50 - rate**2 / 2 - 15 * (1 + sp.cos(theta))}
    with pytest.raises(ConfigurationError, match="FilterSpec"):
        SafetyFilterWrapper(gym.make("Pendulum-v1"), "backup", **view)
    env = SafetyFilterWrapper(
        gym.make("Pendulum-v1"), "backup", **view, backup=Backup((brake,), 2.0)
    )
    env.reset(seed=0)
    infos = [env.step(np.array([2.0]))[-1] for _ in range(50)]
    assert all(info["feasible"] for info in infos)
    assert env.safety_filter.text == "backup"


def test_the_executed_action_is_the_filters_in_the_models_units():
    env = car()
    env.reset(seed=0)
    seen = []
    env.unwrapped.step = lambda action, step=env.unwrapped.step: (
        seen.append(action),
        step(action),
    )[1]  # pyright: ignore
    for _ in range(150):
        _, _, _, _, info = env.step(np.ones(1, dtype=np.float32))
    executed = np.array(seen)
    assert executed.dtype == np.float32
    assert 0.6 * executed[-1] == pytest.approx(info["safe_action"], rel=1e-6)
    assert info["nominal_action"] == pytest.approx([0.6])
    assert info["episode_interventions"] > 0


def test_info_is_that_of_this_projects_envs():
    ours = SafetyFilterWrapper(gym.make("safe_envs/Pendulum-v0"), "scbf")
    theirs = SafetyFilterWrapper(gym.make("Pendulum-v1"), FILTER, **PENDULUM)
    for wanted, found in (
        (ours.reset(seed=0)[1], theirs.reset(seed=0)[1]),
        (ours.step([0.0])[4], theirs.step([0.0])[4]),
    ):
        assert {key: (type(value), np.shape(value)) for key, value in wanted.items()} == {
            key: (type(value), np.shape(value)) for key, value in found.items()
        }


@pytest.mark.filterwarnings("ignore:.*WARN")
def test_gymnasium_s_checker_is_content():
    check_env(
        SafetyFilterWrapper(gym.make("Pendulum-v1", disable_env_checker=True), FILTER, **PENDULUM),
        skip_render_check=True,
    )


def test_the_env_can_be_made_again_from_its_spec():
    place = f"{Path(__file__).parents[3] / 'examples' / 'pendulum_v1.py'}:spec"
    env = SafetyFilterWrapper(SafetyMonitor(gym.make("Pendulum-v1"), place), FILTER)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))  # pyright: ignore[reportOptionalMemberAccess]
    for made in (env, again):
        made.reset(seed=1)
    assert env.step([0.5])[4]["safe_action"] == again.step([0.5])[4]["safe_action"]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_batch_is_what_its_envs_are(mode):
    def make():
        return gym.make("Pendulum-v1", max_episode_steps=7)

    seeds = [5, 6, 7]
    batch = SafetyFilterVectorWrapper(
        gym.vector.SyncVectorEnv([make] * 3, autoreset_mode=mode), FILTER, **PENDULUM
    )
    singles = [SafetyFilterWrapper(make(), FILTER, **PENDULUM) for _ in seeds]
    observations, infos = batch.reset(seed=seeds)
    alone = [env.reset(seed=seed) for env, seed in zip(singles, seeds, strict=True)]
    ended = np.zeros(3, dtype=bool)
    for k in range(20):
        rows = np.stack([step[0] for step in alone])
        assert np.array_equal(observations, rows)
        for i, step in enumerate(alone):
            for key, value in step[-1].items():
                assert np.allclose(infos[key][i], value, rtol=1e-12, atol=1e-12), (k, key)
        actions = spun(rows)
        observations, _, terminated, truncated, infos = batch.step(actions)
        for i, env in enumerate(singles):
            if mode == AutoresetMode.NEXT_STEP and ended[i]:
                alone[i] = env.reset()
                continue
            alone[i] = env.step(actions[i])
            if mode == AutoresetMode.SAME_STEP and truncated[i]:
                last = alone[i]
                assert np.array_equal(infos["final_obs"][i], last[0])
                for key, value in last[-1].items():
                    assert np.allclose(
                        infos["final_info"][key][i], value, rtol=1e-12, atol=1e-12
                    ), key
                assert np.array_equal(batch.env.episodes.last_states[i], env.env.components)
                alone[i] = env.reset()
        ended = terminated | truncated
    assert batch.num_envs == 3


class Parts(gym.ObservationWrapper):
    """Pendulum-v1 with an observation in two parts: a dict, or a tuple."""

    def __init__(self, kind: type) -> None:
        super().__init__(gym.make("Pendulum-v1", max_episode_steps=3))
        box = self.env.observation_space
        parts = [gym.spaces.Box(box.low[cut], box.high[cut]) for cut in (np.s_[:2], np.s_[2:])]
        self._kind = kind
        self.observation_space = (
            gym.spaces.Tuple(parts)
            if kind is tuple
            else gym.spaces.Dict(dict(zip("ab", parts, strict=True)))
        )

    def observation(self, observation: np.ndarray) -> dict[str, np.ndarray] | tuple:
        parts = observation[:2], observation[2:]
        return parts if self._kind is tuple else dict(zip("ab", parts, strict=True))


@pytest.mark.filterwarnings("ignore::safe_envs.SystemDefinitionWarning")  # state_fn undoes it
@pytest.mark.parametrize("kind", [dict, tuple])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_observations_may_be_of_several_parts(kind, mode):
    def flat(o):
        return np.concatenate(list(o.values()) if kind is dict else o, axis=-1)

    made = [lambda: Parts(kind)] * 2, [lambda: gym.make("Pendulum-v1", max_episode_steps=3)] * 2
    views = {**PENDULUM, "state_fn": lambda o: PENDULUM["state_fn"](flat(o))}, PENDULUM
    parts, plain = (
        SafetyFilterVectorWrapper(
            gym.vector.SyncVectorEnv(fns, autoreset_mode=mode), FILTER, **view
        )
        for fns, view in zip(made, views, strict=True)
    )
    parts.reset(seed=3)
    plain.reset(seed=3)
    for _ in range(8):
        action = np.full((2, 1), 1.5, dtype=np.float32)
        (one, *_, infos), (other, *_, expected) = parts.step(action), plain.step(action)
        np.testing.assert_array_equal(flat(one), other)
        for key in ("barrier", "safe_action", "episode_cost"):
            np.testing.assert_array_equal(infos[key], expected[key])
            if "final_info" in expected:
                np.testing.assert_array_equal(infos["final_info"][key], expected["final_info"][key])


def test_a_batch_may_run_in_other_processes():
    batch = SafetyFilterVectorWrapper(
        gym.make_vec("Pendulum-v1", 2, "async"), FILTER, **PENDULUM, dt=0.05
    )
    observations, _ = batch.reset(seed=0)
    for _ in range(30):
        observations, *_, infos = batch.step(spun(observations))
    batch.close()
    assert infos["episode_interventions"].min() > 0


@pytest.mark.parametrize(
    ("wrap", "part"),
    [
        (gym.wrappers.TimeAwareObservation, "state_fn"),
        (gym.wrappers.NormalizeObservation, "state_fn"),
        (lambda env: gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1)), "action_map"),
    ],
)
def test_wrappers_that_change_what_the_filter_sees_or_does_are_doubtful(wrap, part):
    with pytest.warns(SystemDefinitionWarning, match=f"unless {part} undoes that"):
        SafetyFilterWrapper(wrap(gym.make("Pendulum-v1")), FILTER, **PENDULUM)


def test_wrappers_that_only_watch_may_lie_below():
    env = SafetyFilterWrapper(
        gym.wrappers.RecordEpisodeStatistics(gym.make("Pendulum-v1")), FILTER, **PENDULUM
    )
    env.reset(seed=0)
    assert env.step([1.0])[4]["barrier"].shape == (1,)


@pytest.mark.parametrize("kind", [gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv])
def test_a_masked_reset_leaves_the_records_of_the_others(kind):
    batch = SafetyFilterVectorWrapper(
        kind([lambda: gym.make("Pendulum-v1")] * 3, autoreset_mode=AutoresetMode.DISABLED),
        FILTER,
        **PENDULUM,
        dt=0.05,
    )
    observations, _ = batch.reset(seed=0)
    for _ in range(20):
        observations, *_, before = batch.step(spun(observations))
    observations, after = batch.reset(options={"reset_mask": np.array([False, False, True])})
    assert after["_cost"].tolist() == [False, False, True]
    observations, *_, now = batch.step(spun(observations))
    batch.close()
    assert (now["h_min"][:2] <= before["h_min"][:2]).all()
    assert now["h_min"][2] >= before["h_min"][2]
    counts = now["episode_interventions"] - before["episode_interventions"]
    assert (counts[:2] >= 0).all()
    assert now["episode_interventions"][2] <= 1


def test_what_a_caller_does_to_an_observation_does_not_reach_the_state():
    view = {**CAR, "barriers": 5 - v, "state_fn": lambda o: o}
    batch = SafetyFilterVectorWrapper(
        gym.make_vec("MountainCarContinuous-v0", 1, "sync"), "cbf", **view
    )
    observations, _ = batch.reset(seed=0)
    before = [float(c[0]) for c in batch.env.components]
    observations -= 100
    assert [float(c[0]) for c in batch.env.components] == before


def test_rounding_of_actions_is_no_change():
    offset = {"action_map": ActionMap.scaled(1.0, -1.4), "barriers": 100 - rate**2}
    env = SafetyFilterWrapper(
        _Watched(SafetyMonitor(gym.make("Pendulum-v1"), FilterSpec(**{**PENDULUM, **offset}))),
        "cbf",
    )
    env.reset(seed=0)
    for action in np.linspace(-2, 2, 40, dtype=np.float32):
        env.step([action])


class _Watched(gym.Wrapper):
    """Does nothing."""


@pytest.mark.parametrize(
    ("view", "error", "says"),
    [
        ({"state_fn": lambda o: o[..., :1]}, InvalidInputError, "the model needs"),
        ({"state_fn": lambda o: o * np.nan}, InvalidInputError, "finite"),
        ({"state_fn": 3}, ConfigurationError, "give a function"),
        (
            {"action_map": ActionMap(lambda a: 2 * a, lambda u: u)},
            ConfigurationError,
            "to undo to_input",
        ),
        ({"action_map": 2.0}, ConfigurationError, "ActionMap.scaled"),
        ({"dt": None}, ConfigurationError, "give dt"),
        ({"barriers": sp.Integer(1)}, RelativeDegreeError, "no relative degree"),
        ({"barriers": []}, SystemDefinitionError, "barriers is empty"),
        ({"state_fn": lambda o: o["x"]}, InvalidInputError, "state_fn failed"),
        (
            {"action_map": ActionMap(lambda a: a + 3 * np.sin(np.pi * a), lambda u: u)},
            ConfigurationError,
            "to undo to_input",
        ),
        ({"model": None}, ConfigurationError, "give a ControlAffineSDE"),
        ({"modell": None}, ConfigurationError, "did you mean 'model'"),
        ({"knowledge": "plant"}, ConfigurationError, "nothing is known but the model"),
    ],
)
def test_what_does_not_fit_is_explained(view, error, says):
    with pytest.raises(error, match=says):
        car(**view).reset(seed=0)


def test_what_cannot_be_filtered_is_refused():
    with pytest.raises(ConfigurationError, match="give model, barriers, state_fn"):
        SafetyFilterWrapper(gym.make("Pendulum-v1"), FILTER)
    with pytest.raises(ConfigurationError, match="needs state_fn too"):
        SafetyFilterWrapper(
            gym.make("Pendulum-v1"), FILTER, model=PENDULUM["model"], barriers=PENDULUM["barriers"]
        )
    with pytest.raises(ConfigurationError, match="a bounded Box"):
        SafetyFilterWrapper(gym.make("CartPole-v1"), FILTER, **PENDULUM, dt=0.02)
    with pytest.raises(ConfigurationError, match="has a model and barriers of its own"):
        SafetyFilterWrapper(gym.make("safe_envs/Pendulum-v0"), "scbf", **PENDULUM)


def test_the_right_wrapper_is_named():
    with pytest.raises(ConfigurationError, match="put SafetyFilterVectorWrapper over it"):
        SafetyFilterWrapper(gym.make_vec("safe_envs/Scalar-v0", num_envs=2), "scbf")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ConfigurationError, match="make them by gym"):
        SafetyFilterVectorWrapper(
            gym.vector.SyncVectorEnv([lambda: gym.make("safe_envs/Scalar-v0")]), "scbf"
        )


class _Whole(gym.Env):
    """Takes whole numbers only."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,))
    action_space = gym.spaces.Box(-5, 5, (1,), dtype=np.int64)


def test_actions_that_would_be_truncated_are_refused():
    with pytest.raises(ConfigurationError, match="Box of floats"):
        SafetyFilterWrapper(_Whole(), "cbf", **CAR)


def test_actions_that_are_no_numbers_are_refused():
    env = car()
    env.reset(seed=0)
    for action in ([np.nan], [0.0, 0.0]):
        with pytest.raises(InvalidInputError):
            env.step(action)


def test_an_episode_begins_without_the_cost_of_the_last():
    env = SafetyMonitor(gym.make("Pendulum-v1"), FilterSpec(**PENDULUM))
    observation, _ = env.reset(seed=0)
    info = {}
    for _ in range(100):
        observation, _, _, _, info = env.step(spun(observation))
    assert info["episode_cost"] > 0.0
    _, info = env.reset(seed=0)
    assert info["episode_cost"] == info["cost"]
    assert info["h_min"] == info["barrier"][0]
