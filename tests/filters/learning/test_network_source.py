"""Networks and learned terms in compiled programs: the values that NumPy gives."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import sympy as sp

from safe_envs.engine import slots
from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Program
from safe_envs.engine.slots import Data
from safe_envs.filters.conditions.base import terms_source
from safe_envs.filters.learning.models.generator import LearnedGenerator
from safe_envs.filters.learning.models.network import Network, network_source, slopes_source
from safe_envs.filters.learning.models.residual import LearnedResidual

STATES = sp.symbols("position angle speed", real=True)
COORDINATES = (STATES[0] * STATES[2], sp.sin(STATES[1]), sp.cos(STATES[1]) + STATES[2])
POINTS = np.random.default_rng(0).normal(size=(40, 3))


def some_network(outputs, activation, hidden=(6, 5), inputs=3):
    rng, sizes = np.random.default_rng(5), [inputs, *hidden, outputs]
    return Network(
        tuple(0.5 * rng.normal(size=(b, a)) for a, b in pairwise(sizes)),
        tuple(rng.normal(size=b) for b in sizes[1:]),
        activation,
        rng.normal(size=inputs),
        np.arange(1.0, inputs + 1.0),
        rng.normal(size=outputs),
        np.arange(1.0, outputs + 1.0),
    )


def assert_close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-14)


def values_of(source, data, points=POINTS):
    """What the function `found` returns at points, in plain Python."""
    call = Source(
        "def observation_of(values):\n    return found(values[0], values[1], values[2])\n"
    )
    function = Program("terms", [slots.observation_of], source + call).plain()["observation_of"]
    numbers, work = data.array(), np.full(source.work, np.nan)
    return np.array([function((tuple(x), numbers, work)) for x in points.tolist()])


@pytest.mark.parametrize("hidden", [(), (4,), (6, 5), (3, 7, 4)])
@pytest.mark.parametrize("activation", ["identity", "tanh", "relu", "leaky_relu", "elu", "silu"])
def test_networks(activation, hidden):
    network, data = some_network(2, activation, hidden), Data()
    data.add([1.0, 2.0])
    found = values_of(network_source(network, "found", data), data)
    assert_close(found, network.outputs(POINTS))
    assert np.ptp(found, axis=0).min() > 1e-3


@pytest.mark.parametrize("hidden", [(), (4,), (3, 7, 4)])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_slopes(activation, hidden):
    network, data = some_network(2, activation, hidden), Data()
    found = values_of(slopes_source(network, "found", data, 1), data)
    expected = [network.values_and_slopes_floats(x, 1)[1] for x in POINTS.tolist()]
    assert_close(found, expected)
    assert np.abs(found).max(axis=0).min() > 1e-3


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_gives_nan(bad):
    network, data = some_network(1, "tanh"), Data()
    points = np.array([[0.1, bad, 0.2]])
    assert np.isnan(values_of(network_source(network, "found", data), data, points)).all()
    data = Data()
    assert np.isnan(values_of(slopes_source(network, "found", data, 0), data, points)).all()


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("kind", ["residual", "generator"])
def test_terms(kind, degree):
    if kind == "residual":
        network = some_network(degree + 2, "relu")
        terms = LearnedResidual(STATES, COORDINATES, degree, network, np.ones((9, degree + 2)))
    else:
        networks = tuple(some_network(1, "tanh", (4 + j,)) for j in range(degree))
        terms = LearnedGenerator(STATES, COORDINATES, networks)
    data = Data()
    found = values_of(terms_source(terms, "found", data), data)
    assert found.shape == (len(POINTS), len(terms.symbols))
    assert_close(found.T, terms.arrays(tuple(POINTS.T)))
    assert_close(found[0], terms.floats(tuple(POINTS[0])))
