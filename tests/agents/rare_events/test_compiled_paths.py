"""Paths by a compiled program, as plain Python, against those by NumPy."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, NumericalError, state_problem
from safe_envs.agents import NominalController, ZeroController, make_problem
from safe_envs.agents.policies.nominal import RandomPolicy
from safe_envs.agents.rare_events import splitting
from safe_envs.agents.rare_events.compiled_paths import CompiledPaths, PathProgram
from safe_envs.agents.rare_events.estimate import estimate_rare
from safe_envs.agents.rare_events.numpy_paths import NumpyPaths, TiltedNoiseEnv
from safe_envs.agents.rare_events.splitting import Particles, PathKeys
from safe_envs.dynamics.noise import SPLIT
from safe_envs.engine.program import Program
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers import SafetyFilter, SafetyFilterVectorWrapper, parse_conditions
from tests.oracles.laws import X, brownian

PATHS = 24


def players_of(problem, policy, spec=None, continuous=False):
    """Return who simulates by NumPy, and who by kernels as plain Python."""
    conditions = parse_conditions(spec, problem) if spec else ()

    def make(lengths):
        env = TiltedNoiseEnv(problem, lengths)
        return SafetyFilterVectorWrapper(env, conditions) if spec else env

    numpy = NumpyPaths(problem, make, policy, PATHS, continuous)
    qp = SafetyFilter.for_problem(problem, conditions).qp if spec else None
    program = PathProgram(problem, policy, qp, continuous)
    return numpy, CompiledPaths(program, program.program.plain(), numpy, threads=2)


def played(player, length=0.0):
    """Play paths, and go on from where some of them fell below levels."""
    paths = Particles(player, PathKeys(3, SPLIT), np.repeat([0.0, 0.5], PATHS // 2), length)
    order = np.argsort(paths.lowest[: PATHS // 2])
    killed, parents = order[3:], np.resize(order[:3], len(order) - 3)
    first = paths.lowest.copy()
    paths.branch(killed, parents, 0.5 * (first[killed] + paths.lowest[parents]))
    return paths, first


def assert_same(numpy, compiled, length=0.0):
    """Return the paths by NumPy, which are those of the program."""
    (wanted, first), (found, first_found) = played(numpy, length), played(compiled, length)
    assert first_found == pytest.approx(first, rel=1e-12, abs=1e-12)
    assert found.steps == wanted.steps
    assert (found.kept_length, found.outside) == (wanted.kept_length, wanted.outside)
    one, other = wanted._records, found._records
    assert other.count.tolist() == one.count.tolist()
    for row, count in enumerate(one.count):
        assert other.instants[row, :count].tolist() == one.instants[row, :count].tolist()
        assert other.ended[row, :count].tolist() == one.ended[row, :count].tolist()
        for name in ("heights", "states", "integrals"):
            given = getattr(one, name)[row, :count]
            assert getattr(other, name)[row, :count] == pytest.approx(given, rel=1e-9, abs=1e-9)
    return wanted


def two_channels():
    x, y, u, v = sp.symbols("x y u v", real=True)
    system = ControlAffineSDE(
        states=(x, y),
        inputs=(u, v),
        drift=[0, 0],
        input_matrix=[[1, 0], [0, 1]],
        diffusion=[[0.3, 0.2 * sp.cos(x)], [0.0, 0.4]],
    )
    problem = state_problem(
        system, [1 - x, 3 - y - x], box=(-1.0, 1.0), start=[0.0, 0.0], dt=0.1, horizon=1.0
    )
    return replace(problem, substeps=2)


@pytest.mark.parametrize(
    ("problem", "policy", "spec", "continuous", "length"),
    [
        (brownian(0.05, 1.0, 0.0, 0.3), NominalController, None, False, 0.0),
        (brownian(0.05, 1.0, 0.0, 0.3, [1 - X, 2 * (1 + X)]), ZeroController, None, True, 0.0),
        (two_channels(), RandomPolicy, None, True, 1.5),
        (make_problem("Scalar-v0", horizon=0.6, dt=0.05), RandomPolicy, "szcbf", True, 0.0),
        (make_problem("StochasticDubins-v0", horizon=1.0), NominalController, "scbf", False, 3.0),
    ],
    ids=["walk", "two walls", "two channels", "scalar", "dubins"],
)
def test_paths_are_those_of_numpy(problem, policy, spec, continuous, length):
    players = players_of(problem, policy(problem), spec, continuous)
    wanted = assert_same(*players, length)
    assert wanted.steps > PATHS
    assert wanted._records.count.max() > 2


def test_paths_go_on_where_there_was_no_room_for_a_record(monkeypatch):
    problem = brownian(0.05, 1.0, 1.0, 0.1)
    players = players_of(problem, NominalController(problem))
    monkeypatch.setattr(splitting, "FIRST_ROOM", 2)
    wanted = assert_same(*players)
    assert wanted._records.room > 4


def test_threads_change_nothing(monkeypatch):
    problem = brownian(0.05, 1.0, 0.0, 0.3)
    _, compiled = players_of(problem, NominalController(problem))
    alone, _ = played(compiled)
    monkeypatch.setattr("safe_envs.agents.rare_events.compiled_paths._FEWEST_PATHS", 2)
    together, _ = played(compiled)
    assert together.lowest.tolist() == alone.lowest.tolist()


def test_what_has_no_end_has_the_error_of_numpy():
    u = sp.Symbol("u", real=True)
    system = ControlAffineSDE(
        states=(X,), inputs=(u,), drift=[X**3], input_matrix=[1], diffusion=[0.01]
    )
    problem = state_problem(
        system, 1 + X**2, box=(-1.0, 1.0), start=[3.0], dt=0.1, horizon=2.0, nominal=1.0
    )
    for player in players_of(problem, NominalController(problem)):
        with pytest.raises(NumericalError, match="left the finite numbers"):
            played(player)


def test_what_numba_cannot_compile_is_told(monkeypatch):
    def fail(*arguments):
        raise TypeError("no such operation")

    entries = ("draw_path_starts", "play_paths")
    monkeypatch.setattr(Program, "compiled", lambda self: dict.fromkeys(entries, fail))
    with pytest.raises(NotCompilableError, match=r"Numba cannot compile .*: no such operation"):
        estimate_rare(brownian(0.1, 0.5, 0.0, 0.3), filters=["none"], engine="compiled")


def test_policies_that_only_numpy_can_call_are_told():
    arguments: dict[str, Any] = {"filters": ["none"], "particles": 20, "repetitions": 10}
    problem = brownian(0.1, 0.5, 0.0, 0.3)

    def custom(observations):
        return np.zeros((len(observations), 1))

    with pytest.raises(NotCompilableError, match="NumPy"):
        estimate_rare(problem, custom, engine="compiled", **arguments)
    timing = estimate_rare(problem, custom, engine="auto", **arguments).timing
    assert timing["rows"][0]["engine"] == "numpy"


@pytest.mark.oracle
@pytest.mark.parametrize(
    "env_id", ["Scalar-v0", "StochasticDubins-v0", "CubicSDEDisk-v0", "Pendulum-v0"]
)
def test_estimates_of_both_engines_are_equal_but_for_rounding(env_id):
    numpy, compiled = (
        estimate_rare(
            env_id, particles=100, repetitions=10, monitoring="continuous", engine=engine
        ).rows
        for engine in ("numpy", "compiled")
    )
    assert sum(row.steps for row in numpy) > 100_000
    for wanted, found in zip(numpy, compiled, strict=True):
        assert (found.status, found.reason, found.method) == (
            wanted.status,
            wanted.reason,
            wanted.method,
        )
        assert (found.levels, found.steps, found.plain) == (
            wanted.levels,
            wanted.steps,
            wanted.plain,
        )
        assert found.estimates == pytest.approx(wanted.estimates, rel=1e-9)


def test_an_interrupt_waits_for_parts_under_way_alone(monkeypatch):
    """Those that nobody has begun are left."""
    begun, player = [], SimpleNamespace(most_paths=1)
    reader, writer = threading.Event(), threading.Event()

    def play(functions, part, *arguments):
        begun.append(part)
        if len(begun) == 2:
            reader.set()
        writer.wait(5.0)

    def interrupted(future):
        assert reader.wait(5.0)
        threading.Timer(0.05, writer.set).start()
        raise KeyboardInterrupt

    player.play = play
    monkeypatch.setattr(Future, "result", interrupted)
    paths: Any = CompiledPaths.__new__(CompiledPaths)
    paths._program, paths._functions, paths._threads = player, {}, 2
    with pytest.raises(KeyboardInterrupt):
        paths._play(np.arange(50))
    assert len(begun) == 2
