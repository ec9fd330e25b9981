"""The figures of the benchmarks: times of its cases, their ratios, and the times of learning."""

from __future__ import annotations

import mmap
import time
import timeit
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from benchmarks import command_times, latency
from benchmarks.cases import (
    estimator_steps,
    filter_calls,
    fused_loop,
    hand_written_loop,
    several_constraints,
)
from safe_envs.engine.program import is_available
from safe_envs.filters.learning import LearnedModel, learner_of
from safe_envs.filters.learning.collection import draw_states
from safe_envs.registry import make_problem
from safe_envs.scripts.reports.installation import (
    ENV_ID,
    NUM_ENVS,
    Case,
    scalar_steps,
    vector_steps,
)
from safe_envs.wrappers import DDSCBF, BayesianSCBF, LearnedHOCBF, SafetyFilter

Figures = dict[str, float]
"""Numbers by name; times of cases are in microseconds for each state, or for each call."""

FUSED = "hand-fused loop"
BY_HAND = "hand-written compiled loop"
COMPILED = "compiled: "
"""Beginning of the names of what the compiled engine does; the rest is that of NumPy."""

_SPEED = "million steps a second"
_VECTOR = ("vector env, unfiltered", "vector env, filtered")
_EPISODES = {"numpy": 2_000, "compiled": 20_000}
_ROUNDS = 8
_SECONDS_PER_ROUND = 0.08
_NEW_BYTES = 1 << 20
_AMOUNT = {"points": 300, "repetitions": 10_000}
"""Data for both ways of the generator, as in the thesis."""

_LEARNED: dict[str, tuple[str, str, dict[str, Any]]] = {
    "learned-hocbf": ("DubinsDisk-v0", "learned-hocbf", {}),
    "ddscbf, network": ("Pendulum-v0", "ddscbf", {}),
    "ddscbf, degree 2, direct": ("ACCGap-v0", "ddscbf", {**_AMOUNT, "way": "direct"}),
    "ddscbf, degree 2, recursion": ("ACCGap-v0", "ddscbf", {**_AMOUNT, "way": "network"}),
    "bayesian-scbf, confidence": ("CubicSDEDisk-v0", "bayesian", {}),
}
"""Env, method and settings of each learned filter."""


class Part(NamedTuple):
    """A part of the benchmark.

    Attributes:
        what: is measured.
        measure: returns the figures.
    """

    what: str
    measure: Callable[[], Figures]


def parts() -> list[Part]:
    """Return the parts of the benchmark, in the order in which they are measured."""
    return [
        Part("single decisions", latency.measure),
        Part("filter calls and envs", _calls_and_envs),
        Part("learned filters", _learned_filters),
        Part("evaluations and the VecEnv of Stable-Baselines3", _engines),
        Part("commands that compute nothing", command_times.measure),
    ]


def _calls_and_envs() -> Figures:
    """Return microseconds for each state, and the ratios that matter."""
    calls = {**filter_calls(), **several_constraints(), **estimator_steps()}
    cases = {**calls, **scalar_steps(), **vector_steps()}
    compiled = _compiled_cases() if is_available() else {}
    times = _times({**cases, FUSED: fused_loop(), **compiled})
    return {
        **times,
        "filtered / unfiltered env.step": (
            times["env.step, filtered"] / times["env.step, unfiltered"]
        ),
        **_ratios_of_vector_envs(times),
        **_page_faults(cases["vector env, filtered"]),
    }


def _learned_filters() -> Figures:
    """Return microseconds for each state, and how long learning took."""
    learned, seconds = _learn()
    return {**_times(_learned_calls(learned)), **seconds}


def _engines() -> Figures:
    """Return the speeds of the engines."""
    found = _of_engine("numpy")
    if is_available():
        found |= {COMPILED + name: value for name, value in _of_engine("compiled").items()}
    return found


def side_by_side(figures: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Return the speeds of both engines, NumPy first, by what they do."""
    return {
        name: (value, figures[COMPILED + name])
        for name, value in figures.items()
        if COMPILED + name in figures and (_SPEED in name or "DummyVecEnv" in name)
    }


def _compiled_cases() -> dict[str, Case]:
    """Return what is compared with the hand-written loop; it is compiled before it is timed."""
    cases = {COMPILED + name: case for name, case in vector_steps("compiled").items()}
    return {**cases, BY_HAND: hand_written_loop()}


def _ratios_of_vector_envs(times: Mapping[str, float]) -> Figures:
    found = {
        f"{name}, {_SPEED}": 1.0 / times[name]
        for name in (*_VECTOR, *(COMPILED + name for name in _VECTOR))
        if name in times
    }
    found["speed of the filtered vector env / fused loop"] = times[FUSED] / times[_VECTOR[1]]
    if BY_HAND in times:
        ours = times[COMPILED + _VECTOR[1]]
        found["speed of the compiled filtered vector env / hand-written"] = times[BY_HAND] / ours
    return found


def _of_engine(engine: str) -> Figures:
    """Return the speed of evaluations and of the native VecEnv with an engine."""
    found = {f"evaluation, filtered, {_SPEED}": _evaluation(engine, 1), **_vec_envs(engine)}
    if engine == "compiled":
        found[f"evaluation, filtered, on all cores, {_SPEED}"] = _evaluation(engine, None)
    return found


def _evaluation(engine: str, jobs: int | None) -> float:
    """Return the million steps of an evaluation in a second."""
    from safe_envs.agents import evaluate

    def run(episodes: int) -> Any:
        return evaluate(
            ENV_ID,
            "nominal",
            "scbf",
            episodes=episodes,
            bounds=False,
            engine=engine,
            jobs=jobs,
        )

    run(10)
    steps = _EPISODES[engine] * make_problem(ENV_ID).steps
    seconds = min(timeit.repeat(lambda: run(_EPISODES[engine]), number=1, repeat=2))
    return 1e-6 * steps / seconds


def _times(cases: dict[str, Case]) -> Figures:
    """Return microseconds for each state, from the fastest of several rounds.

    The cases take turns, so that a disturbance of a second affects all of them alike.
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


def _learn() -> tuple[dict[str, LearnedModel], Figures]:
    """Return the models of the learned filters, and how many seconds each took to learn.

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
    """Return filter calls of each learned condition, at states of the sampling domain."""
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
        low, high = np.transpose(problem.input_bounds)
        x, u = draw_states(problem, NUM_ENVS, rng), rng.uniform(low, high, (NUM_ENVS, len(low)))
        acting = np.flatnonzero(safety_filter.filter(x, u).active.any(axis=1))[0]
        cases[f"{name}, 1 state"] = Case(
            lambda f=safety_filter, x=x[acting], u=u[acting]: f.filter(x, u)
        )
        cases[f"{name}, {NUM_ENVS} states"] = Case(
            lambda f=safety_filter, x=x, u=u: f.filter(x, u), NUM_ENVS
        )
    return cases


def _vec_envs(engine: str) -> Figures:
    """Return the speed of the native VecEnv over that of DummyVecEnv, with 64 envs each."""
    from benchmarks.vec_envs import speeds

    found = {}
    for name, text in (("unfiltered", None), ("filtered", "scbf")):
        measured = speeds(ENV_ID, filter=text, engine=engine)
        found[f"SB3 VecEnv of 64 / DummyVecEnv, {name}"] = (
            measured["SB3VecEnv"] / measured["DummyVecEnv"]
        )
    return found


def _page_faults(case: Case) -> Figures:
    """Return the page faults of a step after a warm-up; nothing where the system has no count."""
    try:
        import resource
    except ImportError:  # Not on Windows.
        return {}

    def faults_of(call: Callable[[], Any], number: int) -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(number):
            call()
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    # Kernels of some sandboxes do not count: they report zero even for new memory.
    if faults_of(lambda: mmap.mmap(-1, _NEW_BYTES).write(bytes(_NEW_BYTES)), 1) == 0:
        return {}
    steps = case.calls or 1
    faults_of(case.call, steps)
    return {"page faults a step of the filtered vector env": faults_of(case.call, steps) / steps}
