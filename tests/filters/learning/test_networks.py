"""Networks: their values and slopes, one state, a batch and compiled, and their training."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import sympy as sp

from safe_envs.engine import slots
from safe_envs.engine.formulas import Source
from safe_envs.engine.program import Program
from safe_envs.engine.slots import Data
from safe_envs.errors import ConfigurationError, InvalidInputError
from safe_envs.filters.conditions.base import terms_source
from safe_envs.filters.learning.checks import Purpose, random_stream
from safe_envs.filters.learning.models.features import Features
from safe_envs.filters.learning.models.generator import LearnedGenerator
from safe_envs.filters.learning.models.network import Network, network_source, slopes_source
from safe_envs.filters.learning.models.residual import LearnedResidual
from safe_envs.filters.learning.residual import AdamSettings, train
from tests.conftest import problem_of

pytestmark = pytest.mark.slow

_ACTIVATIONS = ("relu", "tanh")


def random_network(activation, widths=(4, 100, 30, 3), seed=0):
    rng = np.random.default_rng(seed)
    pairs = list(itertools.pairwise(widths))
    return Network(
        tuple(rng.normal(size=(out, into)) / into**0.5 for into, out in pairs),
        tuple(rng.normal(size=out) for _, out in pairs),
        activation,
        rng.normal(size=widths[0]),
        rng.uniform(0.1, 10.0, widths[0]),
        rng.normal(size=widths[-1]),
        rng.uniform(0.1, 10.0, widths[-1]),
    )


def batch(count, width=4, seed=1):
    return tuple(np.random.default_rng(seed).normal(size=(width, count)) * 2.0)


@pytest.mark.parametrize("activation", _ACTIVATIONS)
@pytest.mark.parametrize("widths", [(4, 100, 30, 3), (2, 5, 1), (3, 2)])
def test_the_outputs_are_those_of_torch(activation, widths):
    import torch

    network, x = random_network(activation, widths), batch(100, widths[0])
    act = torch.relu if activation == "relu" else torch.tanh
    y = (torch.tensor(np.stack(x, axis=1)) - torch.tensor(network.input_mean)) / torch.tensor(
        network.input_scale
    )
    for k, (w, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        y = torch.nn.functional.linear(y, torch.tensor(w), torch.tensor(b))
        y = act(y) if k + 1 < len(network.weights) else y
    expected = (y * torch.tensor(network.output_scale) + torch.tensor(network.output_mean)).numpy()
    np.testing.assert_allclose(
        np.stack(network.arrays(x), axis=1), expected, rtol=1e-10, atol=1e-10
    )
    one = [float(c[7]) for c in x]
    np.testing.assert_allclose(network.floats(one), expected[7], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("activation", _ACTIVATIONS)
@pytest.mark.parametrize("output", [0, 2])
def test_the_slopes_are_those_of_finite_differences(activation, output):
    network, x, step = random_network(activation), batch(50), 1e-6
    values, slopes = network.values_and_slopes_arrays(x, output)
    assert all(np.array_equal(a, b) for a, b in zip(values, network.arrays(x), strict=True))
    for i, slope in enumerate(slopes):
        above, below = (
            network.arrays(tuple(c + s * step * (i == j) for j, c in enumerate(x)))[output]
            for s in (1, -1)
        )
        # A rectifier that switches within the step spoils the difference, not the slope: so the
        # median.
        wrong = np.abs(slope - (above - below) / (2 * step))
        assert np.median(wrong) < 1e-8 * np.abs(slope).max()
        assert (wrong < 1e-6).mean() > 0.95
    value, gradient = network.values_and_slopes_floats([float(c[3]) for c in x], output)
    np.testing.assert_allclose(value, [v[3] for v in values], rtol=1e-12)
    np.testing.assert_allclose(gradient, [s[3] for s in slopes], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("activation", _ACTIVATIONS)
@pytest.mark.parametrize("widths", [(4, 100, 30, 3), (1, 7, 1), (4, 100, 30, 6)])
def test_a_states_outputs_are_the_same_to_the_last_bit_in_every_batch(activation, widths):
    network, x = random_network(activation, widths), batch(1024, widths[0])
    whole = network.values_and_slopes_arrays(x, 0)
    for count in (1, 7, 100, 1000):
        for first in (0, 5, 1024 - count):
            part = slice(first, first + count)
            found = network.values_and_slopes_arrays(tuple(c[part] for c in x), 0)
            for mine, all_of_them in zip(found, whole, strict=True):
                for a, b in zip(mine, all_of_them, strict=True):
                    assert np.array_equal(a, b[part])


@pytest.mark.parametrize("activation", _ACTIVATIONS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_not_hidden(activation, bad):
    network, x = random_network(activation), [c.copy() for c in batch(40)]
    fine = network.values_and_slopes_arrays([c.copy() for c in x], 1)
    x[2][33] = bad
    found = network.values_and_slopes_arrays(x, 1)
    for mine, unspoilt in zip((*found[0], *found[1]), (*fine[0], *fine[1]), strict=True):
        assert np.isnan(mine[33])
        assert np.array_equal(np.delete(mine, 33), np.delete(unspoilt, 33))
    assert np.isnan(network.floats([0.0, bad, 0.0, 0.0])).all()
    assert np.isnan(network.values_and_slopes_floats([0.0, bad, 0.0, 0.0], 1)[1]).all()


def test_the_arrays_make_the_same_network_again():
    network, other = random_network("tanh"), random_network("relu", (2, 3, 1))
    saved = {**network.to_arrays("part_1"), **other.to_arrays("part_10")}
    again = Network.from_arrays(saved, "part_1", "tanh")
    for a, b in zip(network.arrays(batch(70)), again.arrays(batch(70)), strict=True):
        assert np.array_equal(a, b)
    with pytest.raises(KeyError):
        Network.from_arrays(saved, "part_2", "tanh")


@pytest.mark.parametrize(
    "change",
    [
        {"activation": "gelu"},
        {"weights": ()},
        {"biases": (np.zeros(5), np.zeros(2))},
        {"weights": (np.zeros((5, 2)), np.zeros((1, 4)))},
        {"input_mean": np.zeros(3)},
        {"output_scale": np.zeros(1)},
        {"input_scale": np.array([1.0, np.nan])},
    ],
)
def test_a_network_that_does_not_fit_is_refused(change):
    network = random_network("relu", (2, 5, 1))
    fields = {name: value for name, value in vars(network).items() if not name.startswith("_")}
    with pytest.raises(ConfigurationError):
        Network(**{**fields, **change})


def fitted(inputs, targets, *, seed=0, sizes=None, progress=None, **settings):
    """Train a network with some settings."""
    adam = AdamSettings(**settings)
    return train(inputs, targets, adam, seed=seed, sizes=sizes, progress=progress)


def data(rows=600):
    x = np.random.default_rng(3).uniform(-1.0, 1.0, (rows, 2))
    return x, np.stack((x[:, 0] * x[:, 1], 1e-7 * x[:, 0] ** 2), axis=1)


def test_a_network_learns_functions_of_any_unit_and_says_how_well():
    x, y = data()
    progress = []
    trained = fitted(
        x, y, hidden=(30, 20), epochs=150, batch=64, rate=3e-3, progress=progress.append
    )
    assert trained.heldout.shape == (90, 2)
    assert (np.sqrt((trained.heldout**2).mean(axis=0)) < 0.15 * y.std(axis=0)).all()
    assert len(progress) == trained.epochs <= 150
    assert progress == sorted(progress)
    fresh = np.random.default_rng(4).uniform(-1.0, 1.0, (500, 2))
    wrong = np.abs(trained.network.arrays(tuple(fresh.T))[0] - fresh[:, 0] * fresh[:, 1])
    assert wrong.mean() < 2.0 * trained.heldout[:, 0].mean()


def test_the_same_seed_gives_the_same_network_and_leaves_torch_as_it_was():
    import torch

    x, y = data(200)
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    nets = [
        fitted(x, y, hidden=(8,), epochs=5, seed=seed).network.to_arrays("n") for seed in (1, 1, 2)
    ]
    assert torch.get_num_threads() == threads
    assert torch.equal(torch.get_rng_state(), state)
    assert all(np.array_equal(nets[0][name], nets[1][name]) for name in nets[0])
    assert not np.array_equal(nets[0]["n_weights_0"], nets[2]["n_weights_0"])


def test_the_noise_of_a_constant_target_is_not_blown_up():
    x, y = data(300)
    noise = 1e-7 * np.random.default_rng(0).normal(size=300)
    y[:, 1] = -0.78 + noise
    trained = fitted(x, y, hidden=(20,), epochs=30)
    assert trained.heldout[:, 1].max() < 1e-4 * 0.78
    # The noise weighs nothing in the loss: the other target is learned as if it were not there.
    quiet = fitted(x, np.stack((y[:, 0], np.full(300, -0.78)), axis=1), hidden=(20,), epochs=30)
    assert trained.validation_loss == pytest.approx(quiet.validation_loss, rel=0.01)
    # A size can be told: against 1 the second target here is nothing, although it is all noise by
    # itself.
    told = fitted(
        x, np.stack((y[:, 0], noise), axis=1), hidden=(20,), epochs=30, sizes=np.array([1.0, 1.0])
    )
    assert told.network.output_scale[1] == 1e-4


def test_constant_columns_of_zeros_are_fine():
    x, y = data(50)
    trained = fitted(
        np.hstack((x, np.zeros((50, 1)))), np.hstack((y, np.zeros((50, 1)))), hidden=(5,), epochs=2
    )
    assert trained.network.input_scale[2] == trained.network.output_scale[2] == 1.0


@pytest.mark.parametrize("value", [0.0, -0.78, 1e-9])
def test_a_target_that_is_constant_is_answered_by_the_constant(value):
    x, y = data(60)
    constant = value * (1.0 + 1e-15 * np.arange(60)[:, None] / 60)
    trained = fitted(x, constant, hidden=(5,), epochs=3)
    (found,) = trained.network.arrays(tuple(x.T))
    np.testing.assert_allclose(found, value, rtol=1e-14, atol=0.0)
    assert not np.any(trained.network.values_and_slopes_arrays(tuple(x.T), 0)[1])
    assert (trained.epochs, trained.validation_loss) == (0, 0.0)
    assert trained.heldout.max() <= 1e-14 * abs(value)
    # Beside another one, which is learned as if it were not there.
    both = fitted(x, np.hstack((y[:, :1], constant)), hidden=(5,), epochs=3)
    first, second = both.network.arrays(tuple(x.T))
    np.testing.assert_allclose(second, value, rtol=1e-14, atol=0.0)
    assert np.std(first) > 0.0
    assert both.epochs == 3


def test_training_stops_at_the_weights_of_the_least_validation_loss():
    # Noise cannot be learned: the loss of other rows soon rises.
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(100, 2)), rng.normal(size=(100, 1))
    trained = fitted(x, y, hidden=(20,), rate=0.01, batch=10, epochs=2000)
    assert 60 < trained.epochs < 1000
    validation = random_stream(0, Purpose.TRAINING).permutation(100)[70:85]
    predicted = trained.network.arrays(tuple(x[validation].T))[0]
    loss = np.mean((predicted - y[validation, 0]) ** 2) / trained.network.output_scale[0] ** 2
    # The loss was computed in single precision.
    assert loss == pytest.approx(trained.validation_loss, rel=1e-5)


@pytest.mark.parametrize(
    ("inputs", "targets"),
    [
        (data(9)[0], data(9)[1]),
        *((data(20)[0], data(20)[1] + spoil * np.eye(20, 2, -3)) for spoil in (np.nan, 1e200)),
        (data(20)[0][:, 0], data(20)[1]),
        (data(20)[0], data(20)[1][:10]),
        (data(20)[0][:, :0], data(20)[1]),
        (data(20)[0], data(20)[1][:, :0]),
    ],
)
def test_bad_data_are_refused(inputs, targets):
    with pytest.raises(InvalidInputError):
        fitted(inputs, targets, epochs=1)


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ({"epochs": 0}, "epochs"),
        ({"hidden": (5, 0)}, "hidden"),
        ({"hidden": [10**11]}, "parameters"),
        ({"rate": 0.0}, "rate"),
        ({"seed": -1}, "seed"),
        ({"activation": "gelu"}, "gelu"),
    ],
)
def test_bad_settings_are_refused(setting, told):
    with pytest.raises(ConfigurationError, match=told):
        fitted(*data(20), **{"epochs": 1, **setting})


# Compiled.

STATES = sp.symbols("position angle speed", real=True)
COORDINATES = (STATES[0] * STATES[2], sp.sin(STATES[1]), sp.cos(STATES[1]) + STATES[2])
POINTS = np.random.default_rng(0).normal(size=(40, 3))


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


@pytest.mark.parametrize("hidden", [(), (3, 7, 4)])
@pytest.mark.parametrize("activation", ["identity", "tanh", "relu", "leaky_relu", "elu", "silu"])
def test_networks(activation, hidden):
    network, data = random_network(activation, (3, *hidden, 2)), Data()
    data.add([1.0, 2.0])
    found = values_of(network_source(network, "found", data), data)
    assert_close(found, network.outputs(POINTS))
    assert np.ptp(found, axis=0).min() > 1e-3


@pytest.mark.parametrize("hidden", [(), (3, 7, 4)])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_slopes(activation, hidden):
    network, data = random_network(activation, (3, *hidden, 2)), Data()
    found = values_of(slopes_source(network, "found", data, 1), data)
    expected = [network.values_and_slopes_floats(x, 1)[1] for x in POINTS.tolist()]
    assert_close(found, expected)
    assert np.abs(found).max(axis=0).min() > 1e-3


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_gives_nan(bad):
    network, data = random_network("tanh", (3, 6, 5, 1)), Data()
    points = np.array([[0.1, bad, 0.2]])
    assert np.isnan(values_of(network_source(network, "found", data), data, points)).all()
    data = Data()
    assert np.isnan(values_of(slopes_source(network, "found", data, 0), data, points)).all()


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("kind", ["residual", "generator"])
def test_terms(kind, degree):
    if kind == "residual":
        network = random_network("relu", (3, 6, 5, degree + 2))
        terms = LearnedResidual(STATES, COORDINATES, degree, network, np.ones((9, degree + 2)))
    else:
        networks = tuple(random_network("tanh", (3, 4 + j, 1)) for j in range(degree))
        terms = LearnedGenerator(STATES, COORDINATES, networks)
    data = Data()
    found = values_of(terms_source(terms, "found", data), data)
    assert found.shape == (len(POINTS), len(terms.symbols))
    assert_close(found.T, terms.arrays(tuple(POINTS.T)))
    assert_close(found[0], terms.floats(tuple(POINTS[0])))


# Features, for regression in place of networks.


@pytest.mark.parametrize("name", ["CubicSDE", "StochasticDubins"])
def test_the_number_of_features_is_known_before_they_are(name):
    problem = problem_of(f"safe_envs/{name}-v0")
    for degree in range(3):
        features = Features.of(problem, degree)
        assert features.count == len(features.expressions)
        assert Features.allowed(problem, degree)


@pytest.mark.parametrize(
    ("name", "degree", "told"),
    [
        ("CubicSDE", 300, "degree = 300 makes 45451"),
        ("QuadrotorLimits", 3, "degree = 3 makes 546"),
        ("CubicSDE", -1, "diffusion_degree = -1"),
    ],
)
def test_too_many_features_are_refused(name, degree, told):
    problem = problem_of(f"safe_envs/{name}-v0")
    with pytest.raises(ConfigurationError, match=told):
        Features.of(problem, degree, *(["diffusion_degree"] if degree < 0 else []))
    assert degree < 0 or not Features.allowed(problem, degree)
