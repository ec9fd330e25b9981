"""Problems, and what is found of them, that the tests of proofs share."""

from __future__ import annotations

import sympy as sp

from safe_envs.dynamics.sde import ControlAffineSDE
from safe_envs.problem.problem import Barrier, SafetyProblem
from safe_envs.problem.signals import Variable
from safe_envs.problem.starts import Start
from safe_envs.proofs import analysis, safe_set
from safe_envs.proofs.feasibility import verify
from safe_envs.proofs.posterior import guarantee_of
from safe_envs.wrappers import parse_conditions
from tests.conftest import problem_of

DUBINS = "safe_envs/DubinsDisk-v0"
STOCHASTIC = "safe_envs/StochasticDubins-v0"
CUBIC_DISK = "safe_envs/CubicSDEDisk-v0"

_FOUND = {}

x, y, u = sp.symbols("x y u", real=True)


def problem_with(
    drift,
    barriers,
    *,
    noise=(0.0,),
    states=(x,),
    inputs=((1.0,),),
    ranges=((-2.0, 2.0),),
    input_bounds=(-10.0, 10.0),
    start=0.5,
):
    """One input u: dX = (drift + inputs u) dt + noise dW."""
    system = ControlAffineSDE(states, (u,), drift, inputs, [[s] for s in noise], {})
    return SafetyProblem(
        name="made",
        plant=system,
        model=system,
        barriers=tuple(Barrier(sp.sympify(h), f"h_{i}") for i, h in enumerate(barriers, start=1)),
        states=tuple(Variable(s, *ends) for s, ends in zip(states, ranges, strict=True)),
        inputs=(Variable(u, *input_bounds),),
        reward=sp.Integer(0),
        nominal=(sp.Integer(0),),
        starts={"given": Start.at((start,) * len(states))},
        dt=0.01,
        horizon=1.0,
        filter="scbf",
    )


def hurry(monkeypatch):
    """Search less, where what is asked does not depend on how much is found."""
    monkeypatch.setattr(safe_set, "_POOL_LOG2", 10)
    monkeypatch.setattr(safe_set, "_ROUNDS", (20, 10))


def made(problem, text="scbf", **options):
    """What is found of a problem under a filter."""
    return verify(problem, parse_conditions(text, problem), **options)


def made_bound(problem, text="scbf", **options):
    """The estimated bound of a problem under a filter."""
    return guarantee_of(problem, parse_conditions(text, problem), **options)


def findings(env_id, text=None, knowledge="model", samples=analysis.SAMPLES, **options):
    """What is found of a registered id, once for all tests."""
    problem = problem_of(env_id, **options)
    return verify_once(
        problem, parse_conditions(text or problem.filter, problem), knowledge, samples
    )


def verify_once(problem, conditions, knowledge="model", samples=analysis.SAMPLES, seed=0):
    """`verify`, once for all tests that ask for the same."""
    parts = (problem.name, problem.plant, problem.model, problem.barriers, problem.states)
    numbers = (
        problem.input_bounds,
        repr(problem.starts[problem.start]),
        problem.dt,
        problem.horizon,
    )
    key = (parts, numbers, problem.start, tuple(conditions), knowledge, samples, seed)
    if key not in _FOUND:
        _FOUND[key] = verify(problem, conditions, knowledge, samples, seed)
    return _FOUND[key]


def estimated(env_id, text=None, **options):
    """The estimated bound of a registered id."""
    problem = problem_of(env_id, **options)
    return made_bound(problem, text or problem.filter)


def system_in_a_box(count=1, high=5.0, noise=0.6, half_width=1.0):
    """dx_i = u_i dt + s x_i dW_i with h_i = 1 - x_i^2: the bound h/c is attained."""
    x, u = sp.symbols(f"x_1:{count + 1}", real=True), sp.symbols(f"u_1:{count + 1}", real=True)
    s = sp.Symbol("s", real=True)
    system = ControlAffineSDE(
        x, u, [0] * count, sp.eye(count), sp.diag(*[s * xi for xi in x]), {s: noise}
    )
    return SafetyProblem(
        name="box",
        plant=system,
        model=system,
        barriers=tuple(Barrier(half_width**2 - xi**2, f"h_{i}") for i, xi in enumerate(x, start=1)),
        states=tuple(Variable(xi, -2.0, 2.0) for xi in x),
        inputs=tuple(Variable(ui, -high, high) for ui in u),
        reward=sp.Integer(0),
        nominal=(sp.Integer(0),) * count,
        starts={"middle": Start.at((0.3,) * count)},
        dt=0.01,
        horizon=1.0,
        noise=("s",),
        filter="scbf",
    )


def starts_of(problem, count):
    """Initial states of a problem, shape (count, n)."""
    return safe_set.draw_starts(problem, count)
