"""Filters over envs that know nothing of this project: Gymnasium's own, scalar and in batches."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from safe_envs import (
    ConfigurationError,
    InvalidInputError,
    RelativeDegreeError,
    SystemDefinitionError,
)
from safe_envs.plugins import load_object
from safe_envs.problem.backup import Backup, BackupLaw
from safe_envs.wrappers import (
    ActionMap,
    FilterSpec,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    SafetyMonitor,
)
from safe_envs.wrappers.filter_layers import ends_of
from tests.wrappers.cases import CAR, SWING, assert_plays_as_alone, rate, theta

FILTER = "cbf:alpha=2:sampling_margin=15"
SPEC = f"{Path(__file__).parents[2] / 'examples' / 'pendulum_v1.py'}:spec"


def spun(observation: np.ndarray) -> np.ndarray:
    """Torque that swings the pendulum up for ever."""
    return 2 * np.tanh(3 * observation[..., 2:])


def swing(**options):
    return SafetyFilterWrapper(gym.make("Pendulum-v1", **options), FILTER, **SWING)


def car(condition="cbf:alpha=0.05", **view):
    return SafetyFilterWrapper(gym.make("MountainCarContinuous-v0"), condition, **{**CAR, **view})


def smallest_h(env: gym.Env, episodes: int = 2) -> float:
    found = np.inf
    for seed in range(episodes):
        observation, _ = env.reset(seed=seed)
        info, truncated = {}, False
        while not truncated:
            observation, _, _, truncated, info = env.step(spun(observation))
        found = min(found, info["h_min"])
    return found


def test_a_filter_keeps_the_pendulum_slow_at_the_top():
    assert smallest_h(SafetyMonitor(gym.make("Pendulum-v1"), FilterSpec(**SWING))) < -30
    assert smallest_h(swing()) > 0


def test_a_backup_keeps_the_pendulum_slow():
    """Full torque against the motion below, where the pendulum hangs."""
    slow = sp.Integer(50) - rate**2 / 2 - 15 * (1 + sp.cos(theta))
    view = {**SWING, "barriers": slow}
    with pytest.raises(ConfigurationError, match="FilterSpec"):
        SafetyFilterWrapper(gym.make("Pendulum-v1"), "backup", **view)
    brake = Backup((BackupLaw("brake", (-2 * rate,), terminal=slow),), 2.0)
    env = SafetyFilterWrapper(gym.make("Pendulum-v1"), "backup", **view, backup=brake)
    env.reset(seed=0)
    assert all(env.step(np.array([2.0]))[-1]["feasible"] for _ in range(50))


def test_the_executed_action_is_the_filters_in_the_models_units():
    env, seen = car(), []
    env.reset(seed=0)
    step = env.unwrapped.step
    env.unwrapped.step = lambda action: (seen.append(action), step(action))[1]  # pyright: ignore
    for _ in range(150):
        *_, info = env.step(np.ones(1, dtype=np.float32))
    assert seen[-1].dtype == np.float32
    assert 0.6 * seen[-1] == pytest.approx(info["safe_action"], rel=1e-6)
    assert info["nominal_action"] == pytest.approx([0.6])
    assert info["episode_interventions"] > 0


def test_an_env_is_made_again_from_its_spec():
    env = SafetyFilterWrapper(SafetyMonitor(gym.make("Pendulum-v1"), SPEC), FILTER)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))  # pyright: ignore[reportOptionalMemberAccess]
    for made in (env, again):
        made.reset(seed=1)
    assert env.step([0.5])[4]["safe_action"] == again.step([0.5])[4]["safe_action"]


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
    views = {**SWING, "state_fn": lambda o: SWING["state_fn"](flat(o))}, SWING
    parts, plain = (
        SafetyFilterVectorWrapper(SyncVectorEnv(fns, autoreset_mode=mode), FILTER, **view)
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


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_a_batch_in_other_processes_plays_as_its_envs_do(mode):
    made = []

    def make(count=None, mode=mode):
        if count is None:
            return swing(max_episode_steps=5)
        envs = [lambda: gym.make("Pendulum-v1", max_episode_steps=5)] * count
        made.append(AsyncVectorEnv(envs, autoreset_mode=AutoresetMode(mode)))
        return SafetyFilterVectorWrapper(made[0], FILTER, **SWING, dt=0.05)

    assert assert_plays_as_alone(make, mode, count=2) > 2
    made[0].close()


def test_rounding_of_actions_is_no_change():
    view = {**SWING, "action_map": ActionMap.scaled(1.0, -1.4), "barriers": 100 - rate**2}
    inner = gym.Wrapper(SafetyMonitor(gym.make("Pendulum-v1"), FilterSpec(**view)))
    env = SafetyFilterWrapper(inner, "cbf")
    env.reset(seed=0)
    for action in np.linspace(-2, 2, 40, dtype=np.float32):
        assert env.step([action])[-1]["nominal_action"] == pytest.approx([action - 1.4], abs=1e-6)


@pytest.mark.parametrize(
    ("actions", "ends"),
    [
        (None, ([-2.0], [2.0])),
        (ActionMap.scaled(-3.0, 1.0), ([7.0], [-5.0])),
        (ActionMap(np.sinh, np.arcsinh), None),
    ],
)
def test_the_action_space_knows_the_inputs_at_its_ends(actions, ends):
    env = SafetyFilterWrapper(gym.make("Pendulum-v1"), "cbf:alpha=2", **SWING, action_map=actions)
    found = ends_of(env.action_space)
    assert (found and tuple(end.tolist() for end in found)) == ends


class _Whole(gym.Env):
    """Takes whole numbers only."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,))
    action_space = gym.spaces.Box(-5, 5, (1,), dtype=np.int64)


def over(env_id, condition=FILTER, **view):
    return SafetyFilterWrapper(gym.make(env_id), condition, **view)


NEEDED = {key: SWING[key] for key in ("model", "barriers")}


@pytest.mark.parametrize(
    ("call", "error", "fragment"),
    [
        *(
            (lambda view=view: car(**view).reset(seed=0), error, fragment)
            for view, error, fragment in (
                ({"state_fn": lambda o: o[..., :1]}, InvalidInputError, "state_fn"),
                ({"state_fn": lambda o: o * np.nan}, InvalidInputError, "finite"),
                ({"state_fn": lambda o: o["x"]}, InvalidInputError, "state_fn"),
                ({"state_fn": 3}, ConfigurationError, "state_fn = 3"),
                *(
                    ({"action_map": ActionMap(to, lambda u: u)}, ConfigurationError, "to_input")
                    for to in (lambda a: 2 * a, lambda a: a + 3 * np.sin(np.pi * a))
                ),
                ({"action_map": 2.0}, ConfigurationError, "action_map = 2.0"),
                ({"dt": None}, ConfigurationError, "dt"),
                ({"barriers": sp.Integer(1)}, RelativeDegreeError, "relative degree"),
                ({"barriers": []}, SystemDefinitionError, "barriers"),
                ({"model": None}, ConfigurationError, "model"),
                ({"modell": None}, ConfigurationError, "did you mean 'model'"),
                ({"knowledge": "plant"}, ConfigurationError, "knowledge = 'plant'"),
            )
        ),
        (lambda: over("Pendulum-v1"), ConfigurationError, "model, barriers, state_fn"),
        (lambda: over("Pendulum-v1", **NEEDED), ConfigurationError, "state_fn"),
        (lambda: over("CartPole-v1", **SWING, dt=0.02), ConfigurationError, "Box"),
        (lambda: over("safe_envs/Pendulum-v0", **SWING), ConfigurationError, "Pendulum"),
        (lambda: SafetyFilterWrapper(_Whole(), "cbf", **CAR), ConfigurationError, "floats"),
        (
            lambda: SafetyFilterWrapper(gym.make_vec("safe_envs/Scalar-v0", num_envs=2), "scbf"),  # pyright: ignore[reportArgumentType]
            ConfigurationError,
            "SafetyFilterVectorWrapper",
        ),
        *(
            (lambda make=make: SafetyFilterVectorWrapper(make(), "scbf"), ConfigurationError, says)
            for make, says in (
                (lambda: SyncVectorEnv([lambda: gym.make("safe_envs/Scalar-v0")]), "make_vec"),
                (lambda: gym.make_vec("Pendulum-v1", num_envs=2), "not one of this project"),
            )
        ),
        (lambda: FilterSpec.load(SPEC.replace(":spec", ":np")), ConfigurationError, "FilterSpec"),
    ],
)
def test_what_does_not_fit_is_explained(call, error, fragment):
    with pytest.raises(error, match=fragment):
        call()


@pytest.mark.parametrize("action", [[np.nan], [0.0, 0.0], ["a"]])
def test_actions_that_are_no_numbers_are_refused(action):
    env = car()
    env.reset(seed=0)
    with pytest.raises(InvalidInputError):
        env.step(action)


def test_an_episode_begins_without_the_cost_of_the_last():
    env = SafetyMonitor(gym.make("Pendulum-v1"), load_object(SPEC))
    observation, _ = env.reset(seed=0)
    info = {}
    for _ in range(100):
        observation, _, _, _, info = env.step(spun(observation))
    assert info["episode_cost"] > 0.0
    _, info = env.reset(seed=0)
    assert info["episode_cost"] == info["cost"]
    assert info["h_min"] == info["barrier"][0]
