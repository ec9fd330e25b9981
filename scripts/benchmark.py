"""How fast are a filter call, an env step and a vector env, next to a hand-written loop with nothing else in it?"""

from __future__ import annotations

import json
import os
import timeit
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

import safe_envs
from safe_envs.files import write_atomically
from wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper

_ID = "safe_envs/StochasticDubins-v0"
_BATCHES = (1, 32, 1024, 10_000)
_NUM_ENVS = 1024
_ROUNDS = 7
_SECONDS_PER_ROUND = 0.15

Figures = dict[str, float]


def benchmark(
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures to this file.")] = None,
) -> None:
    """Measure speed on one core: filter calls, scalar and vector steps, bare and filtered, and the fused limit."""
    figures = measure()
    Console().print(_table(figures))
    if json_file is not None:
        write_atomically(json_file, lambda path: path.write_text(json.dumps(figures, indent=2) + "\n"))


def measure() -> Figures:
    """Return every figure, in microseconds for each call, state or env, or as a ratio."""
    figures = {**_filter_calls(), **_scalar_steps(), **_vector_steps(), **_fused_loop()}
    figures["filtered / bare env.step"] = figures["env.step filtered, us"] / figures["env.step bare, us"]
    figures["vector filtered / fused, speed"] = figures["fused loop, us per env"] / figures["vector step filtered, us per env"]
    return figures


def _best(call: Callable[[], Any], prepare: Callable[[], Any] = lambda: None) -> float:
    """Seconds for one call, from the quickest of a few rounds: the others were disturbed by something else."""
    prepare()
    once = max(timeit.timeit(call, number=3) / 3, 1e-7)
    number = max(1, int(_SECONDS_PER_ROUND / once))
    rounds = []
    for _ in range(_ROUNDS):
        prepare()
        rounds.append(timeit.timeit(call, number=number) / number)
    return min(rounds)


def _filter_calls() -> Figures:
    safety_filter = SafetyFilterWrapper(gym.make(_ID), "scbf").safety_filter
    rng = np.random.default_rng(0)
    figures = {}
    for batch in _BATCHES:
        x = rng.uniform(-2.0, 2.0, (batch, 3))
        u = rng.uniform(-10.0, 10.0, (batch, 1))
        if batch == 1:
            x, u = x[0], u[0]
        figures[f"filter call, {batch} state{'s' if batch > 1 else ''}, us per state"] = (
            1e6 * _best(lambda x=x, u=u: safety_filter.filter(x, u)) / batch
        )
    return figures


def _scalar_steps() -> Figures:
    # The vehicle turns on the spot, so that the filter has work and no episode ends within a round.
    bare = gym.make(_ID, horizon=1e9, start=[0.0, 0.0, 0.0], noise=0.01)
    action = np.array([0.9], dtype=np.float32)
    figures = {}
    for name, env in (("bare", bare), ("filtered", SafetyFilterWrapper(bare, "scbf"))):
        seconds = _best(lambda env=env: env.step(action), lambda env=env: env.reset(seed=0))
        figures[f"env.step {name}, us"] = 1e6 * seconds
    return figures


def _vector_steps() -> Figures:
    figures = {}
    action = np.full((_NUM_ENVS, 1), 0.3, dtype=np.float32)
    for name in ("bare", "filtered"):
        env = gym.make_vec(_ID, num_envs=_NUM_ENVS)
        if name == "filtered":
            env = SafetyFilterVectorWrapper(env, "scbf")
        seconds = _best(lambda env=env: env.step(action), lambda env=env: env.reset(seed=0))
        figures[f"vector step {name}, us per env"] = 1e6 * seconds / _NUM_ENVS
        figures[f"vector step {name}, steps per second"] = _NUM_ENVS / seconds
    return figures


def _fused_loop() -> Figures:
    """The Dubins SCBF written by hand for one env: no reward, no info, no reset, no checks."""
    problem = gym.make(_ID).unwrapped.problem  # pyright: ignore[reportAttributeAccessIssue]
    v, s = (problem.plant.numeric(p) for p in problem.plant.parameters if p.name in ("v", "sigma_1"))
    v, s = float(v), float(s)
    dt, (low, high) = problem.dt, problem.box[0]
    root = s * dt**0.5
    rng = np.random.default_rng(0)
    x, y, theta = rng.uniform(-1.0, 1.0, (3, _NUM_ENVS))
    nominal = np.full(_NUM_ENVS, 3.0)

    def step() -> None:
        nonlocal x, y, theta
        cos, sin = np.cos(theta), np.sin(theta)
        # A A h = -2 v^2 + 2 v (x sin - y cos) u for the disk, with equal noise in x and y.
        a = 2 * v * (x * sin - y * cos)
        b = -2 * v * v
        u = np.clip(np.where(a * nominal + b >= 0, nominal, -b / a), low, high)
        w = rng.standard_normal((2, _NUM_ENVS))
        x = x + v * cos * dt + root * w[0]
        y = y + v * sin * dt + root * w[1]
        theta = theta + u * dt

    return {"fused loop, us per env": 1e6 * _best(step) / _NUM_ENVS}


def _table(figures: Figures) -> Table:
    table = Table(title=f"{_ID}, scbf, {_NUM_ENVS} envs; safe_envs {safe_envs.__version__}, {os.cpu_count()} cores, one used")
    table.add_column("what")
    table.add_column("figure", justify="right")
    for name, value in figures.items():
        table.add_row(name, f"{value:,.0f}" if "per second" in name else f"{value:.3g}")
    return table
