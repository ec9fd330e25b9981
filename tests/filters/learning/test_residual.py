"""Residuals of derivatives: their labels, what is learned of them, and how well it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safe_envs.dynamics.codegen import compile_function
from safe_envs.dynamics.lie import lie_derivative_f, lie_derivative_g
from safe_envs.errors import ConfigurationError
from safe_envs.filters.learning.collection import collect_paths, draw_states, plant_step
from safe_envs.filters.learning.data import LearnedFileError, load
from safe_envs.filters.learning.models.base import Record
from safe_envs.filters.learning.models.residual import ResidualModel
from safe_envs.filters.learning.residual import learn_residual, residual_labels
from safe_envs.problem.problem import Barrier
from safe_envs.problem.starts import SamplingDomain
from tests.conftest import problem_of
from tests.wrappers.learned import values

pytestmark = pytest.mark.slow

_DT = 1e-3
_SMALL = {"states": 300, "hidden": (20,), "epochs": 20}


def exact_residuals(problem, barrier, degree, x):
    """Delta_1..Delta_r, Sigma at states (N, n), by expressions that are derived step by step."""
    found = []
    for system in (problem.plant, problem.model):
        chain = [barrier.expression]
        for _ in range(degree):
            chain.append(lie_derivative_f(system, chain[-1]))
        found.append(values(system, (*chain[1:], *lie_derivative_g(system, chain[-2])), x))
    return found[0] - found[1]


@pytest.fixture(scope="module")
def learned(disk):
    return learn_residual(disk, states=2000, epochs=120)


@pytest.mark.parametrize(
    "name", ["DubinsDisk", "QuadrotorAltitude", pytest.param("Quadrotor", marks=pytest.mark.oracle)]
)
def test_the_labels_are_the_exact_residuals(name):
    problem = problem_of(f"safe_envs/{name}-v0")
    x = draw_states(problem, 300, np.random.default_rng(1))
    ((labels, sizes),), transitions = residual_labels(problem, x, _DT)
    exact = exact_residuals(problem, problem.barriers[0], 2, x)
    # Derivative j errs by less than dt^(5 - j) h^(5), with h^(5) below (10/s)^(5 - j) times
    # derivative j in these systems, and by the rounding of h over dt^j; Sigma by the error of
    # derivative 2 over the range of an input, Delta_2 by that brought to u = 0.
    inputs = np.array(problem.sampling_domain.inputs)
    (h,) = compile_function(problem.plant.states, [problem.barriers[0].expression], "arrays")(
        *np.ascontiguousarray(x.T)
    )
    rounding = 1e-14 * np.abs(h).max() / _DT ** np.arange(1, 3)
    second = sizes[1] + np.abs(inputs).max(axis=0) @ sizes[2:]
    error = np.array([sizes[0], second]) * (10 * _DT) ** np.array([4, 3]) + rounding
    bound = np.hstack((error[0], 3 * error[1], error[1] / np.ptp(inputs, axis=0)))
    assert (np.abs(labels - exact).max(axis=0) < bound).all()
    assert (bound[2:] < 1e-3 * sizes[2:]).all()
    assert transitions == 300 * len(problem.sampling_domain.inputs) * 4


def test_halving_the_step_divides_the_error_by_what_the_order_says():
    problem = problem_of("safe_envs/QuadrotorAltitude-v0")
    x = draw_states(problem, 300, np.random.default_rng(1))
    exact = exact_residuals(problem, problem.barriers[0], 2, x)
    coarse, fine = (
        np.abs(residual_labels(problem, x, dt)[0][0][0] - exact).max(axis=0) for dt in (4e-3, 2e-3)
    )
    np.testing.assert_allclose(np.log2(coarse / fine), [4.0, 3.0, 3.0], atol=0.3)


def test_barriers_of_several_degrees_are_labelled_together():
    problem = problem_of("safe_envs/QuadrotorAltitude-v0")
    z, climb = problem.plant.states
    problem = replace(
        problem,
        barriers=(*problem.barriers, Barrier(25 - climb**2 + 0 * z, "speed")),
        gains=((1.0, 1.0), (1.0,)),
    )
    x = draw_states(problem, 100, np.random.default_rng(1))
    labels, _ = residual_labels(problem, x, _DT)
    for barrier, degree, (found, sizes) in zip(problem.barriers, (2, 1), labels, strict=True):
        assert found.shape == (100, degree + 1)
        assert (np.abs(found - exact_residuals(problem, barrier, degree, x)) < 1e-5 * sizes).all()


def test_the_printed_central_difference_gives_half_of_the_gain(disk):
    """Eq. (3.28): the sample before was reached under another input than the one whose effect is
    asked for."""
    x = draw_states(disk, 200, np.random.default_rng(2))
    (h,) = (compile_function(disk.plant.states, [disk.barriers[0].expression], "arrays"),)
    before, first, second = 0.0, -1.5, 1.5

    def run(states, input_, dt):
        return collect_paths(disk, states, np.full((200, 1), input_), 1, dt)[:, 1]

    gain = exact_residuals(
        replace(disk, model=disk.model.with_parameters(v=1e-9)), disk.barriers[0], 2, x
    )[:, 2]
    for dt in (1e-2, 1e-3):
        here = run(x, before, dt)
        rates = []
        for u in (first, second):
            path = (x, here, run(here, u, dt))
            samples = [h(*np.ascontiguousarray(p.T))[0] for p in path]
            rates.append((samples[2] - 2 * samples[1] + samples[0]) / dt**2)
        printed = (rates[1] - rates[0]) / (second - first)
        assert np.polyfit(gain, printed, 1)[0] == pytest.approx(0.5, abs=0.02)
    ((labels, _),), _ = residual_labels(disk, x, _DT)
    model_gain = gain - exact_residuals(disk, disk.barriers[0], 2, x)[:, 2]
    assert np.polyfit(gain, model_gain + labels[:, 2], 1)[0] == pytest.approx(1.0, abs=1e-6)


def test_the_residuals_are_learned(disk, learned):
    x = draw_states(disk, 1000, np.random.default_rng(77))
    compared = learned.compare(disk, x)
    assert list(compared) == ["h Delta_1", "h Delta_2", "h Sigma_omega"]
    exact = exact_residuals(disk, disk.barriers[0], 2, x)
    for (truth, estimate), column in zip(compared.values(), exact.T, strict=True):
        np.testing.assert_allclose(truth, column, atol=1e-12)
        assert np.sqrt(np.mean((estimate - truth) ** 2)) < 0.05 * np.sqrt(np.mean(truth**2))


def test_the_quantiles_cover_fresh_states(disk, learned):
    x = draw_states(disk, 3000, np.random.default_rng(78))
    eps = learned.parts[0].eps(0.9)
    for bound, (truth, estimate) in zip(eps, learned.compare(disk, x).values(), strict=True):
        assert (np.abs(truth - estimate) <= bound).mean() == pytest.approx(0.9, abs=0.06)
    for level in (-0.1, 1.1, np.nan):
        with pytest.raises(ConfigurationError, match="level"):
            learned.parts[0].eps(level)


def test_a_model_of_something_else_is_refused(tmp_path, disk, learned):
    path = tmp_path / "residual.npz"
    learned.save(path)
    content = load(path)
    others = (
        disk.configured(model={"v": 0.6}),
        problem_of("safe_envs/DubinsDisk-v0", barrier={"radius": 2.0}),
        replace(disk, sampling=replace(disk.sampling_domain, coordinates=disk.plant.states)),
    )
    for other in others:
        with pytest.raises(LearnedFileError):
            ResidualModel.from_content(content, other)
    # The plant may be another one: what was learned is asked for its error there.
    ResidualModel.from_content(content, disk.configured(plant={"v": 0.9}))
    for arrays in ({}, {**content.arrays, "part_0_heldout": np.zeros((5, 2))}):
        with pytest.raises(LearnedFileError, match="incomplete"):
            ResidualModel.from_content(replace(content, arrays=arrays), disk)


def test_the_same_seed_learns_the_same(disk):
    first, second, other = (learn_residual(disk, **_SMALL, seed=seed) for seed in (3, 3, 4))
    assert all(np.array_equal(a, second.arrays()[name]) for name, a in first.arrays().items())
    assert not np.array_equal(
        first.arrays()["part_0_weights_0"], other.arrays()["part_0_weights_0"]
    )


def test_a_step_of_ones_own_takes_the_place_of_the_plant(disk):
    faster = disk.configured(plant={"v": 1.1})
    x = draw_states(disk, 100, np.random.default_rng(6))
    ((found, _),), _ = residual_labels(disk, x, _DT, step=plant_step(faster, _DT))
    np.testing.assert_allclose(found, exact_residuals(faster, disk.barriers[0], 2, x), atol=1e-5)


def test_each_barrier_has_its_residuals(disk):
    twice = replace(
        disk,
        barriers=(disk.barriers[0], Barrier(2 * disk.barriers[0].expression, "twice")),
        gains=((1.0, 2.0), (1.0, 2.0)),
    )
    told = []
    model = learn_residual(twice, **_SMALL, progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert len(model.parts) == 2
    assert "twice Delta_2 rms" in model.record.errors
    again = ResidualModel.restored(twice, Record(0, 0.0, 0.0), model.details(), model.arrays())
    assert np.array_equal(again.parts[1].heldout, model.parts[1].heldout)


QUADROTOR = problem_of("safe_envs/Quadrotor-v0")
ONE = ((1.0,),)


@pytest.mark.parametrize(
    ("changes", "setting", "told"),
    [
        ({}, {"states": 5}, "states = 5"),
        ({}, {"label_dt": 0.0}, "label_dt"),
        ({}, {"label_dt": 1e-300}, "label_dt"),
        ({}, {"label_dt": 6.0}, "label_dt"),
        ({"noise": 0.1}, {}, "noise=0"),
        ({"inputs": ONE}, {}, "apart"),
        ({"inputs": ONE * 2}, {}, "apart"),
        ({"problem": QUADROTOR, "inputs": QUADROTOR.sampling_domain.inputs[:4]}, {}, "apart"),
        ({"input_matrix": [0.1, 0, 1]}, {}, "derivative 1 of barrier h"),
    ],
)
def test_what_cannot_be_learned_is_refused(disk, changes, setting, told):
    problem = changes.get("problem", disk)
    if "noise" in changes:
        problem = problem.configured(noise=changes["noise"])
        with pytest.raises(ConfigurationError, match="noise of the plant"):
            learn_residual(problem, **_SMALL, step=plant_step(problem, _DT))
    if "inputs" in changes:
        domain = problem.sampling_domain
        domain = SamplingDomain(domain.region, changes["inputs"], domain.coordinates)
        problem = replace(problem, sampling=domain)
    if "input_matrix" in changes:
        plant = replace(problem.plant, input_matrix=changes["input_matrix"])
        problem = replace(problem, plant=plant)
    with pytest.raises(ConfigurationError, match=told):
        learn_residual(problem, **{**_SMALL, **setting})


def test_the_level_is_that_of_split_conformal_prediction(learned):
    part = replace(learned.parts[0], heldout=np.arange(1.0, 20.0)[::-1, None] * [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(part.eps(0.95), [19.0, 38.0, 57.0])
    np.testing.assert_array_equal(part.eps(0.9), [18.0, 36.0, 54.0])
    np.testing.assert_array_equal(part.eps(0.01), part.eps(0.0))
    with pytest.raises(ConfigurationError, match=r"0\.99 is more than 19 .* 534 more .* 0\.95$"):
        part.eps(0.99)
    with pytest.raises(ConfigurationError, match=r"up to 0\.95: no number of states"):
        part.eps(1.0)


def test_the_quantile_covers_a_fresh_error_as_often_as_it_says(learned):
    """On average over held-out sets, however few: here 19 errors, of which the empirical quantile
    would cover less."""
    rng = np.random.default_rng(0)
    covered = []
    for _ in range(2000):
        errors = rng.exponential(size=(20, 3))
        covered.append(errors[0] <= replace(learned.parts[0], heldout=errors[1:]).eps(0.9))
    assert abs(np.mean(covered) - 0.9) < 5 * 0.3 / 6000**0.5


def test_a_plant_of_somebody_else_is_not_known(disk, learned):
    assert learned.signature.differences(disk.configured(plant={"v": 0.5})) != ()
    assert learn_residual(disk, **_SMALL, step=plant_step(disk, _DT)).signature.plant == ()
