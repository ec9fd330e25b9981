"""Construction of a system says what is wrong with it."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import (
    ConfigurationError,
    ControlAffineSDE,
    SystemDefinitionError,
    SystemDefinitionWarning,
    state_problem,
)
from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.integrators import Integrator
from safe_envs.dynamics.symbols import TIME
from safe_envs.problem.problem import Barrier
from safe_envs.wrappers import SafetyFilter

x, y, u, k = sp.symbols("x y u k", real=True)


def scalar(**changes):
    arguments = {
        "states": (x,),
        "inputs": (u,),
        "drift": [k * x],
        "input_matrix": [1],
        "diffusion": [0.1],
        "parameters": {k: 2.0},
        **changes,
    }
    return ControlAffineSDE(**arguments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drift": [x, x]}, "drift has shape 2 x 1"),
        ({"input_matrix": [[1, 2]]}, "input_matrix has shape 1 x 2"),
        ({"diffusion": [[1], [2]]}, "diffusion has shape 2 x 1"),
        ({"drift": [x * u]}, "drift depends on the input u"),
        ({"input_matrix": [u]}, "input_matrix depends on the input u"),
        ({"diffusion": [sp.sin(u)]}, "diffusion depends on the input u"),
        ({"drift": [y]}, "unknown symbol y"),
        ({"drift": [sp.Symbol("x")]}, "Symbol\\('x'\\)"),
        ({"parameters": {}}, "unknown symbol k"),
        (
            {"states": (x, x), "drift": [k * x, 0], "input_matrix": [1, 0], "diffusion": [0, 0]},
            "more than once",
        ),
        ({"inputs": (), "input_matrix": []}, "needs a state and an input"),
        ({"drift": "no matrix"}, "drift is no matrix"),
    ],
)
def test_contradictions_are_named(changes, message):
    with pytest.raises(SystemDefinitionError, match=message):
        scalar(**changes)


@pytest.mark.parametrize("value", [math.nan, math.inf, "two"])
def test_parameters_are_finite_numbers(value):
    with pytest.raises(ConfigurationError, match="parameter k"):
        scalar(parameters={k: value})
    with pytest.raises(ConfigurationError, match="parameter k"):
        scalar().with_parameters(k=value)


def test_a_diffusion_of_zeros_is_no_noise_however_they_are_written():
    x, u, sigma = sp.symbols("x u sigma", real=True)
    for entry, parameters, noisy in (
        (0, {}, False),
        (0.0, {}, False),
        (sigma, {sigma: 0.0}, False),
        (sigma, {sigma: 0.1}, True),
    ):
        system = ControlAffineSDE(
            states=(x,),
            inputs=(u,),
            drift=[0],
            input_matrix=[1],
            diffusion=[[entry, 0.0]],
            parameters=parameters,
        )
        assert system.noisy == noisy
        assert Integrator(system, 0.1, 1, "floats").channels == noisy


def test_no_diffusion_is_no_noise():
    assert not ControlAffineSDE((x, y), (u,), [0, 0], [1, 0]).noisy
    assert not ControlAffineSDE.from_rate((x, y), (u,), [u, y]).noisy


def test_a_single_noise_of_several_states_warns_unless_it_is_written_as_such():
    for shared in ([0.3, 0.3], [k, 1], (0.1, x), np.array([0.1, 0.2])):
        with pytest.warns(SystemDefinitionWarning, match="a single Wiener process"):
            ControlAffineSDE((x, y), (u,), [0, 0], [1, 0], shared, {k: 1.0})
    for meant in ([0, 0.3], [0.0, k], [[0.3], [0.3]], sp.Matrix([k, k]), [[0.3, 0], [0, 0.3]]):
        system = ControlAffineSDE((x, y), (u,), [0, 0], [1, 0], meant, {k: 1.0})
        assert replace(system, drift=[x, y]).diffusion == system.diffusion


def test_with_parameters_returns_another_system_and_knows_its_names():
    system = scalar()
    other = system.with_parameters(k=3)
    assert system.parameters == {k: 2.0}
    assert other.parameters == {k: 3.0}
    with pytest.raises(ConfigurationError, match="unknown parameter 'kk'; did you mean 'k'"):
        system.with_parameters(kk=1.0)


def test_numbers_take_the_place_of_parameters_in_a_matrix_that_may_change_later():
    a, x = sp.symbols("a x", real=True)
    system = ControlAffineSDE((x,), (sp.Symbol("u", real=True),), [a * x], [1], [0], {a: 2.0})
    matrix = sp.Matrix([a, x])
    assert system.numeric(matrix) == sp.Matrix([2, x])
    matrix[0] = 3 * a
    assert system.numeric(matrix) == sp.Matrix([6, x])


def test_functions_by_pieces_compile():
    x = sp.Symbol("x", real=True)
    pieces = sp.Piecewise((1 - x**2, x > 0), ((1 + x) ** 3, True))
    floats, arrays = (compile_function((x,), [pieces], flavour) for flavour in ("floats", "arrays"))
    for value, expected in ((0.5, 0.75), (-0.5, 0.125)):
        assert floats(value)[0] == pytest.approx(expected)
        assert arrays(np.array([value]))[0] == pytest.approx(expected)


p, q = sp.symbols("p q", real=True)


def measured(**changes):
    """A point chased by something that is measured."""
    given = {"drift": [-p + x * TIME], "signals": {p: q, q: 0}, **changes}
    return ControlAffineSDE((x,), (u,), given.pop("drift"), [[1]], [[0]], **given)


def test_signals_have_rates_and_are_known_to_the_system():
    system = measured()
    assert system.signals == {p: q, q: sp.Integer(0)}
    assert system.measured == (x, p, q, TIME)
    assert system.uses_time
    assert not measured(drift=[-p]).uses_time
    assert measured(drift=[-p], signals={p: TIME}).uses_time
    assert hash(system) == hash(measured()) != hash(measured(signals={p: 0, q: 0}))
    assert system != measured(signals={p: 0, q: 0})
    assert measured(parameters={k: 2.0}).with_parameters(k=3.0).signals == system.signals
    split = ControlAffineSDE.from_rate((x,), (u,), [u - p], signals={p: 1})
    assert (split.drift[0], split.signals) == (-p, {p: sp.Integer(1)})


@pytest.mark.parametrize(
    ("signals", "message"),
    [
        ({p: u, q: 0}, "the signal p depends on an input; what the inputs move is a state"),
        ({p: y, q: 0}, "the rate of the signal p uses the unknown symbol y"),
        ({p: "q", q: 0}, "the rate of p is a text"),
        ({p: True, q: 0}, "the rate of p is bool"),
        ({p: 0, q: 0, x: 0}, "defined more than once .*signals: x"),
        ({p: 0, q: 0, "mass": 0}, "'mass' among states, inputs, parameters and signals"),
        ({p: 0, q: 0, sp.Symbol("mass"): 0}, "the signal mass is declared nothing"),
        ({p: 0, q: 0, sp.Symbol("n", integer=True): 0}, "the signal n is declared integer=True"),
        ({p: 0, q: 0, TIME: 1}, "The time is no signal"),
        ({q: 0}, "drift uses the unknown symbol p"),
    ],
)
def test_contradictions_of_signals_are_named(signals, message):
    with pytest.raises(SystemDefinitionError, match=message):
        measured(signals=signals)


def test_an_env_simulates_what_moves():
    for system, names in ((measured(), "p, q"), (measured(drift=[TIME], signals={}), "the time")):
        with pytest.raises(SystemDefinitionError, match=f"depends on .*{names}.*a state"):
            state_problem(system, 1 - x, box=(-1, 1), start=(0.0,), dt=0.1, horizon=1.0)


def test_the_time_is_no_part_of_an_envs_barrier():
    still = measured(drift=[0], signals={})
    with pytest.raises(SystemDefinitionError, match=r"unknown symbol t; .*a state whose rate is 1"):
        state_problem(still, 1 - x - TIME, box=(-1, 1), start=(0.0,), dt=0.1, horizon=1.0)


@pytest.mark.parametrize("make", [scalar, ControlAffineSDE.from_rate])
@pytest.mark.parametrize(("name", "entry"), [("signals", "rate"), ("parameters", "value")])
def test_signals_and_parameters_are_dicts(make, name, entry):
    given = {} if make is scalar else {"states": (x,), "inputs": (u,), "rate": [u]}
    for wrong in ([y], {y}, "y", (y, 0), y):
        with pytest.raises(SystemDefinitionError, match=f"{name}={{symbol: {entry}}}"):
            make(**given, **{name: wrong})


@pytest.mark.parametrize("rate", [sp.nan, sp.oo, -sp.oo, math.nan, math.inf, y + sp.zoo])
def test_rates_of_signals_are_finite(rate):
    with pytest.raises(SystemDefinitionError, match=r"the rate of the signal y is .*finite"):
        scalar(signals={y: rate})


def test_sums_and_products_over_an_index_are_written_out():
    i, j = sp.symbols("i j", integer=True)
    total = sp.Sum(x**i, (i, 0, 3))
    system = scalar(
        drift=[k * total], signals={y: sp.Product(y + i, (i, 1, 2))}, diffusion=[[total / 10]]
    )
    assert system == scalar(
        drift=[k * (1 + x + x**2 + x**3)],
        signals={y: (y + 1) * (y + 2)},
        diffusion=[[(1 + x + x**2 + x**3) / 10]],
    )
    # The inner index runs as far as the outer one says, under the name of another index too.
    for inner in (j, i):
        nested = sp.Sum(sp.Sum(x**inner, (inner, 0, i)), (i, 0, 2))
        assert sp.expand(Barrier(1 - nested).expression) == -2 - 2 * x - x**2
    assert Barrier(sp.Sum(x * i + j, (i, 0, j), (j, 0, 1))).expression.expand() == x + 2
    for wrong in ((i, 0, sp.oo), (i, 0, k), (i, 0, 5000), (i, 3, 0), (i, 0.5, 3)):
        with pytest.raises(SystemDefinitionError, match="cannot be written out; let the index"):
            Barrier(1 - sp.Sum(x**i, wrong))


def test_a_filter_takes_a_barrier_with_a_sum():
    i = sp.symbols("i", integer=True)
    system = ControlAffineSDE.from_rate((x,), (u,), [u])
    made, other = (
        SafetyFilter(system, 2 - total, "cbf:alpha=1", bounds=(-1, 1))
        for total in (sp.Sum(x**i, (i, 0, 3)), 1 + x + x**2 + x**3)
    )
    for one, same in zip(made.filter([0.4], [1.0]), other.filter([0.4], [1.0]), strict=True):
        np.testing.assert_allclose(one, same, atol=1e-15)


@pytest.mark.parametrize("name", ["parameters", "signals"])
def test_a_system_does_not_change_from_outside(name):
    symbol = k if name == "parameters" else y
    given = {symbol: 2.0}
    system = scalar(**{name: given})
    before, kept = hash(system), getattr(system, name)
    given[symbol] = 3.0
    for change in (
        lambda: kept.__setitem__(symbol, 3.0),
        lambda: kept.__delitem__(symbol),
        lambda: kept.update({symbol: 3.0}),
        lambda: kept.setdefault(u, 3.0),
        lambda: kept.pop(symbol),
        kept.popitem,
        kept.clear,
        lambda: kept.__ior__({symbol: 3.0}),
    ):
        with pytest.raises(TypeError, match="does not change"):
            change()
    assert kept == {symbol: 2.0}
    assert hash(system) == before
    for other in (pickle.loads(pickle.dumps(system)), copy.deepcopy(system), copy.copy(system)):
        assert (other, hash(other)) == (system, before)
        with pytest.raises(TypeError, match="does not change"):
            getattr(other, name)[symbol] = 3.0
    assert copy.copy(kept) is kept
    assert type(kept | {u: 1.0}) is dict
