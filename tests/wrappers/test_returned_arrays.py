"""What is returned belongs to the caller: whatever is written into it changes nothing else."""

from __future__ import annotations

import copy
import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from safe_envs import ControlAffineSDE
from safe_envs.agents import make_sb3_env
from safe_envs.wrappers import (
    DelayedFilter,
    SafetyFilter,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    SpecificationMonitor,
    SpecificationMonitorVector,
)

ONE_INPUT, LIMITS = "safe_envs/StochasticDubins-v0", "safe_envs/QuadrotorLimits-v0"
ENVS, STEPS, SEED = 3, 7, 5
SHORT = {"horizon": 0.2}
"""In which episodes end."""

theta, rate, torque = sp.symbols("theta rate torque", real=True)
PENDULUM = {
    "model": ControlAffineSDE((theta, rate), (torque,), [rate, 15 * sp.sin(theta)], [0, 3], [0, 0]),
    "barriers": 4 - rate**2 + 30 * (1 - sp.cos(theta)),
    "state_fn": lambda o: np.stack([np.arctan2(o[..., 1], o[..., 0]), o[..., 2]], axis=-1),
}


def arrays(found: Any, name: str = "") -> list[tuple[str, np.ndarray]]:
    """All arrays in what was returned, with a name of each."""
    if isinstance(found, np.ndarray) and found.dtype != object:
        return [(name, found)]
    if isinstance(found, dict):
        return [a for key in found for a in arrays(found[key], f"{name} {key}")]
    if isinstance(found, list | tuple | np.ndarray):
        return [a for i, each in enumerate(found) for a in arrays(each, f"{name} {i}")]
    return []


def spoil(found: Any) -> None:
    """Write into every array that can be written to."""
    for _, array in arrays(found):
        if array.flags.writeable:
            array[...] = ~array if array.dtype == bool else 77


def scalar(env_id: str, condition: str | None = None, monitored: str = "", **options: Any):
    def make() -> Any:
        env: Any = gym.make(env_id, **options)
        more = {"estimator": "ekf"} if "measurement" in options else {}
        if condition is not None:
            env = SafetyFilterWrapper(env, condition, **more)
        return SpecificationMonitor(env, monitored) if monitored else env

    return make, (lambda env, action: env.step(action)), 0


def batch(
    env_id: str,
    condition: str | None = None,
    monitored: str = "",
    mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    **options: Any,
):
    def make() -> Any:
        env: Any = gym.make_vec(env_id, ENVS, autoreset_mode=mode, **options)
        more = {"estimator": "ekf"} if "measurement" in options else {}
        if condition is not None:
            env = SafetyFilterVectorWrapper(env, condition, **more)
        return SpecificationMonitorVector(env, monitored) if monitored else env

    return make, (lambda env, action: env.step(action)), ENVS


def third_party(mode: AutoresetMode):
    def make() -> Any:
        made = [lambda: gym.make("Pendulum-v1", max_episode_steps=4)] * ENVS
        envs = SyncVectorEnv(made, autoreset_mode=mode)
        return SafetyFilterVectorWrapper(envs, "cbf:alpha=2", **PENDULUM)

    return make, (lambda env, action: env.step(2 * action)), ENVS


class Loop:
    """A plant in a control loop, which executes what it is told at once."""

    def __init__(self, made: Any, state: np.ndarray) -> None:
        self._filter, self._start = made, state

    def reset(self, **_: Any) -> None:
        self._state = self._start.copy()
        getattr(self._filter, "reset", int)()

    def step(self, action: np.ndarray) -> Any:
        found = self._filter.filter(self._state.copy(), 5.0 * action)
        self._state = self._state + 0.01 * np.concatenate(
            [self._state[..., 1:2], found.action[..., :1]], axis=-1
        )
        return found, self._state.copy()


def loop(kind: str, count: int):
    x, v, u = sp.symbols("x v u", real=True)
    system = ControlAffineSDE.from_rate((x, v), (u,), [v, u])

    def make() -> Any:
        made: Any = SafetyFilter(system, 1 - x**2, "hocbf:p=2,8", (-5, 5))
        if kind == "delayed":
            made = DelayedFilter(made, 2, 0.01)
        state = np.array([0.5, 0.3])
        return Loop(made, np.tile(state, (count, 1)) if count else state)

    return make, (lambda env, action: env.step(action)), count


CASES = {
    "env": scalar(ONE_INPUT),
    "env with a filter": scalar(LIMITS, "hocbf"),
    "late env with a filter": scalar(ONE_INPUT, "scbf", delay=2, slew_limit=(-9.0, 9.0)),
    "measured env": scalar(ONE_INPUT, "scbf", measurement="default"),
    "env with a specification": scalar(ONE_INPUT, "scbf", "always safe"),
    "batch": batch(ONE_INPUT),
    "batch that ends": batch(ONE_INPUT, mode=AutoresetMode.SAME_STEP, **SHORT),
    "batch with a filter": batch(LIMITS, "hocbf"),
    "batch of one input": batch(ONE_INPUT, "scbf", mode=AutoresetMode.SAME_STEP, **SHORT),
    "late batch": batch("safe_envs/DubinsObstacles-v0", "hocbf", delay=2),
    "slow batch": batch(ONE_INPUT, slew_limit=(-9.0, 9.0)),
    "measured batch": batch(ONE_INPUT, "scbf", measurement="default", **SHORT),
    "batch with a specification": batch(
        ONE_INPUT, "scbf", "always safe", AutoresetMode.SAME_STEP, **SHORT
    ),
    "compiled batch": batch(ONE_INPUT, engine="compiled"),
    "compiled filter": batch(ONE_INPUT, "scbf", engine="compiled", **SHORT),
    "promise": batch("safe_envs/Scalar-v0", "promise:p=0.9", **SHORT),
    "third-party envs": third_party(AutoresetMode.NEXT_STEP),
    "third-party envs that end": third_party(AutoresetMode.SAME_STEP),
    "filter": loop("plain", 0),
    "filter of a batch": loop("plain", ENVS),
    "delayed filter": loop("delayed", 0),
    "delayed filter of a batch": loop("delayed", ENVS),
}


def played(case: str, then: Any) -> list[Any]:
    """What an env or a filter returns, call by call; `then` does something with each."""
    make, step, count = CASES[case]
    env, rng, found = make(), np.random.default_rng(0), []
    inputs = env.action_space.shape[-1] if hasattr(env, "action_space") else 1

    def returned(given: Any) -> None:
        found.append(copy.deepcopy(given))
        then(given)

    returned(env.reset(seed=SEED))
    for k in range(STEPS):
        shape = (count, inputs) if count else (inputs,)
        action = rng.uniform(-1.0, 1.0, shape).astype(np.float32)
        returned(step(env, action))
        spoil(action)
        if count and hasattr(env, "num_envs") and k == 3:
            mask = np.array([False, True, False])
            returned(env.reset(options={"reset_mask": mask}))
            spoil(mask)
    return found


@pytest.mark.parametrize("case", CASES)
def test_writing_into_what_is_returned_changes_nothing(case: str) -> None:
    for one, other in zip(played(case, lambda _: None), played(case, spoil), strict=True):
        for (name, theirs), (_, ours) in zip(arrays(one), arrays(other), strict=True):
            np.testing.assert_array_equal(ours, theirs, err_msg=f"{case}:{name}")


@pytest.mark.parametrize("case", CASES)
def test_no_two_arrays_that_are_returned_share_memory(case: str) -> None:
    def require_apart(given: Any) -> None:
        for (name, one), (other, two) in itertools.combinations(arrays(given), 2):
            assert not np.shares_memory(one, two), f"{case}: {name} and {other}"

    played(case, require_apart)


def test_the_infos_of_stable_baselines_are_their_own() -> None:
    found = []
    for then in (lambda _: None, spoil):
        env = make_sb3_env(ONE_INPUT, num_envs=ENVS, filter="scbf", seed=SEED, delay=1)
        env.reset()
        for _ in range(4):
            observation, _, _, infos = env.step(np.full((ENVS, 1), 0.7, dtype=np.float32))
            found.append(copy.deepcopy((observation, env.batch_info)))
            then((observation, [dict(info) for info in infos]))
    for one, other in zip(found[:4], found[4:], strict=True):
        for (_, theirs), (_, ours) in zip(arrays(one), arrays(other), strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_attributes_of_a_batch_are_read_only_and_inputs_are_copied() -> None:
    env: Any = gym.make_vec(ONE_INPUT, ENVS, delay=2, measurement="default")
    other: Any = gym.make_vec(ONE_INPUT, ENVS, delay=2, measurement="default")
    env.reset(seed=SEED)
    other.reset(seed=SEED)
    given = [np.full(ENVS, 0.5)]
    for _ in range(4):
        given[0][:] = 0.5
        mine, theirs = env.unwrapped.step_physical(given), other.unwrapped.step_physical([given[0]])
        given[0][:] = -9.0
        np.testing.assert_array_equal(mine[0], theirs[0])
        assert other.unwrapped.sent[0].tolist() == [0.5] * ENVS
    world = env.unwrapped
    for components in (world.components, world.sent, world.executed, *world.measured):
        assert not any(component.flags.writeable for component in components)
