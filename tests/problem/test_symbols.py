"""Symbols of a statement: what they are declared to be, and that their names do not matter."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from safe_envs import (
    ConfigurationError,
    ControlAffineSDE,
    SafeEnv,
    SafeVectorEnv,
    SystemDefinitionError,
    state_problem,
)
from safe_envs.problem.clf import CLF
from safe_envs.problem.signals import TIME, Feature
from safe_envs.wrappers import SafetyFilter

x, v, u, k, sigma = sp.symbols("x v u k sigma", real=True)


@pytest.mark.parametrize(
    "assumptions", [{}, {"positive": True}, {"integer": True}, {"commutative": False}]
)
def test_states_and_inputs_are_symbols_declared_real_and_nothing_more(assumptions):
    y = sp.Symbol("y", **assumptions)
    for state, force in ((y, u), (x, y)):
        with pytest.raises(
            SystemDefinitionError, match=r"y is declared .*sympy.symbols\('y', real=True\)"
        ):
            ControlAffineSDE((state,), (force,), [0], [1], [0])
        with pytest.raises(SystemDefinitionError, match="y is declared"):
            ControlAffineSDE.from_rate([state], [force], [force])


def test_parameters_are_what_their_symbols_are_declared():
    plain, positive, whole = (
        sp.Symbol("a"),
        sp.Symbol("b", positive=True),
        sp.Symbol("c", integer=True),
    )
    with pytest.raises(SystemDefinitionError, match="a is declared nothing"):
        ControlAffineSDE((x,), (u,), [plain * x], [1], [0], {plain: 1.0})
    for symbol, good, bad in ((positive, 0.5, -0.5), (positive, 2, 0.0), (whole, 3.0, 2.5)):
        system = ControlAffineSDE((x,), (u,), [symbol * x], [1], [0], {symbol: good})
        assert system.parameters == {symbol: good}
        # sqrt(b**2) is b to sympy, and would be -0.5 here.
        with pytest.raises(ConfigurationError, match=f"parameter {symbol} = .*declared"):
            system.with_parameters(**{symbol.name: bad})


def test_a_root_of_a_square_is_the_size_of_a_real_state():
    system = ControlAffineSDE.from_rate((x,), (u,), [u])
    problem = state_problem(
        system, 1 - sp.sqrt(x**2), box=(-1, 1), start=[-0.5], dt=0.1, horizon=1.0
    )
    assert problem.barriers[0].expression == 1 - sp.Abs(x)


@pytest.mark.parametrize("name", ["t", "sin", "x_{1}", "_c0"])
def test_names_of_states_are_free(name):
    def episode(state, force, rate):
        system = ControlAffineSDE(
            (state, v), (force,), [sp.sin(v) * rate, 0], [0, 1], [0, sigma], {rate: 2.0, sigma: 0.3}
        )
        problem = state_problem(
            system,
            1 - state**2 - sp.sin(state) ** 2,
            box=(-1, 1),
            start=[0.1, 0.2],
            dt=0.1,
            horizon=1.0,
            nominal=-state,
            reward=state * force * sp.cos(TIME),
        )
        scalar, batch = SafeEnv(problem), SafeVectorEnv(problem, 2)
        scalar.reset(seed=0)
        batch.reset(seed=0)
        one = [scalar.step([0.5]) for _ in range(3)][-1]
        many = [batch.step(np.full((2, 1), 0.5)) for _ in range(3)][-1]
        filtered = SafetyFilter.for_problem(problem, "hocbf").filter([0.3, 0.9], [1.0])
        return [*one[0], one[1], *many[0][0], many[1][0], *filtered.action, *filtered.barrier]

    plain = episode(x, u, k)
    for symbols in (
        (sp.Symbol(name, real=True), u, k),
        (x, sp.Symbol(name, real=True), k),
        (x, u, sp.Symbol(name, real=True)),
    ):
        assert episode(*symbols) == pytest.approx(plain, rel=1e-12)


@pytest.mark.parametrize("h", [1 - sp.Abs(x), sp.Min(1 - x, 1 + x), sp.Max(0.5 - x, 1 - x**2)])
def test_a_barrier_with_kinks_under_noise_is_kept_by_its_pieces_or_refused(h):
    system = ControlAffineSDE((x,), (u,), [0], [1], [sigma], {sigma: 0.3})
    problem = state_problem(system, h, box=(-1, 1), start=[0.1], dt=0.05, horizon=1.0)
    env = SafeEnv(problem)
    env.reset(seed=0)
    env.step([1.0])
    assert SafetyFilter.for_problem(problem, "cbf").filter([0.9], [1.0]).feasible
    if isinstance(h, sp.Max):
        with pytest.raises(SystemDefinitionError, match="is a maximum, which scbf cannot keep"):
            SafetyFilter.for_problem(problem, "scbf")
        return
    found, listed = (
        SafetyFilter(system, each, "scbf", (-1, 1)).filter([0.9], [1.0])
        for each in (h, [1 - x, 1 + x])
    )
    assert found.action == listed.action


def test_a_symbol_of_the_nominal_controller_means_one_thing():
    for names in (("x", "x"), ("x", "k")):
        features = tuple(
            Feature(name, state, -5.0, 5.0) for name, state in zip(names, (x, v), strict=True)
        )
        with pytest.raises(
            SystemDefinitionError, match=f"named twice, or like a parameter: {names[1]}"
        ):
            state_problem(
                ControlAffineSDE((x, v), (u,), [v, -k * x], [0, 1], [0, 0], {k: 2.0}), 1 - x**2,
                box=(-5, 5), start=[0.0, 0.0], dt=0.05, horizon=1.0, features=features, nominal=0,
            )  # fmt: skip


def test_a_text_is_no_function():
    # Sympy reads texts by Python's eval.
    for given in ({"V": "x**2"}, {"V": x**2, "input_weight": "1 + 1"}):
        with pytest.raises(SystemDefinitionError, match="is a text"):
            CLF(**given)
