"""A control-affine SDE: what it takes, what it refuses, and that it does not change."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import (
    Barrier,
    ConfigurationError,
    ControlAffineSDE,
    SystemDefinitionError,
    SystemDefinitionWarning,
    define_problem,
)
from safe_envs.dynamics.integrators import Integrator
from safe_envs.dynamics.symbols import TIME
from safe_envs.wrappers import SafetyFilter

x, y, u, w, k, p, q = sp.symbols("x y u w k p q", real=True)
PLAIN = sp.Symbol("x")


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


TWICE = {"states": (x, x), "drift": [k * x, 0], "input_matrix": [1, 0], "diffusion": [0, 0]}


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
        ({"drift": [PLAIN]}, "x has other assumptions there"),
        ({"parameters": {}}, "unknown symbol k.*parameters"),
        (TWICE, "more than once"),
        ({"inputs": (), "input_matrix": []}, "a state and an input"),
        ({"drift": "no matrix"}, "drift"),
        ({"states": ("x",)}, "no symbol"),
        ({"drift": [w * x], "parameters": {w: 1.0, sp.Symbol("a"): 1.0}}, "a is declared"),
    ],
)
def test_contradictions_are_named(changes, message):
    with pytest.raises(SystemDefinitionError, match=rf"(?s){message}"):
        scalar(**changes)


@pytest.mark.parametrize(
    "assumptions", [{}, {"positive": True}, {"integer": True}, {"commutative": False}]
)
@pytest.mark.parametrize("make", [ControlAffineSDE, ControlAffineSDE.from_rate])
def test_states_and_inputs_are_symbols_declared_real_and_nothing_more(assumptions, make):
    wrong = sp.Symbol("y", **assumptions)
    for state, force in ((wrong, u), (x, wrong)):
        rest = ([0], [1]) if make is ControlAffineSDE else ([force],)
        with pytest.raises(SystemDefinitionError, match=r"y is declared .*real=True"):
            make((state,), (force,), *rest)


def test_parameters_are_finite_numbers_of_the_kind_that_their_symbols_declare():
    for value in (math.nan, math.inf, "two"):
        with pytest.raises(ConfigurationError, match="parameter k"):
            scalar(parameters={k: value})
        with pytest.raises(ConfigurationError, match="parameter k"):
            scalar().with_parameters(k=value)
    with pytest.raises(ConfigurationError, match="'kk'; did you mean 'k'"):
        scalar().with_parameters(kk=1.0)
    positive, whole = sp.Symbol("b", positive=True), sp.Symbol("c", integer=True)
    for symbol, good, bad in ((positive, 0.5, -0.5), (positive, 2, 0.0), (whole, 3.0, 2.5)):
        system = scalar(drift=[symbol * x], parameters={symbol: good})
        assert system.parameters == {symbol: good}
        # sqrt(b**2) is b to sympy, and would be -0.5 here.
        with pytest.raises(ConfigurationError, match=f"parameter {symbol} = .*declared"):
            system.with_parameters(**{symbol.name: bad})


def test_with_parameters_returns_another_system():
    system = scalar()
    other = system.with_parameters(k=3)
    assert (system.parameters, other.parameters) == ({k: 2.0}, {k: 3.0})
    matrix = sp.Matrix([k, x])
    assert other.numeric(matrix) == sp.Matrix([3, x])
    matrix[0] = 3 * k
    assert other.numeric(matrix) == sp.Matrix([9, x])


@pytest.mark.parametrize(
    ("entry", "parameters", "noisy"),
    [(0, {}, False), (0.0, {}, False), (w, {w: 0.0}, False), (w, {w: 0.1}, True)],
)
def test_a_diffusion_of_zeros_is_no_noise_however_they_are_written(entry, parameters, noisy):
    system = scalar(drift=[0], diffusion=[[entry, 0.0]], parameters=parameters)
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


def test_from_rate_takes_a_rate_apart():
    rate = [y + w, sp.cos(x) * (u + 3) - (x + u) ** 2 + u**2 + 2 * x * u]
    system = ControlAffineSDE.from_rate((x, y), (u, w), rate)
    assert system.drift.equals(sp.Matrix([y, 3 * sp.cos(x) - x**2]))
    assert system.input_matrix.equals(sp.Matrix([[0, 1], [sp.cos(x), 0]]))
    assert not any(system.diffusion)
    rate = [sp.Max(x, 0) * u + sp.Abs(x - 500) + 0.1 * u]
    system = ControlAffineSDE.from_rate((x,), (u,), rate)
    assert system.input_matrix[0] == sp.Max(x, 0) + sp.Float(0.1)


@pytest.mark.parametrize(
    "rate",
    [
        *(sp.sin(u), u**2, x * sp.Abs(u), 1 / (u + 2), x + sp.Heaviside(u)),
        *(sp.Max(u - edge, 0) for edge in (2, 500)),
        *(sp.Piecewise((0, u < edge), (1, True)) for edge in (2, 500)),
        *(sp.Abs(u + edge) - edge for edge in (2, 500)),
        sp.Piecewise((u + 1, u > 0), (u - 1, True)),
    ],
)
def test_a_rate_that_is_not_affine_in_the_input_is_refused(rate):
    with pytest.raises(SystemDefinitionError, match="rate of y is not affine"):
        ControlAffineSDE.from_rate((x, y), (u,), [y, u + rate])


def test_a_rate_that_cannot_be_taken_apart_is_refused():
    with pytest.raises(SystemDefinitionError, match="cancel what divides by an input"):
        ControlAffineSDE.from_rate((x,), (u,), [(u**2 + u) / u])
    with pytest.raises(SystemDefinitionError, match="lists of symbols"):
        ControlAffineSDE.from_rate(x, u, [y])  # pyright: ignore[reportArgumentType]


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
        ({p: u, q: 0}, "signal p depends on an input"),
        ({p: y, q: 0}, "signal p uses the unknown symbol y"),
        ({p: "q", q: 0}, "p is a text"),
        ({p: True, q: 0}, "p is bool"),
        ({p: 0, q: 0, x: 0}, "more than once .*signals: x"),
        ({p: 0, q: 0, "mass": 0}, "'mass'"),
        ({p: 0, q: 0, sp.Symbol("mass"): 0}, "mass is declared nothing"),
        ({p: 0, q: 0, sp.Symbol("n", integer=True): 0}, "n is declared integer=True"),
        ({p: 0, q: 0, TIME: 1}, "The time is no signal"),
        ({q: 0}, "drift uses the unknown symbol p"),
        *(({p: 0, q: v}, r"signal q is .*finite") for v in (sp.nan, sp.oo, -sp.oo, y + sp.zoo)),
        *(({p: 0, q: v}, r"signal q is .*finite") for v in (math.nan, math.inf)),
    ],
)
def test_contradictions_of_signals_are_named(signals, message):
    with pytest.raises(SystemDefinitionError, match=message):
        measured(signals=signals)


@pytest.mark.parametrize("make", [scalar, ControlAffineSDE.from_rate])
@pytest.mark.parametrize("name", ["signals", "parameters"])
def test_signals_and_parameters_are_dicts(make, name):
    given = {} if make is scalar else {"states": (x,), "inputs": (u,), "rate": [u]}
    for wrong in ([y], {y}, "y", (y, 0), y):
        with pytest.raises(SystemDefinitionError, match=f"{name}="):
            make(**given, **{name: wrong})


@pytest.mark.parametrize(
    ("system", "barrier", "message"),
    [
        (measured(), 1 - x, "depends on .*p, q.*a state"),
        (measured(drift=[TIME], signals={}), 1 - x, "depends on .*the time.*a state"),
        (measured(drift=[0], signals={}), 1 - x - TIME, "unknown symbol t; .*a state"),
    ],
)
def test_an_env_simulates_what_moves(system, barrier, message):
    with pytest.raises(SystemDefinitionError, match=message):
        define_problem(system, barrier, input_bounds=(-1, 1), start=(0.0,), dt=0.1, horizon=1.0)


def test_sums_and_products_over_an_index_are_written_out():
    i, j = sp.symbols("i j", integer=True)
    total, written = sp.Sum(x**i, (i, 0, 3)), 1 + x + x**2 + x**3
    rate = sp.Product(y + i, (i, 1, 2))
    system = scalar(drift=[k * total], signals={y: rate}, diffusion=[[total / 10]])
    signals = {y: (y + 1) * (y + 2)}
    assert system == scalar(drift=[k * written], signals=signals, diffusion=[[written / 10]])
    # The inner index runs as far as the outer one says, under the name of another index too.
    for inner in (j, i):
        nested = sp.Sum(sp.Sum(x**inner, (inner, 0, i)), (i, 0, 2))
        assert sp.expand(Barrier(1 - nested).expression) == -2 - 2 * x - x**2
    assert Barrier(sp.Sum(x * i + j, (i, 0, j), (j, 0, 1))).expression.expand() == x + 2
    for wrong in ((i, 0, sp.oo), (i, 0, k), (i, 0, 5000), (i, 3, 0), (i, 0.5, 3)):
        with pytest.raises(SystemDefinitionError, match="cannot be written out"):
            Barrier(1 - sp.Sum(x**i, wrong))
    system = ControlAffineSDE.from_rate((x,), (u,), [u])
    made, other = (
        SafetyFilter(system, 2 - h, "cbf:alpha=1", input_bounds=(-1, 1)).filter([0.4], [1.0])
        for h in (total, written)
    )
    np.testing.assert_allclose(made.action, other.action, atol=1e-15)


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
