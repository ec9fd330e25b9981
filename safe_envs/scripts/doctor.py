"""`safe-envs doctor`: whether the installation is complete, its solvers right and its envs in
order, and how fast they are here."""

from __future__ import annotations

import platform
import re
import sys
import timeit
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.text import Text

from safe_envs import ENV_IDS, __version__
from safe_envs.rendering.viewer import require_pygame
from safe_envs.scripts.options.console import (
    progress_bar,
    require_result,
    say,
    stdout,
    write_result,
)
from safe_envs.scripts.reports.tables import make_table

_NEEDED = ""
"""In place of an extra: what is needed in any case."""

_TOLERANCE = 1e-6
_STEPS = 20
_SPEED_ID = "safe_envs/StochasticDubins-v0"
_SPEED_FILTER = "scbf"
_NUM_ENVS = 1024


@dataclass(frozen=True)
class Check:
    """What was looked at.

    Attributes:
        name: of it.
        ok: whether all is well; None for what may be missing.
        found: what was seen.
        advice: what to do, if anything.
    """

    name: str
    ok: bool | None
    found: str
    advice: str = ""


@dataclass(frozen=True)
class Program:
    """A quadratic program whose answer is known: the nearest input to the proposed one, in a box,
    with a u + b >= 0.

    Attributes:
        name: which solver it is for.
        a: k rows of m coefficients.
        b: k offsets.
        proposed: m inputs.
        box: half width of the box around 0.
        answer: m inputs.
        feasible: whether the rows can be met.
    """

    name: str
    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    proposed: tuple[float, ...]
    box: float
    answer: tuple[float, ...]
    feasible: bool = True


PROGRAMS = (
    Program("one row, in closed form", ((-1.0, -1.0),), (1.0,), (1.0, 1.0), 5.0, (0.5, 0.5)),
    Program(
        "one row that cannot be met",
        ((1.0, 0.0),),
        (-7.0,),
        (0.0, 1.0),
        5.0,
        (5.0, 1.0),
        feasible=False,
    ),
    Program("several rows, one input", ((-1.0,), (1.0,)), (1.0, 3.0), (2.0,), 5.0, (1.0,)),
    Program(
        "several rows, two inputs",
        ((-1.0, 0.0), (0.0, -1.0)),
        (1.0, 0.5),
        (2.0, 2.0),
        5.0,
        (1.0, 0.5),
    ),
    Program(
        "contradicting rows, two inputs",
        ((1.0, 0.0), (-1.0, 0.0)),
        (-2.0, 1.0),
        (0.0, 0.3),
        5.0,
        (1.5, 0.3),
        feasible=False,
    ),
    Program(
        "ProxQP",
        ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
        (1.0, 0.5),
        (2.0, 2.0, 2.0),
        5.0,
        (1.0, 0.5, 2.0),
    ),
    Program(
        "ProxQP, contradicting rows",
        ((1.0, 1.0, 1.0), (1.0, 0.0, 0.0)),
        (-10.0, 1.0),
        (0.0, 0.0, 0.0),
        3.0,
        (3.0, 3.0, 3.0),
        feasible=False,
    ),
)


def doctor(json_file: Path | None = None) -> None:
    """Look at the installation, print what was found, and end with the status 1 if something is
    wrong.

    Args:
        json_file: where the same goes as JSON, if it is to.

    Raises:
        ConfigurationError: the file cannot be written.
    """
    require_result(json_file)
    parts = {"packages": packages, "solvers": solvers, "envs": envs}
    found: dict[str, list[Check]] = {}
    with progress_bar("Looking") as tell:
        for k, (title, look) in enumerate(parts.items()):
            found[title] = list(look())
            if tell is not None:
                tell((k + 1) / (len(parts) + 1))
        healthy = all(check.ok is not False for checks in found.values() for check in checks)
        speed = speeds() if healthy else {}
    _report(found, speed, healthy)
    document = {
        "healthy": healthy,
        "safe-envs": __version__,
        "checks": {title: [asdict(check) for check in checks] for title, checks in found.items()},
        "steps_per_second": speed,
    }
    write_result(json_file, lambda: document)
    if not healthy:
        sys.exit(1)


def packages() -> Iterator[Check]:
    """Python, what is required, and the optional packages with their extras."""
    yield Check(
        "python",
        sys.version_info >= (3, 11),
        platform.python_version(),
        "Python 3.11 or newer is needed",
    )
    for package, extra in required():
        if package == "pygame-ce" and (wrong := _other_pygame()):
            yield wrong
            continue
        try:
            yield Check(package, True, version(package))
        except PackageNotFoundError:
            target = package if extra == _NEEDED else f"safe-envs[{extra}]"
            yield Check(
                package, False if extra == _NEEDED else None, "missing", f'pip install "{target}"'
            )


def _other_pygame() -> Check | None:
    """What is wrong if pygame, or a pygame-ce that is too old, is imported in place of the
    pygame-ce that draws; else None."""
    if find_spec("pygame") is None:
        return None
    try:
        require_pygame()
    except gym.error.DependencyNotInstalled as error:
        found, _, advice = str(error).partition(": ")
        return Check("pygame-ce", False, found, advice)
    return None


def required() -> list[tuple[str, str]]:
    """Packages of the metadata, each with the extra that it belongs to; those of `dev` are not for
    users."""
    found: dict[str, str] = {}
    for line in requires("safe-envs") or ():
        package = re.match(r"[\w.-]+", line)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        name = extra.group(1) if extra else _NEEDED
        if package and name != "dev":
            found.setdefault(package.group(), name)
    return list(found.items())


def solvers() -> Iterator[Check]:
    """The solvers on programs whose answers are known."""
    for program in PROGRAMS:
        yield _looked(
            program.name,
            lambda program=program: _solve(program),
            "reinstall proxsuite, numpy and scipy",
        )


def _solve(program: Program) -> tuple[bool, str]:
    from safe_envs.wrappers.qp.dispatch import project_floats

    m, k = len(program.proposed), len(program.b)
    low, high, ones = [-program.box] * m, [program.box] * m, [1.0] * m
    action, _, _, feasible = project_floats(
        program.a, program.b, list(program.proposed), low, high, ones, [1.0] * k
    )
    error = float(np.abs(np.subtract(action, program.answer)).max())
    right = error <= _TOLERANCE and feasible == program.feasible
    return (
        right,
        (
            f"off by {error:.1g}"
            if feasible == program.feasible
            else f"said to be {'' if feasible else 'in'}feasible, and is not"
        ),
    )


def envs() -> Iterator[Check]:
    """Every id, made and stepped with its natural filter."""
    for env_id in ENV_IDS:
        yield _looked(
            env_id,
            lambda env_id=env_id: _step(env_id),
            "reinstall safe-envs; if that does not help, it is a fault of its own",
        )


def _step(env_id: str) -> tuple[bool, str]:
    from safe_envs.envs.env import SafeEnv
    from safe_envs.registry import make_problem
    from safe_envs.wrappers import SafetyFilterWrapper

    bare = SafeEnv(make_problem(env_id))
    env = SafetyFilterWrapper(bare, bare.problem.filter)
    env.reset(seed=0)
    inside = True
    for _ in range(_STEPS):
        _, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape or ()))
        low, high = np.transpose(bare.problem.box)
        action = np.asarray(info["safe_action"])
        inside &= bool(
            np.isfinite(reward) and (action >= low - 1e-9).all() and (action <= high + 1e-9).all()
        )
        if terminated or truncated:
            env.reset()
    return (
        inside,
        (
            f"{_STEPS} steps with {bare.problem.filter}"
            if inside
            else "an action outside of the box, or a reward that is not finite"
        ),
    )


def _looked(name: str, look: Callable[[], tuple[bool, str]], advice: str) -> Check:
    """The check of something that may break in any way."""
    try:
        ok, found = look()
    except Exception as error:
        ok, found = False, f"{type(error).__name__}: {error}"
    return Check(name, ok, found, "" if ok else advice)


def speeds() -> dict[str, float]:
    """Steps of single envs per second on this machine, by what is stepped."""
    from safe_envs.wrappers import SafetyFilterVectorWrapper, SafetyFilterWrapper

    def scalar() -> gym.Env[Any, Any]:
        return gym.make(
            _SPEED_ID, disable_env_checker=True, horizon=1e9, start=[0.0, 0.0, 0.0], noise=0.01
        )

    def vector() -> Any:
        return gym.make_vec(_SPEED_ID, num_envs=_NUM_ENVS)

    cases = {
        "env": (scalar(), 1, 1000),
        f"env with {_SPEED_FILTER}": (SafetyFilterWrapper(scalar(), _SPEED_FILTER), 1, 500),
        f"vector env of {_NUM_ENVS}": (vector(), _NUM_ENVS, 50),
        f"vector env of {_NUM_ENVS} with {_SPEED_FILTER}": (
            SafetyFilterVectorWrapper(vector(), _SPEED_FILTER),
            _NUM_ENVS,
            50,
        ),
    }
    found = {}
    for name, (env, size, steps) in cases.items():
        env.reset(seed=0)
        action = np.full(env.action_space.shape, 0.3, dtype=np.float32)
        found[name] = (
            size
            * steps
            / min(
                timeit.repeat(
                    lambda env=env, action=action: env.step(action), number=steps, repeat=3
                )
            )
        )
    return found


def _report(found: dict[str, list[Check]], speed: dict[str, float], healthy: bool) -> None:
    console = stdout()
    say(console, f"safe-envs {__version__} on {platform.platform()}\n")
    table = make_table("p", "", "", "found", "what to do", tight=False)
    for checks in found.values():
        for check in checks:
            mark = {True: "ok", False: "WRONG", None: "-"}[check.ok]
            table.add_row(
                mark, Text(check.name), Text(check.found), Text("" if check.ok else check.advice)
            )
        table.add_section()
    for name, steps in speed.items():
        table.add_row("", f"speed: {name}", f"{steps:,.0f} steps/s", "")
    console.print(table)
    say(console, f"\n{'All is well.' if healthy else 'Something is wrong: see above.'}")


if __name__ == "__main__":
    from safe_envs.scripts.cli import main

    main("doctor")
