"""After a filter is made or unpickled, no decision imports a module or compiles a formula."""

from __future__ import annotations

import pickle
import subprocess
import sys

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE
from safe_envs.wrappers import DelayedFilter, SafetyFilter

pytestmark = pytest.mark.slow

# In a process of its own, since other tests import whatever there is.
_SCRIPT = """
import sys
import numpy as np
import sympy as sp
from safe_envs import ControlAffineSDE, NumericalError, SafetyFilter
from safe_envs.dynamics import codegen
from safe_envs.wrappers import DelayedFilter, SRCBF

def filters_of(m):
    x, u = sp.symbols(f"x:{m}", real=True), sp.symbols(f"u:{m}", real=True)
    system = ControlAffineSDE(x, u, [0] * m, np.eye(m, dtype=int).tolist(), [0] * m)
    h = [1 - x[0], x[0] + x[-1] + 2 - sp.log(4 - x[-1]), 3 - sum(s**2 for s in x)]
    filters = [
        SafetyFilter(system, h, "cbf", (-1, 1)),
        SafetyFilter(system, h[2], "cbf:sampling_margin=first-order", (-1, 1), dt=0.1),
    ]
    return filters + [DelayedFilter(made, 2, 0.01) for made in filters]

x, u, p = sp.symbols("x u p", real=True)
# A shared logarithm has no value where the other piece applies.
pieces = sp.Piecewise((x * sp.log(x) + x**2 * sp.log(x) ** 2, x > 0), (x, True))
bent = ControlAffineSDE((x,), (u,), [pieces], [[1]], [[x]], signals={p: 1})
bent = SafetyFilter(bent, [p - x, x + p], [SRCBF(), "scbf"], (-2, 2))
each = {m: filters_of(m) for m in (1, 2, 4)}
known = set(sys.modules)


def refuse(*given, **named):
    raise AssertionError("compiled after construction")


codegen._compile = codegen.sp.lambdify = refuse
rng = np.random.default_rng(0)
for m, filters in each.items():
    kinds = set()
    for made in filters:
        states, inputs = 1.5 * rng.normal(size=(60, m)), 3 * rng.normal(size=(60, m))
        states[:, -1] = np.minimum(states[:, -1], 3.0)
        found = made.filter(states, inputs, input_bounds=(-1, 0.5))
        restart = getattr(made, "reset", int)
        restart()
        for state, proposal in zip(states, inputs, strict=True):
            one = made.filter(state, proposal)
            kinds.add((bool(one.feasible), bool(one.active.any())))
        for bad in (states + 9, states[0] + 9):
            restart()
            if np.isneginf(made.filter(bad, np.zeros_like(bad)).barrier).any():
                kinds.add("undefined")
    assert kinds == {(True, False), (True, True), (False, True), "undefined"}, kinds

states = np.linspace(-3, 3, 13)[:, None]
batch = bent.filter(states, np.zeros((13, 1)), parameters={"p": 1.0})
for i, state in enumerate(states):
    found = bent.filter(state, [0.0], parameters={"p": 1.0})
    assert np.allclose(found.action, batch.action[i])
try:
    bent.filter([1e200], [0.0], parameters={"p": 1.0})
except NumericalError:
    pass
else:
    raise AssertionError("no error")
late = sorted(set(sys.modules) - known)
assert not late, late
"""

_READER = """
import pickle, sys
import sympy

filters, states, inputs = pickle.load(sys.stdin.buffer)
known, sympy.lambdify = set(sys.modules), None
for made in filters:
    found = [made.filter(x, u) for x, u in zip(states, inputs)]
    getattr(made, "reset", int)()
    made.filter(states, inputs)
    assert not all(one.feasible for one in found)
late = sorted(set(sys.modules) - known)
assert not late, late
"""


def pickled() -> bytes:
    x = sp.symbols("x:4", real=True)
    system = ControlAffineSDE(x, sp.symbols("u:4", real=True), [0] * 4, np.eye(4), [0] * 4)
    made = SafetyFilter(system, [1 - x[0], x[0] + x[3] + 2, 3 - x[1] ** 2], "cbf", (-1, 1))
    filters, rng = [made, DelayedFilter(made, 2, 0.01)], np.random.default_rng(0)
    return pickle.dumps((filters, 2 * rng.normal(size=(30, 4)), 3 * rng.normal(size=(30, 4))))


@pytest.mark.parametrize(
    ("script", "given"), [(_SCRIPT, bytes), (_READER, pickled)], ids=["made", "unpickled"]
)
def test_nothing_is_imported_or_compiled(script, given):
    done = subprocess.run([sys.executable, "-c", script], input=given(), capture_output=True)
    assert not done.returncode, done.stderr.decode()


def test_warm_up_returns_the_filter_itself():
    x, u = sp.symbols("x u", real=True)
    made = SafetyFilter(ControlAffineSDE((x,), (u,), [0], [[1]], [[0]]), 1 - x, "cbf", (-1, 1))
    assert made.warm_up() is made
