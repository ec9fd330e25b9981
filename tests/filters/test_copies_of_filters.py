"""Filters, policies and what was learned: the same decisions after pickling and copying."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch

from safe_envs.agents.policies.registry import make_policy
from safe_envs.filters import decisions
from safe_envs.filters.conditions.registry import LEARNED
from safe_envs.filters.learning.bayesian import identify
from safe_envs.filters.learning.generator import learn_generator
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.filters.torch_layer import TorchFilter
from tests.conftest import problem_of

COPIES = {"pickle": lambda given: pickle.loads(pickle.dumps(given)), "deepcopy": copy.deepcopy}
copied = pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)


def assert_decides_like(other, given, rows=20):
    """Check that two filters decide alike, for one state and for a batch."""
    n, m = given.model.n, given.model.m
    drawn = np.random.default_rng(0).uniform(0.1, 0.4, (rows, n + m))
    for x, u in ((drawn[:, :n], 5 * drawn[:, n:]), (drawn[0, :n], 5 * drawn[0, n:])):
        for mine, theirs in zip(other.filter(x, u), given.filter(x, u), strict=True):
            np.testing.assert_array_equal(mine, theirs)


@copied
@pytest.mark.parametrize("used", [False, True])
def test_the_filter_of_every_system(env_id, copied, used):
    problem = problem_of(env_id)
    given = SafetyFilter.for_problem(problem, problem.filter)
    if used:
        assert_decides_like(given, given)
    assert_decides_like(copied(given), given)


@pytest.mark.parametrize(
    ("name", "env", "learn"),
    [
        ("ddscbf", "ACCGap", lambda p: learn_generator(p, points=50, repetitions=50)),
        ("bayesian-scbf", "CubicSDEDisk", lambda p: identify(p, starts=100, repetitions=20)),
    ],
)
def test_learned_filters(name, env, learn):
    problem = problem_of(f"safe_envs/{env}-v0")
    model = learn(problem)
    for made in COPIES.values():
        condition = LEARNED[name].from_learned(made(model), problem.gains_of(0))
        given = SafetyFilter.for_problem(problem, [condition])
        assert_decides_like(made(given), given)


@copied
def test_differentiable_filters(copied):
    given = TorchFilter.for_problem(problem_of("safe_envs/StochasticDubins-v0"), "scbf")
    x, found = torch.tensor([2.5, 1.0, 0.3]).double(), []
    for layer in (given, copied(given)):
        u = torch.tensor([5.0]).double().requires_grad_()
        action = layer(x, u)
        action.sum().backward()
        found.append((action.tolist(), u.grad.tolist()))
    assert found[0] == found[1]


@copied
@pytest.mark.parametrize(
    ("name", "system"),
    [("nominal", "Quadrotor"), ("zero", "Scalar"), ("clf", "ACC"), ("random", "Pendulum")],
)
def test_policies(name, system, copied):
    problem = problem_of(f"safe_envs/{system}-v0")
    policy = make_policy(name, problem)
    policy.begin(range(1), 3)
    seen = np.array([0.1 * i for i, _ in enumerate(problem.features)])
    policy.predict(seen)
    other = copied(policy)
    for _ in range(3):
        np.testing.assert_array_equal(other.predict(seen)[0], policy.predict(seen)[0])


# After a filter is made or unpickled, no decision imports a module or compiles a formula.


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


@pytest.mark.slow
def test_nothing_is_imported_or_compiled():
    done = subprocess.run([sys.executable, "-c", _SCRIPT], capture_output=True)
    assert not done.returncode, done.stderr.decode()


def test_single_states_wait_for_no_machine_code(monkeypatch):
    def compiled(**_):
        raise AssertionError("compiled")

    for name, value in {"_FEW": 3, "_MANY": 6, "decider": compiled}.items():
        monkeypatch.setattr(decisions, name, value)
    problem = problem_of("safe_envs/Scalar-v0")
    given = SafetyFilter.for_problem(problem, problem.filter)
    for _ in range(9):
        given.filter([0.1], [1.0])
    with pytest.raises(AssertionError, match="compiled"):
        given.filter(np.full((9, 1), 0.1), np.ones((9, 1)))
