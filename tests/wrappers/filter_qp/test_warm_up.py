"""After a filter is made, no decision imports a module or compiles a formula."""

from __future__ import annotations

import pickle
import subprocess
import sys

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, NumericalError
from safe_envs.dynamics import codegen
from safe_envs.filters import solver
from safe_envs.wrappers import SRCBF, DelayedFilter, SafetyFilter

_SCRIPT = """
import sys
import numpy as np
import sympy as sp
from safe_envs import ControlAffineSDE, SafetyFilter
from safe_envs.dynamics import codegen
from safe_envs.wrappers import DelayedFilter

m = {m}
x, u = sp.symbols(f"x:{{m}}", real=True), sp.symbols(f"u:{{m}}", real=True)
system = ControlAffineSDE(x, u, [0] * m, np.eye(m, dtype=int).tolist(), [0] * m)
h = [1 - x[0], x[0] + x[-1] + 2 - sp.log(4 - x[-1]), 3 - sum(s**2 for s in x)]
filters = [
    SafetyFilter(system, h, "cbf", (-1, 1)),
    SafetyFilter(system, h[2], "cbf:sampling_margin=first-order", (-1, 1), dt=0.1),
]
filters += [DelayedFilter(made, 2, 0.01) for made in filters]
known = set(sys.modules)


def refuse(*given, **named):
    raise AssertionError("compiled after construction")


codegen._compile = codegen.sp.lambdify = refuse
rng = np.random.default_rng(0)
kinds = set()
for made in filters:
    states, inputs = 1.5 * rng.normal(size=(60, m)), 3 * rng.normal(size=(60, m))
    states[:, -1] = np.minimum(states[:, -1], 3.0)
    found = made.filter(states, inputs, bounds=(-1, 0.5))
    restart = getattr(made, "reset", int)
    restart()
    for state, proposal in zip(states, inputs, strict=True):
        one = made.filter(state, proposal)
        kinds.add((bool(one.feasible), bool(one.active.any())))
    for bad in (states + 9, states[0] + 9):
        restart()
        if np.isneginf(made.filter(bad, np.zeros_like(bad)).barrier).any():
            kinds.add("undefined")
assert kinds == {{(True, False), (True, True), (False, True), "undefined"}}, kinds
late = sorted(set(sys.modules) - known)
assert not late, late
"""


@pytest.mark.parametrize("inputs", [1, 2, 4])
def test_nothing_is_imported_or_compiled_after_construction(inputs: int) -> None:
    # In a process of its own, since other tests import whatever there is.
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT.format(m=inputs)], capture_output=True, text=True
    )
    assert not done.returncode, done.stderr


_READER = """
import pickle, sys
import sympy

made, states, inputs = pickle.load(sys.stdin.buffer)
known, sympy.lambdify = set(sys.modules), None
found = [made.filter(x, u) for x, u in zip(states, inputs)]
getattr(made, "reset", int)()
made.filter(states, inputs)
assert not all(one.feasible for one in found)
late = sorted(set(sys.modules) - known)
assert not late, late
"""


@pytest.mark.parametrize("late", [False, True], ids=["prompt", "late"])
def test_nor_after_it_is_unpickled(late: bool) -> None:
    x = sp.symbols("x:4", real=True)
    system = ControlAffineSDE(x, sp.symbols("u:4", real=True), [0] * 4, np.eye(4), [0] * 4)
    made = SafetyFilter(system, [1 - x[0], x[0] + x[3] + 2, 3 - x[1] ** 2], "cbf", (-1, 1))
    rng = np.random.default_rng(0)
    made = DelayedFilter(made, 2, 0.01) if late else made
    given = pickle.dumps((made, 2 * rng.normal(size=(30, 4)), 3 * rng.normal(size=(30, 4))))
    done = subprocess.run([sys.executable, "-c", _READER], input=given, capture_output=True)
    assert not done.returncode, done.stderr.decode()


def test_formulas_by_pieces_goals_and_reciprocal_conditions_are_compiled_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    x, u, p = sp.symbols("x u p", real=True)
    # A shared logarithm has no value where the other piece applies.
    pieces = sp.Piecewise((x * sp.log(x) + x**2 * sp.log(x) ** 2, x > 0), (x, True))
    system = ControlAffineSDE((x,), (u,), [pieces], [[1]], [[x]], signals={p: 1})
    made = SafetyFilter(system, [p - x, x + p], [SRCBF(), "scbf"], (-2, 2))

    def refuse(*given: object, **named: object) -> None:
        raise AssertionError("compiled after construction")

    monkeypatch.setattr(codegen.sp, "lambdify", refuse)
    monkeypatch.setattr(solver, "compile_function", refuse)
    states = np.linspace(-3, 3, 13)[:, None]
    batch = made.filter(states, np.zeros((13, 1)), parameters={"p": 1.0})
    for i, state in enumerate(states):
        found = made.filter(state, [0.0], parameters={"p": 1.0})
        np.testing.assert_allclose(found.action, batch.action[i])
    with pytest.raises(NumericalError):
        made.filter([1e200], [0.0], parameters={"p": 1.0})


def test_warm_up_gives_the_filter_itself() -> None:
    x, u = sp.symbols("x u", real=True)
    made = SafetyFilter(ControlAffineSDE((x,), (u,), [0], [[1]], [[0]]), 1 - x, "cbf", (-1, 1))
    assert made.warm_up() is made
