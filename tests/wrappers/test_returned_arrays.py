"""What is returned belongs to the caller: whatever is written into it changes nothing else."""

from __future__ import annotations

import copy
import itertools
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE
from safe_envs.agents import make_sb3_env
from safe_envs.engine.program import Program
from safe_envs.wrappers import DelayedFilter, SafetyFilter
from tests.wrappers.cases import CASES, DUBINS

ENVS, SEED = 3, 5


def arrays(found: Any, name: str = "") -> list[tuple[str, np.ndarray]]:
    """All arrays in what was returned, with a name of each."""
    if isinstance(found, np.ndarray) and found.dtype != object:
        return [(name, found)]
    if isinstance(found, dict):
        return [a for key in found for a in arrays(found[key], f"{name} {key}") if key != "episode"]
    if isinstance(found, list | tuple | np.ndarray):
        return [a for i, each in enumerate(found) for a in arrays(each, f"{name} {i}")]
    return []


def spoil(found: Any) -> None:
    """Write into every array that can be written to."""
    for _, array in arrays(found):
        if array.flags.writeable:
            array[...] = ~array if array.dtype == bool else 77


class Loop:
    """A plant in a control loop, which executes what it is told at once."""

    def __init__(self, delay: int, count: int | None = None, mode: str = "") -> None:
        x, v, u = sp.symbols("x v u", real=True)
        system = ControlAffineSDE.from_rate((x, v), (u,), [v, u])
        self.filter: Any = SafetyFilter(system, 1 - x**2, "hocbf:alpha=2,8", (-5, 5))
        if delay:
            self.filter = DelayedFilter(self.filter, delay, 0.01)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,) if count is None else (count, 1))

    def reset(self, **_: Any) -> None:
        shape = (*self.action_space.shape[:-1], 2)
        self.state = np.broadcast_to([0.5, 0.3], shape).copy()
        getattr(self.filter, "reset", int)()

    def step(self, action: np.ndarray) -> Any:
        found = self.filter.filter(self.state.copy(), 5.0 * action)
        rate = np.concatenate([self.state[..., 1:2], found.action[..., :1]], axis=-1)
        self.state = self.state + 0.01 * rate
        return found, self.state.copy()


MAKERS = {**CASES, "loop": partial(Loop, 0), "delayed loop": partial(Loop, 2)}


def played(make: Any, count: int | None, then: Any) -> list[Any]:
    """What an env or a filter returns, call by call; `then` does something with each."""
    env, rng, found = make(count, "SameStep") if count else make(), np.random.default_rng(0), []

    def returned(given: Any) -> None:
        found.append(copy.deepcopy(given))
        then(given)

    returned(env.reset(seed=SEED))
    for k in range(7):
        shape = env.action_space.shape
        action = rng.uniform(-1.0, 1.0, shape).astype(np.float32)
        step = env.step(action)
        returned(step)
        spoil(action)
        if count is None and isinstance(step[-2], bool) and (step[-3] or step[-2]):
            returned(env.reset())
        if count and hasattr(env, "num_envs") and k == 3:
            mask = np.array([False, True, False])
            returned(env.reset(options={"reset_mask": mask}))
            spoil(mask)
    return found


@pytest.mark.parametrize("count", [None, ENVS], ids=["one", "batch"])
@pytest.mark.parametrize("name", MAKERS)
def test_writing_into_what_is_returned_changes_nothing(name, count, monkeypatch):
    if not count and (name.startswith("compiled") or "other units" in name):
        pytest.skip("of batches only; MountainCar hands out its own state")
    monkeypatch.setattr(Program, "compiled", Program.plain)

    def require_apart(given: Any) -> None:
        for (one, mine), (other, theirs) in itertools.combinations(arrays(given), 2):
            assert not np.shares_memory(mine, theirs), f"{one} and {other}"

    left, spoilt = (played(MAKERS[name], count, then) for then in (require_apart, spoil))
    for one, other in zip(left, spoilt, strict=True):
        for (where, theirs), (_, ours) in zip(arrays(one), arrays(other), strict=True):
            np.testing.assert_array_equal(ours, theirs, err_msg=where)


def test_the_infos_of_stable_baselines_are_their_own():
    found = []
    for then in (lambda _: None, spoil):
        env = make_sb3_env(DUBINS, num_envs=ENVS, filter="scbf", seed=SEED, delay=1)
        env.reset()
        for _ in range(4):
            observation, _, _, infos = env.step(np.full((ENVS, 1), 0.7, dtype=np.float32))
            found.append(copy.deepcopy((observation, env.batch_info)))
            then((observation, [dict(info) for info in infos]))
    for one, other in zip(found[:4], found[4:], strict=True):
        for (_, theirs), (_, ours) in zip(arrays(one), arrays(other), strict=True):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
def test_attributes_of_a_batch_are_read_only_and_inputs_are_copied(engine, monkeypatch):
    monkeypatch.setattr(Program, "compiled", Program.plain)
    options = {"delay": 2, "measurement": "default"} if engine == "numpy" else {}
    env, other = (gym.make_vec(DUBINS, ENVS, engine=engine, **options).unwrapped for _ in range(2))
    env.reset(seed=SEED)
    other.reset(seed=SEED)
    given = [np.full(ENVS, 0.5)]
    for _ in range(4):
        given[0][:] = 0.5
        mine, theirs = env.step_physical(given), other.step_physical([given[0]])
        given[0][:] = -9.0
        np.testing.assert_array_equal(mine[0], theirs[0])
        assert other.sent[0].tolist() == [0.5] * ENVS
    measured = [] if env.measured is None else [*env.measured.values, *env.measured.received]
    for component in (*env.components, *env.sent, *env.executed, *measured):
        assert not component.flags.writeable
    for single in (env, gym.make(DUBINS).unwrapped):
        single.reset(seed=0)
        with pytest.raises(ValueError, match="read-only"):
            single.state[0] = 2.0


def test_what_a_caller_does_to_an_observation_does_not_reach_the_state():
    batch = CASES["third party in other units"](1)
    observations, _ = batch.reset(seed=0)
    before = [float(c[0]) for c in batch.env.components]
    observations -= 100
    assert [float(c[0]) for c in batch.env.components] == before


def test_decisions_share_no_memory_with_what_was_given():
    x, u = sp.symbols("x u", real=True)
    system = ControlAffineSDE.from_rate((x,), (u,), [u])
    for barriers in (1 - x, [1 - x, 2 + x]):
        safety_filter = SafetyFilter(system, barriers, "cbf", input_bounds=(-1.0, 1.0))
        for shape in ((1,), (3, 1), (1, 1), (2, 3, 1)):
            states, inputs = np.zeros(shape), np.full(shape, 0.5)
            decision = safety_filter.filter(states, inputs)
            for part in decision:
                assert not np.shares_memory(part, states)
                assert not np.shares_memory(part, inputs)
            inputs[:] = 7.0
            np.testing.assert_array_equal(decision.proposed, np.full(shape, 0.5))
