"""The monitors of specifications: what they say is what the traces are."""

from __future__ import annotations

import copy
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs import ConfigurationError, InvalidInputError, SafeEnv, SafeVectorEnv
from safe_envs.filters.specification import Specification
from safe_envs.wrappers import (
    FilterSpec,
    SafetyFilterVectorWrapper,
    SafetyMonitor,
    SafetyMonitorVector,
    SpecificationMonitor,
    SpecificationMonitorVector,
)
from tests.wrappers.cases import MODES, assert_plays_as_alone, near

PENDULUM = f"{Path(__file__).parents[2] / 'examples' / 'pendulum_v1.py'}:spec"
SAFELY = "always safe & eventually goal"


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


def test_a_trace_is_judged_by_the_exact_states() -> None:
    env = SpecificationMonitor(SafeEnv(near()), f"{SAFELY} | eventually gate")
    specification = Specification(env.tracker.specification.text, ("safe", "goal", "gate"))
    outcomes = set()
    for seed in range(12):
        _, info = env.reset(seed=seed)
        states, ended = [env.unwrapped.state], False
        while True:
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


def test_filtered_envs_are_judged_by_the_exact_states() -> None:
    inner = SafeVectorEnv(near(), 4, "Disabled")
    env = SpecificationMonitorVector(SafetyFilterVectorWrapper(inner, "hocbf"), SAFELY)
    env.reset(seed=3)
    trace = [values_by_hand(inner.state)[:2]]
    for k in range(4):
        *_, info = env.step(actions_of(k, 4))
        trace.append(values_by_hand(inner.state)[:2])
        expected = Specification(SAFELY, ("safe", "goal")).robustness_of(np.array(trace))
        np.testing.assert_allclose(info["robustness"], expected, rtol=1e-12)


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
        for key in ("robustness", "satisfied", "verdict", "automaton_state"):
            assert (first[key] == second[key]).all()
    assert (found[0][1]["verdict"] != 0).all()


@pytest.mark.parametrize("mode", MODES)
def test_third_party_envs_are_judged_through_their_monitor(mode) -> None:
    spec = FilterSpec.load(PENDULUM)
    given = "always safe & eventually upright", {"upright": 0.01 - spec.model.states[0] ** 2}

    def make(count=None, mode=mode):
        def one():
            return gym.make("Pendulum-v1", max_episode_steps=4)

        if count is None:
            return SpecificationMonitor(SafetyMonitor(one(), spec), *given)
        resets = gym.vector.AutoresetMode(mode)
        envs = gym.vector.SyncVectorEnv([one] * count, autoreset_mode=resets)
        return SpecificationMonitorVector(SafetyMonitorVector(envs, spec), *given)

    assert assert_plays_as_alone(make, mode) > 2


@pytest.mark.usefixtures("plain")
def test_a_compiled_batch_is_judged_as_its_envs_are() -> None:
    def make(count=None, mode="SameStep"):
        if count is None:
            return SpecificationMonitor(SafeEnv(near()), SAFELY)
        return SpecificationMonitorVector(SafeVectorEnv(near(), count, mode, engine="auto"), SAFELY)

    assert assert_plays_as_alone(make, "SameStep") > 2


X = sp.Symbol("x", real=True)


@pytest.mark.parametrize(
    ("text", "fragment"),
    [("eventually hill", "'hill'"), ("eventually[0,9] goal", "8 steps"), (None, "FilterSpec")],
)
def test_mistakes_are_refused_before_a_step(text, fragment) -> None:
    env = gym.make("Pendulum-v1") if text is None else SafeEnv(near())
    with pytest.raises(ConfigurationError, match=fragment):
        SpecificationMonitor(env, text or "always safe")
    found = SpecificationMonitor(SafeEnv(near()), "eventually hill", {"hill": 1 - X**2})
    assert copy.deepcopy(found).tracker.specification.atoms == ("hill",)


@pytest.mark.parametrize("count", [None, 2])
def test_specifications_judge_whole_episodes(count) -> None:
    text = "eventually[2,4] goal"
    each = (
        SpecificationMonitor(SafeEnv(near()), text)
        if count is None
        else SpecificationMonitorVector(SafeVectorEnv(near(), count), text)
    )
    for wrong in (True, [[1.0], [1.0, 2.0]], "late"):
        with pytest.raises(InvalidInputError, match="give a"):
            each.reset(options={"t": wrong})
    state = near().starts[near().start].proposals(1)[0]
    each.reset(seed=0, options={"state": state, "t": 0.0})
    before = each.unwrapped.state
    for late in (0.2,) if count is None else (0.2, [0.0, 0.2]):
        with pytest.raises(ConfigurationError, match="whole episodes"):
            each.reset(seed=0, options={"t": late})
        np.testing.assert_array_equal(each.unwrapped.state, before)


def test_a_state_that_is_set_is_not_in_the_trace() -> None:
    env = SpecificationMonitor(SafeEnv(near()), "eventually goal")
    env.reset(seed=0)
    in_goal, start = env.unwrapped.state.copy(), env.unwrapped.state
    in_goal[:2] = 1.4, 1.0
    env.unwrapped.state = in_goal
    env.unwrapped.state = start
    assert not env.step(np.zeros(1))[-1]["satisfied"]
    env.unwrapped.state = in_goal
    assert env.step(np.zeros(1))[-1]["satisfied"]
