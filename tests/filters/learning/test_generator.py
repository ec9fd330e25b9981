"""Learned generators against the exact ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import derivatives, generator, lie_derivative_f, lie_derivative_g
from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning.collection import collect
from safe_envs.filters.learning.data import LearnedFileError, Transitions, load
from safe_envs.filters.learning.generator import learn_generator
from safe_envs.filters.learning.models.generator import GeneratorModel
from safe_envs.problem.problem import Barrier
from safe_envs.systems.pendulum import pendulum
from tests.conftest import problem_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def first_order(top):
    return learn_generator(top, points=100, repetitions=1000)


@pytest.fixture(scope="module")
def recursion(gap):
    return learn_generator(gap, points=150, repetitions=500, way="network")


@pytest.fixture(scope="module")
def direct(gap):
    return learn_generator(gap, points=300, repetitions=1000)


def states_in(problem, count=300):
    x = np.random.default_rng(9).uniform(
        *np.array(problem.sampling_domain.region).T, (count, problem.plant.n)
    )
    return x[
        np.broadcast_to(
            compile_function(problem.plant.states, [problem.barriers[0].expression], "arrays")(
                *x.T
            )[0],
            count,
        )
        > 0
    ]


def at(problem, system, expression, x):
    return np.broadcast_to(
        compile_function(problem.plant.states, [system.numeric(expression)], "arrays")(*x.T)[0],
        len(x),
    )


def limit(problem, system, x):
    """Acceleration -b/(a M) at which the row a u + b >= 0 of the second order has its edge, in
    m/s^2."""
    first, second = derivatives(system, problem.barriers[0].expression, 2, generator)[1:]
    coefficient = lie_derivative_g(system, first)[0, 0]
    return -at(problem, system, second, x) / at(problem, system, coefficient, x) / 1650


def learned_limit(problem, model, x):
    """The same with the terms of the recursion."""
    system, terms = problem.model, model.generators[0].arrays(tuple(np.ascontiguousarray(x.T)))
    first, second = derivatives(system, problem.barriers[0].expression, 2, lie_derivative_f)[1:]
    g = [float(e) for e in system.numeric(system.input_matrix)]
    coefficient = at(problem, system, lie_derivative_g(system, first)[0, 0], x) + sum(
        t * e for t, e in zip(terms[1:], g, strict=True)
    )
    return -(at(problem, system, second, x) + terms[0]) / coefficient / 1650


def test_the_default_way_hangs_on_the_relative_degree(first_order, direct):
    assert first_order.generators[0].degree == 1
    assert first_order.diffusion is None
    assert not direct.generators
    assert direct.record.settings["way"] == "direct"


def test_first_order_is_learned(top, first_order):
    ((truth, estimate),) = first_order.compare(top, states_in(top)).values()
    # Labels have 4.5 % of noise; the network adds its own error where the ellipse ends.
    assert np.sqrt(np.mean((estimate - truth) ** 2)) < 0.1 * np.sqrt(np.mean(truth**2))
    assert first_order.record.errors["M_1(h)"] < 0.1 * np.abs(truth).max()
    assert first_order.record.errors["M_1(h), standard error of labels"] < 0.1 * np.abs(truth).max()


def test_recursion_is_the_second_order_generator(gap, recursion):
    x = states_in(gap)
    ((truth, estimate),) = recursion.compare(gap, x).values()
    # M_2 goes with the second differences of a network that was fitted to 500 transitions from each
    # of 150 points: 7 to 15 %.
    assert np.sqrt(np.mean((estimate - truth) ** 2)) < 0.2 * np.sqrt(np.mean(truth**2))
    assert np.median(np.abs(learned_limit(gap, recursion, x) - limit(gap, gap.plant, x))) < 0.05


def test_direct_is_the_second_order_generator(gap, direct):
    x = states_in(gap)
    error = limit(gap, direct.diffusion.system(gap.model), x) - limit(gap, gap.plant, x)
    assert np.median(np.abs(error)) < 0.01
    # A constant from 300 times 1000 squares has a relative deviation of .26 %.
    for name, (truth, estimate) in direct.compare(gap, x).items():
        assert np.abs(estimate - truth).max() < 5 * 0.0026 * 0.25, name


def test_the_models_own_noise_is_not_looked_at(gap):
    blind = gap.configured(model={"sigma_1": 0.0, "sigma_2": 0.0})
    one, other = (learn_generator(p, points=30, repetitions=50).diffusion for p in (gap, blind))
    assert one.covariance == other.covariance


def test_slopes_are_derivatives(gap, recursion):
    terms, x, step = recursion.generators[0], states_in(gap, 40), 1e-4
    first = replace(terms, networks=terms.networks[:1])
    for i, slope in enumerate(terms.arrays(tuple(x.T))[1:]):
        ahead, behind = x.copy(), x.copy()
        ahead[:, i] += step
        behind[:, i] -= step
        difference = (first.arrays(tuple(ahead.T))[0] - first.arrays(tuple(behind.T))[0]) / (
            2 * step
        )
        np.testing.assert_allclose(slope, difference, rtol=1e-4, atol=1e-5 * np.abs(slope).max())


def test_angles_go_through_the_chain_rule():
    problem = problem_of("safe_envs/StochasticDubins-v0")
    model = learn_generator(problem, points=40, repetitions=50, way="network")
    terms, x = model.generators[0], states_in(problem, 30)
    assert len(terms.coordinates) > problem.plant.n
    turned = x + np.array([0.0, 0.0, 2 * np.pi])
    for a, b in zip(terms.arrays(tuple(x.T)), terms.arrays(tuple(turned.T)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(a).max())


def test_every_barrier_has_its_generator():
    problem = problem_of("safe_envs/Pendulum-v0")
    problem = replace(
        problem,
        barriers=(*problem.barriers, replace(pendulum(level=0.1).barriers[0], name="inner")),
    )
    model = learn_generator(problem, points=30, repetitions=30)
    assert list(model.compare(problem, states_in(problem))) == ["M_1(h)", "M_1(inner)"]
    assert len(model.generators) == 2


def test_noise_that_adds_nothing_to_a_barrier_is_learned_as_nothing():
    scalar = problem_of("safe_envs/Scalar-v0")
    (x,) = scalar.plant.states
    model = learn_generator(
        replace(scalar, barriers=(Barrier(x),)), points=20, repetitions=20, way="network"
    )
    (generator_of_x,) = model.generators
    assert not np.any(generator_of_x.arrays((np.linspace(-3.0, 3.0, 50),)))
    assert set(model.record.errors.values()) == {0.0}


def test_only_noise_may_differ_from_what_was_learned_of(top, gap, first_order, direct, tmp_path):
    first_order.save(tmp_path / "model.npz")
    believed = top.configured(model={"sigma": 0.0})
    assert (
        GeneratorModel.from_content(load(tmp_path / "model.npz"), believed).sha256
        == first_order.sha256
    )
    for other in (top.configured(model={"l": 0.6}), pendulum(level=0.1), gap):
        with pytest.raises(LearnedFileError, match="another problem"):
            GeneratorModel.check(first_order.signature, other)
    GeneratorModel.check(direct.signature, problem_of("safe_envs/ACCGap-v0", barrier={"power": 1}))
    with pytest.raises(LearnedFileError, match="another problem"):
        GeneratorModel.check(direct.signature, gap.configured(model={"M": 1500.0}))


def test_other_coordinates_are_refused(top, first_order, tmp_path):
    first_order.save(tmp_path / "model.npz")
    coordinates = tuple(2 * s for s in top.plant.states)
    other = replace(top, sampling=replace(top.sampling, coordinates=coordinates))
    with pytest.raises(LearnedFileError, match="coordinates"):
        GeneratorModel.from_content(load(tmp_path / "model.npz"), other)


def test_a_passive_log_is_learned_directly(top):
    log = collect(top, 50, 1, steps=20, seed=6)
    model = learn_generator(top, data=log)
    assert model.diffusion is not None
    assert model.record.transitions == log.count
    forced = learn_generator(top, data=collect(top, 50, 1, seed=6), way="network")
    assert list(forced.record.errors) == ["M_1(h)"]


def test_equal_seeds_learn_equal_models(top):
    told = []
    one, other, third = (
        learn_generator(top, points=30, repetitions=30, seed=seed, progress=told.append)
        for seed in (1, 1, 2)
    )
    x = tuple(states_in(top).T)
    np.testing.assert_array_equal(one.generators[0].arrays(x), other.generators[0].arrays(x))
    assert (one.generators[0].arrays(x)[0] != third.generators[0].arrays(x)[0]).any()
    assert told[-1] == 1.0


def test_a_mismatch_is_told_and_has_no_second_order_truth():
    problem = problem_of("safe_envs/ACCGap-v0", plant={"M": 1000.0, "v_f": 18.0})
    model = learn_generator(problem, points=50, repetitions=200)
    assert "standard errors away" in model.record.warnings[0]
    forced = learn_generator(problem, points=30, repetitions=20, way="network")
    with pytest.raises(ConfigurationError, match="no true M_2"):
        forced.compare(problem, states_in(problem))


@pytest.mark.parametrize(
    ("arguments", "error", "told"),
    [
        ({"way": "guess"}, ConfigurationError, "network, direct"),
        ({"estimator": "mean"}, ConfigurationError, "martingale"),
        ({"problem": "safe_envs/Pendulum-v0"}, ConfigurationError, "SafetyProblem"),
        ({"data": np.zeros((3, 2))}, ConfigurationError, "data = "),
        (
            {"data": collect(problem_of("safe_envs/ACCGap-v0"), 5)},
            LearnedFileError,
            "another problem",
        ),
    ],
)
def test_what_cannot_be_learned_from_is_refused(top, arguments, error, told):
    with pytest.raises(error, match=told):
        learn_generator(**{"problem": top, **arguments})


def test_no_noise_is_told(top):
    model = learn_generator(top.configured(noise=0.0), points=20, repetitions=5, way="direct")
    assert model.record.warnings == ("the data show no noise, and none was learned",)


def test_the_plant_is_that_of_the_data(top):
    other = top.configured(plant={"l": 0.6})
    model = learn_generator(top, data=collect(other, 30, 5), way="direct")
    assert model.signature.differences(top) == ("l = 0.6 (here 0.7)",)
    log = collect(top, 30)
    model = learn_generator(
        top, data=Transitions.from_log(top, log.x, log.u, log.successors[:, 0], log.dt)
    )
    assert model.signature.plant == ()
