"""Envs with all kinds of wrappers, one by one and in batches, and what each has to do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from safe_envs import ControlAffineSDE, SafeEnv, SafeVectorEnv
from safe_envs.wrappers import (
    ActionMap,
    CostReturnWrapper,
    RecordSafetyStatistics,
    RecordSafetyStatisticsVector,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    SpecificationMonitor,
    SpecificationMonitorVector,
    StateEstimatorVectorWrapper,
    StateEstimatorWrapper,
)
from tests.conftest import problem_of
from tests.oracles.carts import cart_problem
from tests.values.guesses import guess

MODES = [mode.value for mode in AutoresetMode]
SCALAR, DUBINS, LIMITS = (
    f"safe_envs/{name}-v0" for name in ("Scalar", "StochasticDubins", "QuadrotorLimits")
)
REACH, ACC, PENDULUM = (f"safe_envs/{name}-v0" for name in ("DubinsReach", "ACC", "Pendulum"))

Make = Callable[..., Any]
"""Of a number of envs and a mode, for a batch; of nothing, for one env."""

theta, rate, torque = sp.symbols("theta rate torque", real=True)
x, v, force = sp.symbols("x v force", real=True)


def angle_and_rate(o: np.ndarray) -> np.ndarray:
    return np.stack([np.arctan2(o[..., 1], o[..., 0]), o[..., 2]], axis=-1)


def as_it_is(o: np.ndarray) -> np.ndarray:
    return o


SWING = {
    "model": ControlAffineSDE((theta, rate), (torque,), [rate, 15 * sp.sin(theta)], [0, 3], [0, 0]),
    "barriers": 4 - rate**2 + 30 * (1 - sp.cos(theta)),
    "state_fn": angle_and_rate,
}
"""Of Pendulum-v1: slow at the top."""
CAR = {
    # Its acceleration is .0015 times the action: the model has it in units of the slope's .0025.
    "model": ControlAffineSDE((x, v), (force,), [v, -0.0025 * sp.cos(3 * x)], [0, 0.0025], [0, 0]),
    "barriers": -0.0002 - v**2 / 2 - 0.0025 / 3 * sp.sin(3 * x),
    "state_fn": as_it_is,
    "action_map": ActionMap.scaled(0.6),
    "dt": 1.0,
}
"""Of MountainCarContinuous-v0: below the tops of the hills."""


def near() -> Any:
    """DubinsReach a few steps before its goal, so that short episodes end in several ways."""
    return problem_of(REACH, start=[0.8, 0.6, 0.4, 1.2, 0.0], dt=0.1, noise=0.1, horizon=0.8)


@dataclass(frozen=True)
class Filtered:
    """An env of this project, a filter around it if any, and others around that.

    Attributes:
        env: id, or what returns a problem.
        filter: text, or what returns a filter.
        options: of the env.
        given: arguments of the filter's wrapper.
        around: further wrappers, of one env and of a batch.
        engine: of the batch.
    """

    env: str | Callable[[], Any]
    filter: str | Callable[[], Any] | None
    options: dict[str, Any]
    given: dict[str, Any]
    around: tuple[Any, Any] | None
    engine: str

    def __call__(self, count: int | None = None, mode: str = "NextStep") -> Any:
        if count is None:
            make, wrapper, options = gym.make, SafetyFilterWrapper, self.options
        else:
            make, wrapper = partial(gym.make_vec, num_envs=count), SafetyFilterVectorWrapper
            options = {**self.options, "autoreset_mode": mode, "engine": self.engine}
        if isinstance(self.env, str):
            found: Any = make(self.env, **options)
        else:
            kind = SafeEnv if count is None else partial(SafeVectorEnv, num_envs=count)
            found = kind(self.env(), **options)
        if self.filter is not None:
            text = self.filter if isinstance(self.filter, str) else self.filter()
            found = wrapper(found, text, **self.given)
        return self.around[count is not None](found) if self.around else found


def own(
    env: Any,
    filter: Any = None,  # noqa: A002
    *,
    given: Any = None,
    around: Any = None,
    engine: str = "numpy",
    **options: Any,
) -> Filtered:
    """A case of this project, by default with episodes of six control periods."""
    if isinstance(env, str) and not options.keys() & {"horizon", "terminate_on_violation"}:
        options["horizon"] = 6 * problem_of(env).dt
    return Filtered(env, filter, options, given or {}, around, engine)


@dataclass(frozen=True)
class ThirdParty:
    """An env of Gymnasium with a filter."""

    env: str
    filter: str
    view: dict[str, Any]

    def __call__(self, count: int | None = None, mode: str = "NextStep") -> Any:
        make = partial(gym.make, self.env, max_episode_steps=5)
        if count is None:
            return SafetyFilterWrapper(make(), self.filter, **self.view)
        envs = SyncVectorEnv([make] * count, autoreset_mode=AutoresetMode(mode))
        return SafetyFilterVectorWrapper(envs, self.filter, **self.view)


STATISTICS = (RecordSafetyStatistics, RecordSafetyStatisticsVector)
COSTS = (CostReturnWrapper, CostReturnWrapper)
SENSOR = ["default:bias=.03:dropout=.3", "delay=2"]


def judged(text: str) -> tuple[Any, Any]:
    return tuple(
        partial(kind, specification=text)
        for kind in (SpecificationMonitor, SpecificationMonitorVector)
    )


def estimated(observe: str) -> tuple[Any, Any]:
    """Around a measured env an estimator, and a filter of beliefs around that."""
    return tuple(
        partial(_at_estimates, estimator, wrapper, observe)
        for estimator, wrapper in (
            (StateEstimatorWrapper, SafetyFilterWrapper),
            (StateEstimatorVectorWrapper, SafetyFilterVectorWrapper),
        )
    )


def _at_estimates(estimator: Any, wrapper: Any, observe: str, env: Any) -> Any:
    return wrapper(estimator(env, "ekf", observe), "scbf:belief=0.05")


SMALL = {"barrier": {"radius": 0.5}, "horizon": 0.25}
"""In which most states are unsafe."""
SLEW = (-30.0, 20.0)
VIOLATING = {"start": [0.98], "noise": 2.0, "terminate_on_violation": True}

CASES: dict[str, Make] = {
    "several barriers": own(LIMITS, "hocbf", noise=0.05),
    "reached goal": own(near, "hocbf"),
    "ends at different times": own(SCALAR, noise=9.0, horizon=0.1),
    "ended by violations": own(SCALAR, "scbf", **VIOLATING),
    "begun in a violation": own(SCALAR, **{**VIOLATING, "start": [1.1]}),
    "goal of the filter": own(ACC, "cbf", given={"objective": "clf"}),
    "late": own(PENDULUM, delay=3, slew_limit=SLEW),
    "late, with a filter": own(PENDULUM, "szcbf:alpha=2", delay=3, model_delay=2, slew_limit=SLEW),
    "late, with several barriers": own(LIMITS, "hocbf", delay=2),
    "measured": own(ACC, measurement=SENSOR),
    "measured and late": own(PENDULUM, delay=2, measurement=SENSOR),
    "estimates": own(PENDULUM, around=estimated("estimate"), measurement=SENSOR),
    "measurements": own(PENDULUM, around=estimated("measurement"), measurement=SENSOR),
    "promise": own(
        SCALAR, partial(guess, horizon=0.06), given={"observe_promise": True}, horizon=0.06
    ),
    "backup": own(partial(cart_problem, horizon=0.6), "backup"),
    "specification": own(near, "hocbf", around=judged("always safe & eventually goal")),
    "bounded specification": own(near, around=judged("eventually[3,6] goal")),
    "statistics": own(DUBINS, "scbf", around=STATISTICS, **SMALL),
    "costs": own(DUBINS, around=COSTS, **SMALL),
    "third party": ThirdParty("Pendulum-v1", "cbf:alpha=2:sampling_margin=15", SWING),
    "third party in other units": ThirdParty("MountainCarContinuous-v0", "cbf:alpha=0.05", CAR),
    "compiled": own(DUBINS, engine="compiled"),
    "compiled with substeps": own(DUBINS, engine="compiled", substeps=3),
    "compiled filter": own(DUBINS, "scbf", engine="compiled"),
    "compiled reciprocal filter": own("safe_envs/CubicSDEDisk-v0", "rcbf", engine="compiled"),
    "compiled with several barriers": own(LIMITS, "hocbf", engine="compiled", noise=0.05),
    "compiled, ended by violations": own(SCALAR, "scbf", engine="compiled", **VIOLATING),
}
"""By what they show."""


def of_env(env_id: str, *, filtered: bool = True, engine: str = "numpy") -> Make:
    """A registered env with noise and short episodes, and its own filter."""
    text = problem_of(env_id).filter if filtered else None
    return own(env_id, text, engine=engine, noise=0.05)


FEW = (
    *("late, with a filter", "measured and late", "estimates", "promise"),
    *("backup", "specification", "compiled filter"),
)
each_mode = pytest.mark.parametrize(
    ("make", "mode"),
    [
        pytest.param(
            make,
            mode,
            id=f"{name}-{mode}",
            marks=[] if name in FEW or i % 3 == k else pytest.mark.oracle,
        )
        for i, (name, make) in enumerate(CASES.items())
        for k, mode in enumerate(MODES)
    ],
)
"""The few in every mode of autoreset, the others in one; `make oracle` has all in all."""
few_cases = pytest.mark.parametrize("make", [CASES[name] for name in FEW], ids=FEW)
"""With all that is remembered of an episode, each once."""


def actions(env: Any, rng: np.random.Generator) -> np.ndarray:
    """Some, also beyond the bounds."""
    space = env.action_space
    return (space.high * rng.uniform(-1.3, 1.3, space.shape)).astype(np.float32)


class ScalarEnvs:
    """What a vector env does, by a loop over its envs.

    Args:
        make: makes one env.
        count: of envs; env i is seeded by seed + i.
        mode: when the envs restart.
    """

    def __init__(self, make: Make, count: int, mode: str) -> None:
        self.envs, self.mode = [make() for _ in range(count)], mode
        self.ended = np.zeros(count, dtype=bool)

    def reset(self, mask: np.ndarray, seed: int | None = None) -> Iterator[tuple[int, Any]]:
        """Return what the envs of a mask say when they are reset, with their numbers."""
        for i in np.flatnonzero(mask):
            yield int(i), self.envs[i].reset(seed=None if seed is None else seed + int(i))
        self.ended &= ~mask

    def step(self, given: np.ndarray) -> list[tuple[Any, Any]]:
        """Return for each env what its step says, and its reset; one of them may be None."""
        found: list[tuple[Any, Any]] = []
        for i, env in enumerate(self.envs):
            if self.ended[i] and self.mode == "NextStep":
                found.append((None, env.reset()))
                self.ended[i] = False
                continue
            step = env.step(given[i])
            self.ended[i] = step[-3] or step[-2]
            restarts = self.ended[i] and self.mode == "SameStep"
            found.append((step, env.reset() if restarts else None))
        return found


def assert_close(ours: Any, theirs: Any, where: str) -> None:
    """Compare to the last bits, in which functions of NumPy and of `math` differ."""
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys(), where
        for key, value in theirs.items():
            assert_close(ours[key], value, f"{where}: {key}")
        return
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    assert ours.shape == theirs.shape, where
    if theirs.dtype == object:
        for mine, other in zip(ours, theirs, strict=True):
            assert (mine is None) == (other is None), where
            if other is not None:
                assert_close(mine, other, where)
        return
    exact = theirs.dtype == bool or np.issubdtype(theirs.dtype, np.integer)
    tolerances = {"rtol": 0.0, "atol": 0.0} if exact else {"rtol": 1e-6, "atol": 1e-9}
    np.testing.assert_allclose(ours, theirs, err_msg=where, **tolerances)


ALONGSIDE = ("episode", "cost_sum")
"""Keys of an episode's last step that stay outside of `final_info`."""


def assert_info(info: dict[str, Any], i: int, theirs: dict[str, Any], where: str) -> None:
    """Compare what a batch says of env i with what that env says."""
    for key, value in theirs.items():
        assert np.all(info[f"_{key}"][i]), f"{where}: {key} is masked"
        if isinstance(value, dict):
            for name in value.keys() - {"t"}:  # which is a time of day
                assert_close(info[key][name][i], value[name], f"{where}: {key} {name}")
        else:
            assert_close(info[key][i], value, f"{where}: {key}")
    more = {key for key in info if not key.startswith(("_", "final_")) and info[f"_{key}"][i].any()}
    assert more - set(theirs) <= {*ALONGSIDE}, where


def assert_plays_as_alone(
    make: Make, mode: str, count: int = 2, steps: int = 20, seed: int = 7
) -> int:
    """Play a batch and its envs one by one, with resets of some in between.

    Returns:
        How many episodes ended.
    """
    batch, alone, ends = make(count, mode), ScalarEnvs(make, count, mode), 0
    rng = np.random.default_rng(seed)

    def assert_reset(found: Any, begun: Any, where: str) -> None:
        for i, (observation, info) in begun:
            assert_close(found[0][i], observation, where)
            assert_info(found[1], i, info, f"{where} of env {i}")

    assert batch.metadata["autoreset_mode"] is AutoresetMode(mode)
    everywhere = np.ones(count, dtype=bool)
    assert_reset(batch.reset(seed=seed), alone.reset(everywhere, seed), "reset")
    for k in range(steps):
        mask = alone.ended if mode == "Disabled" else rng.random(count) < 0.1
        if mask.any():
            found = batch.reset(options={"reset_mask": mask.copy()})
            assert_reset(found, alone.reset(mask.copy()), f"reset before step {k}")
        given = actions(batch, rng)
        observation, *middle, info = batch.step(given)
        for i, (step, begun) in enumerate(alone.step(given)):
            where = f"step {k} of env {i}"
            if step is None:
                assert not any(np.any(part[i]) for part in middle), where
            else:
                for ours, theirs in zip(middle, step[1:-1], strict=True):
                    assert_close(ours[i], theirs, where)
                ends += bool(step[-3] or step[-2])
            if begun is None:
                assert_close(observation[i], step[0], where)
                assert_info(info, i, step[-1], where)
                continue
            assert_reset((observation, info), [(i, begun)], where)
            if step is not None:
                assert_close(info["final_obs"][i], step[0], f"{where}: last observation")
                assert info["_final_obs"][i]
                assert info["_final_info"][i]
                last = dict(step[-1])
                beside = {key: last.pop(key) for key in ALONGSIDE if key in last}
                assert_info(info["final_info"], i, last, f"{where}: last info")
                for key, value in beside.items():
                    mine = info[key]
                    for name in value if isinstance(value, dict) else ():
                        assert name == "t" or mine[name][i] == pytest.approx(value[name])
    return ends
