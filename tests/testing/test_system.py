"""The check of a system passes what is sound, and names what is broken."""

from __future__ import annotations

import itertools
from dataclasses import fields, replace

import pytest
import sympy as sp

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem, define_problem
from safe_envs.problem.signals import Feature
from safe_envs.problem.starts import Start
from safe_envs.testing.system import check_system
from tests.conftest import problem_of

x, u, s = sp.symbols("x u s", real=True)
SLOW = ControlAffineSDE((x,), (u,), [-x], [1], [s], {s: 0.1})


def stated(barrier=1 - x, system=SLOW, **changes) -> SafetyProblem:
    numbers = {
        "input_bounds": (-1, 1),
        "start": [(-0.5, 0.5)],
        "dt": 0.1,
        "horizon": 10.0,
        **changes,
    }
    return define_problem(system, barrier, **numbers)


def test_every_registered_system_passes(env_id):
    check_system(problem_of(env_id))


@pytest.mark.parametrize("system", [stated, stated(), f"{__name__}:stated", "Scalar-v0"])
def test_a_problem_a_function_and_a_place_pass(system):
    check_system(system)


class Other(SafetyProblem):
    """Comes back from a pickle as something else."""

    def __reduce__(self):
        return stated, ()


def other() -> SafetyProblem:
    given = stated()
    return Other(**{f.name: getattr(given, f.name) for f in fields(given) if f.init})


def often_unsafe() -> SafetyProblem:
    given = stated()
    uniform = sp.Symbol("uniform", real=True)
    return replace(given, starts={"wide": Start((4 * uniform,), (uniform,))}, start="wide")


def chaotic() -> SafetyProblem:
    """x goes to .97 sin(pi x), which doubles an error of rounding at each step."""
    moved = (sp.Rational(97, 100) * sp.sin(sp.pi * x) - x) * 10
    system = ControlAffineSDE((x,), (u,), [moved], [1], [s], {s: 1e-9})
    return stated(2 - x, system, start=[(0.2, 0.8)], input_bounds=(-1e-9, 1e-9))


CALLS = itertools.count()
BROKEN = {
    "definition: .* gives 3": lambda: 3,
    "definition: input u never": lambda: replace(stated(), plant=replace(SLOW, input_matrix=[0])),
    "definition: every start is unsafe": lambda: replace(stated(), barriers=(Barrier(x - 2),)),
    "reproducible: ": lambda: stated(1 + next(CALLS) - x),
    "round trip: noise names": lambda: replace(stated(), noise=("sigma",)),
    "round trip: unpickled": other,
    "reset: the start": often_unsafe,
    "bounds: the observation": lambda: stated(features=(Feature("x", x, -0.1, 0.1),)),
    "batch: .* rounding": chaotic,
    "derivatives: that of .* too fast": lambda: stated(1 - x + 1e-8 * sp.sin(1e9 * x)),
}


@pytest.mark.parametrize("message", BROKEN)
def test_what_is_broken_is_named(message):
    with pytest.raises(AssertionError, match=f"^{message}"):
        check_system(BROKEN[message], steps=100)
