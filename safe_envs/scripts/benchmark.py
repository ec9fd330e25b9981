"""How fast are a filter call, an env step and a vector env, next to a hand-written loop with
nothing else in it? And learning?"""

from __future__ import annotations

import mmap
import os
import time
import timeit
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import sympy as sp
from rich.table import Table

import safe_envs
from safe_envs import Barrier, ControlAffineSDE
from safe_envs.bounded_reading import read_json
from safe_envs.errors import ConfigurationError
from safe_envs.registry import make_problem
from safe_envs.scripts.options.console import require_result, say, stdout, write_result
from safe_envs.scripts.reports.tables import make_table
from safe_envs.wrappers import (
    CBF,
    DDSCBF,
    HOCBF,
    BayesianSCBF,
    LearnedHOCBF,
    SafetyFilter,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    parse_conditions,
)
from safe_envs.wrappers.learning import LearnedModel, learner_of
from safe_envs.wrappers.learning.data.collection import draw_states

_ID = "safe_envs/StochasticDubins-v0"
_LIMITS = "safe_envs/QuadrotorLimits-v0"
_BATCHES = (1, 32, 1024, 10_000)
_NUM_ENVS = 1024
_FUSED = "hand-fused loop"
_ROUNDS = 15
_SECONDS_PER_ROUND = 0.08
_NEW_BYTES = 1 << 20
_LEARNED: dict[str, tuple[str, str, dict[str, Any]]] = {
    "learned-hocbf": ("DubinsDisk-v0", "learned-hocbf", {}),
    "ddscbf, network": ("Pendulum-v0", "ddscbf", {}),
    "ddscbf, degree 2, direct": (
        "ACCGap-v0",
        "ddscbf",
        {"points": 300, "repetitions": 10_000, "way": "direct"},
    ),
    "ddscbf, degree 2, recursion": (
        "ACCGap-v0",
        "ddscbf",
        {"points": 300, "repetitions": 10_000, "way": "network"},
    ),
    "bayesian-scbf, confidence": ("CubicSDEDisk-v0", "bayesian", {}),
}
"""Env, method and settings of each learned filter."""

Figures = dict[str, float]


class Case(NamedTuple):
    """Something to time.

    Attributes:
        call: what is timed.
        states: how many it handles.
        prepare: done before each round.
        calls: in a round; None for as many as fit its time.
    """

    call: Callable[[], Any]
    states: int = 1
    prepare: Callable[[], Any] = lambda: None
    calls: int | None = None


def benchmark(json_file: Path | None = None, compare: Path | None = None) -> None:
    """Measure, print and, if asked, write the speed of filter calls, scalar and vector steps, the
    fused limit, and of learning.

    Args:
        json_file: where the figures go.
        compare: figures of an earlier run, to print what has become of them.

    Raises:
        ConfigurationError: the file cannot be written, or that of an earlier run not be read.
    """
    require_result(json_file)
    earlier = {} if compare is None else read_figures(compare)
    figures = measure()
    console = stdout()
    say(
        console,
        f"{_ID} with scbf, safe-envs {safe_envs.__version__}, on one of {os.cpu_count()} cores\n",
    )
    console.print(table_of(figures, earlier))
    write_result(json_file, lambda: figures)


def measure() -> Figures:
    """Return microseconds for each state, and the ratios that matter."""
    learned, seconds = _learn()
    cases = {
        **_filter_calls(),
        **_several_rows(),
        **_learned_calls(learned),
        **_scalar_steps(),
        **_vector_steps(),
    }
    times = _times({**cases, _FUSED: _fused_loop()})
    return {
        **times,
        "filtered / bare env.step": times["env.step, filtered"] / times["env.step, bare"],
        "vector env, bare, million steps a second": 1.0 / times["vector env, bare"],
        "vector env, filtered, million steps a second": 1.0 / times["vector env, filtered"],
        "speed of the filtered vector env / fused loop": (
            times[_FUSED] / times["vector env, filtered"]
        ),
        **_page_faults(cases["vector env, filtered"]),
        **seconds,
        **_vec_envs(),
    }


def _times(cases: dict[str, Case]) -> Figures:
    """Microseconds for each state, from the quickest of several rounds.

    The cases take turns, so that what else the machine does for a second disturbs all of them
    alike.
    """
    numbers = {}
    for name, case in cases.items():
        case.prepare()
        numbers[name] = case.calls or max(
            1, int(_SECONDS_PER_ROUND / max(timeit.timeit(case.call, number=5) / 5, 1e-7))
        )
    best = dict.fromkeys(cases, float("inf"))
    for _ in range(_ROUNDS):
        for name, case in cases.items():
            case.prepare()
            seconds = timeit.timeit(case.call, number=numbers[name]) / numbers[name]
            best[name] = min(best[name], 1e6 * seconds / case.states)
    return best


def _filter_calls() -> dict[str, Case]:
    safety_filter = SafetyFilterWrapper(gym.make(_ID), "scbf").safety_filter
    rng = np.random.default_rng(0)
    cases = {}
    for batch in _BATCHES:
        leading = () if batch == 1 else (batch,)
        x, u = rng.uniform(-2.0, 2.0, (*leading, 3)), rng.uniform(-10.0, 10.0, (*leading, 1))
        cases[f"filter call, {batch} state{'s' * (batch > 1)}"] = Case(
            lambda x=x, u=u: safety_filter.filter(x, u), batch
        )
    return cases


def _several_rows() -> dict[str, Case]:
    """A point mass in the plane with two inputs, an obstacle, a wall and a speed limit; and a
    quadrotor with four rotors."""
    x, y, v, w, a, b = sp.symbols("x y v w a b", real=True)
    point = ControlAffineSDE(
        (x, y, v, w), (a, b), [v, w, 0, 0], [[0, 0], [0, 0], [1, 0], [0, 1]], [0, 0, 0, 0]
    )
    rows = [
        (Barrier(x**2 + y**2 - 1), HOCBF((2, 2))),
        (Barrier(3 - x), HOCBF((1, 1))),
        (Barrier(1 - v**2 - w**2), CBF(1.0)),
    ]
    in_plane = SafetyFilter(point, rows, [(-2.0, 2.0)] * 2)
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, _NUM_ENVS), rng.uniform(1.1, 2.0, _NUM_ENVS)
    states = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), *rng.uniform(-0.6, 0.6, (2, _NUM_ENVS))],
        axis=1,
    )
    inputs = rng.uniform(-3.0, 3.0, (_NUM_ENVS, 2))
    acting = np.flatnonzero(in_plane.filter(states, inputs).active.any(axis=1))[0]
    problem = gym.make(_LIMITS).unwrapped.problem  # pyright: ignore[reportAttributeAccessIssue]
    limits = SafetyFilter.for_problem(problem, parse_conditions("hocbf", problem))
    envs = gym.make_vec(_LIMITS, num_envs=_NUM_ENVS)
    envs.reset(seed=0)
    flying = envs.unwrapped.state + rng.normal(0.0, 0.7, (_NUM_ENVS, 12))  # pyright: ignore[reportAttributeAccessIssue]
    low, high = np.transpose(problem.box)
    rotors = rng.uniform(low, high, (_NUM_ENVS, 4))
    return {
        "three rows, two inputs, 1 state": Case(
            lambda: in_plane.filter(states[acting], inputs[acting])
        ),
        f"three rows, two inputs, {_NUM_ENVS} states": Case(
            lambda: in_plane.filter(states, inputs), _NUM_ENVS
        ),
        f"three rows, four inputs (ProxQP), {_NUM_ENVS} states": Case(
            lambda: limits.filter(flying, rotors), _NUM_ENVS
        ),
    }


def _learn() -> tuple[dict[str, LearnedModel], Figures]:
    """What the learned filters rest on, and how many seconds each took; for the two ways of the
    generator the thesis' amount of data.

    The thesis reports more than 5 hours for the recursion and 15 s for the Bayesian identification.
    """
    learned, seconds = {}, {}
    for name, (env_id, method, settings) in _LEARNED.items():
        problem = make_problem(env_id)
        began = time.perf_counter()
        learned[name] = learner_of(method)(problem, **settings)
        seconds[f"{name}, learned in s"] = time.perf_counter() - began
    return learned, seconds


def _learned_calls(learned: Mapping[str, LearnedModel]) -> dict[str, Case]:
    """Filter calls of each learned condition, at states where the problem is explored."""
    conditions: dict[str, Callable[[Any, Any], Any]] = {
        "learned-hocbf": lambda model, problem: LearnedHOCBF(model, problem.gains),
        "ddscbf": lambda model, _: DDSCBF(model),
        "bayesian": lambda model, _: BayesianSCBF(model, confidence=0.95),
    }
    cases, rng = {}, np.random.default_rng(0)
    for name, (env_id, method, _) in _LEARNED.items():
        problem = make_problem(env_id)
        safety_filter = SafetyFilter.for_problem(
            problem, conditions[method](learned[name], problem)
        )
        low, high = np.transpose(problem.box)
        x, u = draw_states(problem, _NUM_ENVS, rng), rng.uniform(low, high, (_NUM_ENVS, len(low)))
        acting = np.flatnonzero(safety_filter.filter(x, u).active.any(axis=1))[0]
        cases[f"{name}, 1 state"] = Case(
            lambda f=safety_filter, x=x[acting], u=u[acting]: f.filter(x, u)
        )
        cases[f"{name}, {_NUM_ENVS} states"] = Case(
            lambda f=safety_filter, x=x, u=u: f.filter(x, u), _NUM_ENVS
        )
    return cases


def _vec_envs() -> Figures:
    """The VecEnv over the native vector env, as a multiple of the speed of DummyVecEnv over 64
    scalar envs."""
    from safe_envs.agents.training.vec_env_speed import speeds

    found = {}
    for name, text in (("bare", None), ("filtered", "scbf")):
        measured = speeds(_ID, filter=text)
        found[f"SB3 VecEnv of 64 / DummyVecEnv, {name}"] = (
            measured["SafeVecEnv"] / measured["DummyVecEnv"]
        )
    return found


def _scalar_steps() -> dict[str, Case]:
    # No episode may end within a round: the vehicle turns on the spot, with little noise.
    bare = gym.make(_ID, horizon=1e9, start=[0.0, 0.0, 0.0], noise=0.01)
    filtered = SafetyFilterWrapper(
        gym.make(_ID, horizon=1e9, start=[0.0, 0.0, 0.0], noise=0.01), "scbf"
    )
    action = np.array([0.9], dtype=np.float32)
    return {
        f"env.step, {name}": Case(
            lambda env=env: env.step(action), prepare=lambda env=env: env.reset(seed=0)
        )
        for name, env in (("bare", bare), ("filtered", filtered))
    }


def _vector_steps() -> dict[str, Case]:
    bare = gym.make_vec(_ID, num_envs=_NUM_ENVS)
    filtered = SafetyFilterVectorWrapper(gym.make_vec(_ID, num_envs=_NUM_ENVS), "scbf")
    actions = np.full((_NUM_ENVS, 1), 0.3, dtype=np.float32)
    cases = {}
    for name, env in (("bare", bare), ("filtered", filtered)):
        env.reset(seed=0)
        # Ten whole episodes, so that resets and the drawing of noise have their share of every
        # round.
        calls = 10 * (env.unwrapped.problem.steps + 1)  # pyright: ignore[reportAttributeAccessIssue]
        cases[f"vector env, {name}"] = Case(
            lambda env=env: env.step(actions), _NUM_ENVS, calls=calls
        )
    return cases


def _page_faults(case: Case) -> Figures:
    """How often a step makes the system find new memory, once all is warm; nothing where the system
    does not count it."""
    try:
        import resource
    except ImportError:  # Not on Windows.
        return {}

    def faults_of(call: Callable[[], Any], number: int) -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(number):
            call()
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    # Kernels of some sandboxes report zero, whatever happens: none for new memory means that they
    # do not count.
    if faults_of(lambda: mmap.mmap(-1, _NEW_BYTES).write(bytes(_NEW_BYTES)), 1) == 0:
        return {}
    steps = case.calls or 1
    faults_of(case.call, steps)
    return {"page faults a step of the filtered vector env": faults_of(case.call, steps) / steps}


def _fused_loop() -> Case:
    """The Dubins SCBF written by hand: no reward, no observation, no info, no reset, no checks."""
    problem = gym.make(_ID).unwrapped.problem  # pyright: ignore[reportAttributeAccessIssue]
    values = {parameter.name: value for parameter, value in problem.plant.parameters.items()}
    v, dt, (low, high) = values["v"], problem.dt, problem.box[0]
    root = values["sigma_1"] * dt**0.5
    rng = np.random.default_rng(0)
    x, y, theta = rng.uniform(-1.0, 1.0, (3, _NUM_ENVS))
    nominal = np.full(_NUM_ENVS, 3.0)

    def step() -> None:
        nonlocal x, y, theta
        cos, sin = np.cos(theta), np.sin(theta)
        # A A h = a u + b, with a = 2 v (x sin - y cos) and b = -2 v^2: thesis Eq. (4.25).
        a, b = 2 * v * (x * sin - y * cos), -2 * v * v
        u = np.clip(np.where(a * nominal + b >= 0, nominal, -b / a), low, high)
        w = rng.standard_normal((2, _NUM_ENVS))
        x = x + v * cos * dt + root * w[0]
        y = y + v * sin * dt + root * w[1]
        theta = theta + u * dt

    return Case(step, _NUM_ENVS)


def read_figures(path: Path) -> Figures:
    """Read what an earlier run wrote with --json.

    Raises:
        ConfigurationError: there is no such file, or something else is in it.
    """
    found = read_json(path, "give what `safe-envs benchmark --json FILE` wrote as --compare")
    if (
        not isinstance(found, dict)
        or _FUSED not in found
        or not all(isinstance(value, int | float) for value in found.values())
    ):
        raise ConfigurationError(
            f"--compare {path} holds no figures; give what `safe-envs benchmark --json FILE` wrote"
        )
    return found


def table_of(figures: Figures, earlier: Figures) -> Table:
    """The figures, and where there are earlier ones, those and the ratio to them."""
    first = (
        "microseconds for each state, seconds where they are named, or a ratio; vector envs of"
        f" {_NUM_ENVS}"
    )
    titles = ("figure", *["earlier", "figure / earlier"] * bool(earlier))
    table = make_table("pr", first, *titles, tight=False)
    for name, value in figures.items():
        before = earlier.get(name)
        beside = ["-", "-"] if not before else [f"{before:.3g}", f"{value / before:.2f}"]
        table.add_row(name, f"{value:.3g}", *beside * bool(earlier))
    return table


if __name__ == "__main__":
    from safe_envs.scripts.cli import main

    main("benchmark")
