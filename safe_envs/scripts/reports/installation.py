"""Checks of an installation: its packages, solvers and envs, and how fast they are."""

from __future__ import annotations

import platform
import re
import sys
import timeit
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, requires, version  # noqa: TID251
from importlib.util import find_spec
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from safe_envs.errors import install_extra
from safe_envs.rendering.viewer import require_pygame
from safe_envs.systems import ENV_IDS
from safe_envs.wrappers.safety_filter import SafetyFilterVectorWrapper, SafetyFilterWrapper


@dataclass(frozen=True)
class KnownQP:
    """The input nearest to a proposed one, within bounds, that meets constraints a u + b >= 0.

    Attributes:
        name: of the kind of QP.
        a: k constraints of m coefficients.
        b: k offsets.
        proposed: m inputs.
        bound: of the size of each input.
        answer: m inputs.
        feasible: whether the constraints can be met.
    """

    name: str
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    proposed: tuple[float, ...]
    bound: float
    answer: tuple[float, ...]
    feasible: bool = True


KNOWN_QPS = (
    KnownQP("one constraint, in closed form", ((-1.0, -1.0),), (1.0,), (1.0, 1.0), 5.0, (0.5, 0.5)),
    KnownQP(
        "one constraint that cannot be met",
        ((1.0, 0.0),),
        (-7.0,),
        (0.0, 1.0),
        5.0,
        (5.0, 1.0),
        feasible=False,
    ),
    KnownQP("several constraints, one input", ((-1.0,), (1.0,)), (1.0, 3.0), (2.0,), 5.0, (1.0,)),
    KnownQP(
        "several constraints, two inputs",
        ((-1.0, 0.0), (0.0, -1.0)),
        (1.0, 0.5),
        (2.0, 2.0),
        5.0,
        (1.0, 0.5),
    ),
    KnownQP(
        "contradicting constraints, two inputs",
        ((1.0, 0.0), (-1.0, 0.0)),
        (-2.0, 1.0),
        (0.0, 0.3),
        5.0,
        (1.5, 0.3),
        feasible=False,
    ),
    KnownQP(
        "three inputs",
        ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
        (1.0, 0.5),
        (2.0, 2.0, 2.0),
        5.0,
        (1.0, 0.5, 2.0),
    ),
    KnownQP(
        "contradicting constraints, three inputs",
        ((1.0, 1.0, 1.0), (1.0, 0.0, 0.0)),
        (-10.0, 1.0),
        (0.0, 0.0, 0.0),
        3.0,
        (3.0, 3.0, 3.0),
        feasible=False,
    ),
)


_NEEDED = ""
"""In place of an extra: what is needed in any case."""

_OTHERS = {"daqp": "daqp", "proxqp": "proxsuite"}
"""Other solvers of QPs, with their packages."""

_TOLERANCE = 1e-5
_STEPS = 20


@dataclass(frozen=True)
class Check:
    """The result of a check.

    Attributes:
        name: of what was checked.
        ok: whether it is as it should be; None for what may be missing.
        found: what was found.
        advice: what to do, if anything.
    """

    name: str
    ok: bool | None
    found: str
    advice: str = ""


def packages() -> Iterator[Check]:
    """Check Python, the required packages, and the optional ones with their extras."""
    version_ok = sys.version_info >= (3, 11)
    yield Check("python", version_ok, platform.python_version(), "Python 3.11 or newer is needed")
    try:
        needed = required()
    except PackageNotFoundError:
        advice = "pip install --editable . in a checkout"
        yield Check("safe-envs", False, "on the path, but not installed", advice)
        return
    for package, extra in needed:
        if package == "pygame-ce" and (wrong := _other_pygame()):
            yield wrong
            continue
        try:
            yield Check(package, True, version(package))
        except PackageNotFoundError:
            if extra == _NEEDED:
                yield Check(package, False, "missing", f'pip install "{package}"')
            else:
                yield Check(package, None, "missing", install_extra(extra))


def _other_pygame() -> Check | None:
    """Return what is wrong if pygame or an old pygame-ce takes the place of pygame-ce; or None."""
    if find_spec("pygame") is None:
        return None
    try:
        require_pygame()
    except gym.error.DependencyNotInstalled as error:
        found, _, advice = str(error).partition(": ")
        return Check("pygame-ce", False, found, advice)
    return None


def required() -> list[tuple[str, str]]:
    """Return the packages of the metadata, each with its extra, without those of `dev`."""
    found: dict[str, str] = {}
    for line in requires("safe-envs") or ():
        package = re.match(r"[\w.-]+", line)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        name = extra.group(1) if extra else _NEEDED
        if package and name != "dev":
            found.setdefault(package.group(), name)
    return list(found.items())


def solvers() -> Iterator[Check]:
    """Check our QPs against known answers, and against the other solvers that are installed."""
    import qpsolvers

    others = [name for name in _OTHERS if name in qpsolvers.available_solvers]
    for qp in KNOWN_QPS:
        yield _check(qp.name, partial(_solve, qp, None), "reinstall safe-envs, numba and numpy")
        for name in others:
            advice = f"reinstall {_OTHERS[name]} and qpsolvers"
            yield _check(f"{qp.name}, by {name.upper()}", partial(_solve, qp, name), advice)


def _solve(qp: KnownQP, solver: str | None) -> tuple[bool, str]:
    import sympy as sp

    from safe_envs.dynamics.sde import ControlAffineSDE
    from safe_envs.filters.safety_filter import SafetyFilter

    x, u = (sp.symbols(f"{name}:{len(qp.proposed)}", real=True) for name in ("x", "u"))
    # h' = a u, and h = b at the state 0.
    system = ControlAffineSDE(x, u, [0] * len(x), sp.eye(len(x)))
    rows = [sp.Add(*[ai * xi for ai, xi in zip(a, x, strict=True)]) for a in qp.a]
    barriers = [row + b for row, b in zip(rows, qp.b, strict=True)]
    safety_filter = SafetyFilter(
        system, barriers, "cbf:alpha=1", (-qp.bound, qp.bound), solver=solver
    )
    found = safety_filter.filter([0.0] * len(x), list(qp.proposed))
    if bool(found.feasible) != qp.feasible:
        return False, f"said to be {'' if found.feasible else 'in'}feasible, and is not"
    error = float(np.abs(np.subtract(found.action, qp.answer)).max())
    return error <= _TOLERANCE, f"off by {error:.1g}"


def envs() -> Iterator[Check]:
    """Check every registered env with its default filter."""
    advice = "reinstall safe-envs; if that does not help, it is a fault of its own"
    for env_id in ENV_IDS:
        yield _check(env_id, partial(_step, env_id), advice)


def _step(env_id: str) -> tuple[bool, str]:
    from safe_envs.envs.env import SafeEnv
    from safe_envs.registry import make_problem
    from safe_envs.wrappers.safety_filter import SafetyFilterWrapper

    problem = make_problem(env_id)
    env = SafetyFilterWrapper(SafeEnv(problem), problem.filter)
    env.reset(seed=0)
    low, high = np.transpose(problem.input_bounds)
    inside = True
    for _ in range(_STEPS):
        _, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape or ()))
        action = np.asarray(info["safe_action"])
        inside &= bool(
            np.isfinite(reward) and (action >= low - 1e-9).all() and (action <= high + 1e-9).all()
        )
        if terminated or truncated:
            env.reset()
    if not inside:
        return False, "an action outside of the input bounds, or a reward that is not finite"
    return True, f"{_STEPS} steps with {problem.filter}"


def _check(name: str, look: Callable[[], tuple[bool, str]], advice: str) -> Check:
    """Return the check of something that may break in any way."""
    try:
        ok, found = look()
    except Exception as error:
        ok, found = False, f"{type(error).__name__}: {error}"
    return Check(name, ok, found, "" if ok else advice)


def speeds() -> dict[str, float]:
    """Return the steps per second of single envs on this machine, by what is stepped."""
    vector, filtered = f"vector env of {NUM_ENVS}", "with scbf"
    names = ("env", f"env {filtered}", vector, f"{vector} {filtered}")
    found = {}
    for name, case in zip(names, [*scalar_steps().values(), *vector_steps().values()], strict=True):
        case.prepare()
        steps = 500 if case.states == 1 else 50
        seconds = min(timeit.repeat(case.call, number=steps, repeat=3))
        found[name] = case.states * steps / seconds
    return found


ENV_ID = "safe_envs/StochasticDubins-v0"
NUM_ENVS = 1024


class Case(NamedTuple):
    """A call to time.

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


def scalar_steps() -> dict[str, Case]:
    """Return steps of a scalar env, unfiltered and filtered."""

    # No episode may end within a round: the vehicle turns on the spot, with little noise.
    def make() -> gym.Env[Any, Any]:
        return gym.make(ENV_ID, horizon=1e9, start=[0.0, 0.0, 0.0], noise=0.01)

    envs = {"unfiltered": make(), "filtered": SafetyFilterWrapper(make(), "scbf")}
    action = np.array([0.9], dtype=np.float32)
    return {
        f"env.step, {name}": Case(
            lambda env=env: env.step(action), prepare=lambda env=env: env.reset(seed=0)
        )
        for name, env in envs.items()
    }


def vector_steps(engine: str = "numpy") -> dict[str, Case]:
    """Return steps of a vector env, unfiltered and filtered."""
    unfiltered, other = (gym.make_vec(ENV_ID, num_envs=NUM_ENVS, engine=engine) for _ in range(2))
    envs = {"unfiltered": unfiltered, "filtered": SafetyFilterVectorWrapper(other, "scbf")}
    actions = np.full((NUM_ENVS, 1), 0.3, dtype=np.float32)
    cases = {}
    for name, env in envs.items():
        env.reset(seed=0)
        # Ten whole episodes, so that resets and draws of noise have their share of every round.
        calls = 10 * (env.unwrapped.problem.steps + 1)  # pyright: ignore[reportAttributeAccessIssue]
        cases[f"vector env, {name}"] = Case(
            lambda env=env: env.step(actions), NUM_ENVS, calls=calls
        )
    return cases
