"""The monitors of specifications: what they say is what the traces are."""

from __future__ import annotations

import copy
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, InvalidInputError
from safe_envs.envs.env import SafeEnv
from safe_envs.envs.vector_env import SafeVectorEnv
from safe_envs.filters.specification import Specification
from safe_envs.wrappers import (
    FilterSpec,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    SafetyMonitor,
    SafetyMonitorVector,
    SpecificationMonitor,
    SpecificationMonitorVector,
)
from tests.conftest import problem_of

ENV_ID = "safe_envs/DubinsReach-v0"
PENDULUM = f"{Path(__file__).parents[3] / 'examples' / 'pendulum_v1.py'}:spec"
KEYS = {"robustness": float, "satisfied": bool, "verdict": int, "automaton_state": int}
MODES = ["NextStep", "SameStep", "Disabled"]


def near():
    """The problem a few steps before the goal, so that short episodes end in several ways."""
    return problem_of(ENV_ID, start=[0.8, 0.6, 0.4, 1.2, 0.0], dt=0.1, noise=0.1, horizon=0.8)


def values_by_hand(states: np.ndarray) -> np.ndarray:
    """Values of safe, goal and gate, shape (3, B), of states (B, 5)."""
    px, py, _, ox, oy = states.T
    return np.array(
        [
            (px - ox) ** 2 + (py - oy) ** 2 - 0.16,
            0.09 - (px - 1.4) ** 2 - (py - 1.0) ** 2,
            0.16 - (px + 0.6) ** 2 - (py - 1.1) ** 2,
        ]
    )


def actions_of(k: int, count: int) -> np.ndarray:
    return np.random.default_rng([k]).uniform(-1.0, 1.0, (count, 1)).astype(np.float32)


def scalar_episode(seed: int, text: str, limit: int = 8) -> list[dict]:
    env = SpecificationMonitor(SafeEnv(near()), text)
    infos = [env.reset(seed=seed)[1]]
    for k in range(limit):
        *_, terminated, truncated, info = env.step(actions_of(k, 6)[seed])
        infos.append(info)
        if terminated or truncated:
            break
    return infos


def test_a_trace_is_judged_by_the_exact_states() -> None:
    env = SpecificationMonitor(SafeEnv(near()), "always safe & eventually goal | eventually gate")
    specification = Specification(env.tracker.specification.text, ("safe", "goal", "gate"))
    outcomes = set()
    for seed in range(12):
        _, info = env.reset(seed=seed)
        states, ended = [env.unwrapped.state], False
        while True:
            assert {key: type(info[key]) for key in KEYS} == KEYS
            trace = np.array([values_by_hand(np.array([x])) for x in states])
            robust = float(specification.robustness_of(trace)[0])
            assert info["robustness"] == pytest.approx(robust, rel=1e-12)
            assert info["satisfied"] == (robust > 0)
            assert info["verdict"] in (0, 1 if info["satisfied"] else -1)
            if ended:
                break
            *_, terminated, truncated, info = env.step(actions_of(seed, 1)[0] * (seed % 3))
            states.append(env.unwrapped.state)
            ended = terminated or truncated
        outcomes.add((info["satisfied"], info["violation"]))
    assert {True, False} == {satisfied for satisfied, _ in outcomes}


@pytest.mark.parametrize(
    ("mode", "engine"),
    [
        *((mode, "numpy") for mode in MODES),
        pytest.param("SameStep", "auto", marks=pytest.mark.slow),  # compiles for seconds
    ],
)
@pytest.mark.parametrize("text", ["always safe & eventually goal", "eventually[3,6] goal"])
def test_a_batch_says_what_scalar_episodes_say(text: str, mode: str, engine: str) -> None:
    scalar = [scalar_episode(seed, text) for seed in range(6)]
    env = SpecificationMonitorVector(SafeVectorEnv(near(), 6, mode, engine=engine), text)
    _, info = env.reset(seed=0)
    ended = np.zeros(6, dtype=bool)
    for k in range(8):
        for i in np.flatnonzero(~ended):
            assert {key: info[key][i].item() for key in KEYS} == pytest.approx(
                {key: scalar[i][k][key] for key in KEYS}, rel=1e-6
            )
        *_, terminated, truncated, info = env.step(actions_of(k, 6))
        last = info.get("final_info", info)
        for i in np.flatnonzero((terminated | truncated) & ~ended):
            assert {key: last[key][i].item() for key in KEYS} == pytest.approx(
                {key: scalar[i][-1][key] for key in KEYS}, rel=1e-6
            )
            assert len(scalar[i]) == k + 2
        ended |= terminated | truncated
        if mode == "Disabled" and ended.any():
            break
    assert ended.any()
    begun = scalar[0][0]
    if mode == "Disabled":
        _, info = env.reset(options={"reset_mask": ended})
        assert (info["_satisfied"] == ended).all()
        fresh = ended
    elif mode == "SameStep":
        fresh = terminated | truncated
    else:  # the step after an end begins an episode
        fresh = terminated | truncated
        *_, info = env.step(actions_of(0, 6))
    assert fresh.any()
    for i in np.flatnonzero(fresh):
        assert info["robustness"][i] == pytest.approx(begun["robustness"])
        assert info["automaton_state"][i] == begun["automaton_state"]
        assert env.tracker.steps[i] == 0


def test_filtered_envs_are_judged_by_the_exact_states() -> None:
    text = "always safe & eventually goal"
    inner = SafeVectorEnv(near(), 4, "Disabled")
    env = SpecificationMonitorVector(SafetyFilterVectorWrapper(inner, "hocbf"), text)
    env.reset(seed=3)
    trace = [values_by_hand(inner.state)[:2]]
    for k in range(4):
        *_, info = env.step(actions_of(k, 4))
        trace.append(values_by_hand(inner.state)[:2])
        expected = Specification(text, ("safe", "goal")).robustness_of(np.array(trace))
        np.testing.assert_allclose(info["robustness"], expected, rtol=1e-12)
    assert "feasible" in info
    scalar = SpecificationMonitor(SafetyFilterWrapper(SafeEnv(near()), "hocbf"), text)
    _, info = scalar.reset(seed=3)
    assert info["slack"] == 0.0
    assert info["robustness"] == pytest.approx(min(trace[0][:, 0]), rel=1e-12)


def test_snapshots_hold_the_traces() -> None:
    env = SpecificationMonitorVector(SafeVectorEnv(near(), 3, "Disabled"), "eventually[0,2] goal")
    env.reset(seed=0)
    env.step(actions_of(0, 3))
    there = env.snapshot()
    found = []
    for _ in range(2):
        env.restore(there, seed=5)
        assert (env.tracker.steps == 1).all()
        found.append([env.step(actions_of(k, 3))[4] for k in (1, 2)])
    for first, second in zip(*found, strict=True):
        for key in KEYS:
            assert (first[key] == second[key]).all()
    assert (found[0][1]["verdict"] != 0).all()


def test_third_party_envs_are_judged_through_their_monitor() -> None:
    spec = FilterSpec.load(PENDULUM)
    angle = spec.model.states[0]
    regions = {"upright": 0.01 - angle**2}
    text = "always safe & eventually upright"
    env = SpecificationMonitor(SafetyMonitor(gym.make("Pendulum-v1"), spec), text, regions)
    _, info = env.reset(seed=1)
    batch = SpecificationMonitorVector(
        SafetyMonitorVector(gym.make_vec("Pendulum-v1", num_envs=2), spec), text, regions
    )
    _, infos = batch.reset(seed=[1, 2])
    for _ in range(5):
        assert infos["robustness"][0] == pytest.approx(info["robustness"])
        *_, info = env.step(np.array([0.5], dtype=np.float32))
        *_, infos = batch.step(np.full((2, 1), 0.5, dtype=np.float32))


def test_last_states_of_third_party_envs_are_judged() -> None:
    spec = FilterSpec.load(PENDULUM)
    make = gym.vector.AutoresetMode.SAME_STEP
    vector = gym.vector.SyncVectorEnv(
        [lambda: gym.make("Pendulum-v1", max_episode_steps=4)] * 2, autoreset_mode=make
    )
    batch = SpecificationMonitorVector(SafetyMonitorVector(vector, spec), "always safe")
    env = SpecificationMonitor(
        SafetyMonitor(gym.make("Pendulum-v1", max_episode_steps=4), spec), "always safe"
    )
    batch.reset(seed=[1, 2])
    env.reset(seed=1)
    for _ in range(4):
        *_, truncated, infos = batch.step(np.full((2, 1), 0.5, dtype=np.float32))
        *_, info = env.step(np.array([0.5], dtype=np.float32))
    assert truncated.all()
    assert infos["final_info"]["robustness"][0] == pytest.approx(info["robustness"], rel=1e-6)
    assert (batch.tracker.steps == 0).all()


def test_mistakes_are_refused_before_a_step() -> None:
    env = SafeEnv(near())
    with pytest.raises(ConfigurationError, match="'hill' is no set"):
        SpecificationMonitor(env, "eventually hill")
    with pytest.raises(ConfigurationError, match="an episode has 8 steps"):
        SpecificationMonitor(env, "eventually[0,9] goal")
    with pytest.raises(ConfigurationError, match="FilterSpec"):
        SpecificationMonitor(gym.make("Pendulum-v1"), "always safe")
    x = sp.Symbol("x", real=True)
    found = SpecificationMonitor(env, "eventually hill", {"hill": 1 - x**2})
    assert copy.deepcopy(found).tracker.specification.atoms == ("hill",)


def test_specifications_judge_whole_episodes() -> None:
    state = near().starts[near().start].proposals(1)[0]
    env = SpecificationMonitor(SafeEnv(near()), "eventually[2,4] goal")
    envs = SpecificationMonitorVector(SafeVectorEnv(near(), 2), "eventually[2,4] goal")
    for each in (env, envs):
        for wrong in (True, [[1.0], [1.0, 2.0]], "late"):
            with pytest.raises(InvalidInputError, match="give a"):
                each.reset(options={"t": wrong})
    for each, late in ((env, 0.2), (envs, 0.2), (envs, [0.0, 0.2])):
        each.reset(seed=0, options={"state": state, "t": 0.0})
        before = each.unwrapped.state
        with pytest.raises(ConfigurationError, match="the specification is of whole episodes"):
            each.reset(seed=0, options={"t": late})
        np.testing.assert_array_equal(each.unwrapped.state, before)


def test_a_state_that_is_set_is_not_in_the_trace() -> None:
    env = SpecificationMonitor(SafeEnv(near()), "eventually goal")
    env.reset(seed=0)
    in_goal = env.unwrapped.state.copy()
    in_goal[:2] = 1.4, 1.0
    start = env.unwrapped.state
    env.unwrapped.state = in_goal
    env.unwrapped.state = start
    *_, info = env.step(np.zeros(1))
    assert not info["satisfied"]
    env.unwrapped.state = in_goal
    *_, info = env.step(np.zeros(1))
    assert info["satisfied"]
