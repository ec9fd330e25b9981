"""One-step data: which are collected, which are accepted, and how they are divided and kept."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs.errors import ConfigurationError, InvalidInputError, NumericalError
from safe_envs.filters.learning import collection as module
from safe_envs.filters.learning.checks import Purpose, random_stream
from safe_envs.filters.learning.collection import (
    collect,
    collect_paths,
    draw_states,
    env_step,
    plant_step,
)
from safe_envs.filters.learning.data import LearnedFileError, Signature, Transitions, save
from safe_envs.problem.problem import Barrier
from safe_envs.problem.starts import SamplingDomain
from safe_envs.registry import make_problem

DISK = make_problem("safe_envs/CubicSDEDisk-v0")
SIGNATURE = Signature.of(DISK)
ONE = {"u": np.zeros((1, 1)), "successors": np.zeros((1, 1, 2)), "dt": np.ones(1)}
SMOOTH = make_problem("safe_envs/CubicSDEDisk-v0", noise=0.0)


def rates(x, u):
    """dx/dt of the cubic system, without noise."""
    return np.stack([-0.6 * x[:, 0] - x[:, 1], x[:, 0] ** 3 + x[:, 1] * u[:, 0]], axis=1)


def shifted(x, u, rng):
    """A step that adds the input to every state."""
    return x + 0.01 * u


def at_rest(x, u, rng):
    return x.copy()


def test_every_input_is_tried_at_every_state():
    data = collect(DISK, 4, repetitions=3, inputs=[(-1.0,), (0.0,), (2.0,)], seed=1)
    assert (data.x.shape, data.u.shape, data.successors.shape, data.dt.shape) == (
        (12, 2),
        (12, 1),
        (12, 3, 2),
        (12,),
    )
    np.testing.assert_array_equal(data.u[:, 0], [-1.0, 0.0, 2.0] * 4)
    np.testing.assert_array_equal(data.x, np.repeat(data.x[::3], 3, axis=0))
    assert len(np.unique(data.x, axis=0)) == 4
    assert (data.dt == DISK.dt).all()
    assert data.seed == 1
    # No noise is used twice.
    assert len(np.unique(data.successors.reshape(-1, 2), axis=0)) == 36
    # Without inputs those of the exploration are tried.
    np.testing.assert_array_equal(collect(DISK, 2).u, np.tile(DISK.sampling_domain.inputs, (2, 1)))


@pytest.mark.parametrize("steps", [1, 5])
def test_the_seed_is_all_the_randomness(steps):
    one, same, other = (
        collect(DISK, 6, repetitions=2, steps=steps, seed=seed) for seed in (4, 4, 5)
    )
    np.testing.assert_array_equal(one.successors, same.successors)
    np.testing.assert_array_equal(one.x, same.x)
    assert not np.isin(one.x, other.x).any()
    assert not np.isin(one.successors, other.successors).any()
    # Nor do the states at the start depend on the repetitions.
    more = collect(DISK, 6, repetitions=7, steps=steps, seed=4)
    np.testing.assert_array_equal(one.x[:6], more.x[:6])


@pytest.mark.parametrize("at_once", [1, 4])
def test_parts_make_the_whole(monkeypatch, at_once):
    whole = collect(SMOOTH, 5, repetitions=3, steps=2, seed=2)
    monkeypatch.setattr(module, "_AT_ONCE", at_once)
    sizes = []
    step = plant_step(SMOOTH)

    def counted(x, u, rng):
        sizes.append(len(x))
        return step(x, u, rng)

    parts = collect(SMOOTH, 5, repetitions=3, steps=2, seed=2, step=counted)
    np.testing.assert_array_equal(parts.successors, whole.successors)
    assert max(sizes) <= at_once
    assert sum(sizes) == whole.count


def test_successors_have_the_mean_and_the_variance_of_euler_maruyama():
    repetitions = 40_000
    data = collect(DISK, 5, repetitions=repetitions, inputs=[(-2.0,), (3.0,)], seed=7)
    moved = (data.successors - data.x[:, None]) / DISK.dt
    deviation = 0.2 / math.sqrt(DISK.dt)
    assert abs(moved.mean(axis=1) - rates(data.x, data.u)).max() < 5 * deviation / math.sqrt(
        repetitions
    )
    variance = moved.var(axis=1)
    assert abs(variance / deviation**2 - 1).max() < 5 * math.sqrt(2 / repetitions)
    covariance = ((moved - moved.mean(axis=1, keepdims=True)).prod(axis=2)).mean(axis=1)
    assert abs(covariance).max() < 5 * deviation**2 / math.sqrt(repetitions)


def test_dt_is_that_of_the_step():
    data = collect(SMOOTH, 3, dt=1e-4)
    assert (data.dt == 1e-4).all()
    np.testing.assert_allclose(
        (data.successors[:, 0] - data.x) / 1e-4, rates(data.x, data.u), atol=1e-3
    )
    assert data.signature.dt == SMOOTH.dt


def test_all_data_are_from_where_a_problem_is_explored(env_id):
    problem = make_problem(env_id)
    data = collect(problem, 5, steps=20)
    low, high = np.array(problem.sampling_domain.region).T
    assert ((low <= data.x) & (data.x <= high)).all()
    barriers = sp.lambdify(problem.plant.states, [b.expression for b in problem.barriers], "numpy")
    assert all((np.asarray(h) > 0).all() for h in barriers(*data.x.T))


def test_states_are_drawn_uniformly():
    states = draw_states(DISK, 20_000, np.random.default_rng(0))
    assert states.shape == (20_000, 2)
    # Of a disk: r^2 is uniform, and so is the angle.
    for uniform in ((states**2).sum(axis=1), np.arctan2(*states.T) / (2 * math.pi) + 0.5):
        assert np.histogram(uniform, bins=10, range=(0.0, 1.0))[0] == pytest.approx(
            [2000] * 10, abs=220
        )


def test_trajectories_go_on_with_what_was_reached():
    count, steps = 40, 30
    data = collect(DISK, count, repetitions=2, steps=steps, inputs=[(-10.0,), (10.0,)], seed=1)
    x = data.x.reshape(steps, count, 2, 2)
    reached = data.successors[:, 0].reshape(steps, count, 2, 2)
    np.testing.assert_array_equal(x[:, :, 0], x[:, :, 1])
    continued = (x[1:, :, 0, None] == reached[:-1]).all(axis=-1)
    under = continued.any(axis=-1)
    assert under.mean() > 0.9
    # Both inputs are followed.
    assert continued[..., 0].sum() == pytest.approx(continued[..., 1].sum(), rel=0.15)
    # Where a trajectory starts anew, one of the states that it might have gone to was outside.
    outside = (reached[:-1] ** 2).sum(axis=-1) >= 1.0
    assert not under.all()
    assert outside.any(axis=-1)[~under].all()


def test_a_step_of_ones_own():
    data = collect(DISK, 3, repetitions=2, step=shifted, dt=0.5)
    np.testing.assert_array_equal(
        data.successors, np.repeat((data.x + 0.01 * data.u)[:, None], 2, axis=1)
    )
    assert (data.dt == 0.5).all()


@pytest.mark.parametrize(
    ("arguments", "error", "told"),
    [
        ({"points": 0}, ConfigurationError, "points = 0"),
        ({"repetitions": 0}, ConfigurationError, "repetitions = 0"),
        ({"seed": -1}, ConfigurationError, "seed = -1"),
        ({"dt": 0.0}, ConfigurationError, r"dt = 0\.0 s"),
        ({"points": 10**9, "repetitions": 100}, ConfigurationError, "1000000000 points"),
        ({"inputs": [(10.5,)]}, ConfigurationError, r"\[10\.5\] is outside the bounds"),
        ({"inputs": [(math.nan,)]}, ConfigurationError, "outside the bounds"),
        ({"inputs": [(1.0, 1.0)]}, ConfigurationError, "vectors of 1 numbers"),
        ({"inputs": []}, ConfigurationError, "vectors"),
        ({"step": lambda x, u, rng: x[0]}, InvalidInputError, r"\(4, 2\) returned \(2,\)"),
        ({"step": at_rest, "inputs": [(1.0,)] * 2}, InvalidInputError, "rows 0 and 1"),
        ({"step": lambda x, u, rng: x + np.inf}, NumericalError, r"u = .* led to \[inf inf\]"),
        ({"problem": "safe_envs/Pendulum-v0"}, ConfigurationError, "problem = "),
        (
            {"problem": replace(DISK, barriers=(Barrier(-1 - DISK.plant.states[0] ** 2),))},
            ConfigurationError,
            "only 0 of",
        ),
    ],
)
def test_what_cannot_be_collected_is_refused(arguments, error, told):
    with pytest.raises(error, match=told):
        collect(**{"problem": DISK, "points": 2, **arguments})


def test_an_undefined_barrier_is_not_explored():
    x_1 = DISK.plant.states[0]
    assert (
        draw_states(
            replace(DISK, barriers=(Barrier(sp.log(x_1) + 10),)), 50, np.random.default_rng(0)
        )[:, 0]
        > 0
    ).all()


def test_a_plant_that_is_singular_is_named():
    x_1 = DISK.plant.states[0]
    plant = replace(SMOOTH.plant, drift=[1 / (x_1 - x_1**2 * 0 - 1), 0])
    region = SamplingDomain(region=((1.0, 1.0 + 1e-15), (-1.0, 1.0)))
    singular = replace(SMOOTH, plant=plant, barriers=(Barrier(sp.Integer(1)),), sampling=region)
    with pytest.raises(NumericalError, match="give a smaller dt"):
        collect(singular, 200)


def test_paths_hold_their_inputs():
    states, inputs = (
        np.array([[0.1, 0.2], [0.3, -0.2], [0.0, 0.0]]),
        np.array([[1.0], [-2.0], [0.0]]),
    )
    paths = collect_paths(SMOOTH, states, inputs, 50, 0.002)
    assert paths.shape == (3, 51, 2)
    np.testing.assert_array_equal(paths[:, 0], states)
    np.testing.assert_allclose(
        (paths[:, 1] - paths[:, 0]) / 0.002, rates(states, inputs), atol=1e-3
    )
    # RK4: half the step leads to the same places.
    np.testing.assert_allclose(
        collect_paths(SMOOTH, states, inputs, 100, 0.001)[:, ::2], paths, atol=1e-11
    )
    np.testing.assert_array_equal(paths[2], np.zeros((51, 2)))


def test_noise_of_paths_is_of_their_seed():
    states, inputs = [[0.1, 0.2]] * 2, [[1.0]] * 2
    one, same, other = (
        collect_paths(DISK, states, inputs, 5, 0.01, seed=seed) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert not (one[:, 1:] == other[:, 1:]).any()
    assert not (one[0, 1:] == one[1, 1:]).any()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"steps": 0}, ConfigurationError, "steps = 0"),
        ({"inputs": [[11.0]]}, ConfigurationError, "outside the bounds"),
        ({"states": [0.1, 0.2]}, InvalidInputError, r"shape \(2,\); give \(1, 2\)"),
        ({"states": [[0.1, 0.2]] * 2}, InvalidInputError, "a row for each of the inputs"),
        ({"states": [[0.1, math.nan]]}, InvalidInputError, "finite"),
        ({"states": [[0.1], [0.1, 0.2]]}, InvalidInputError, "states is no array of numbers"),
        ({"steps": 10**12}, ConfigurationError, "1000000000000 steps"),
    ],
)
def test_paths_that_are_not_allowed(arguments, error, message):
    with pytest.raises(error, match=message):
        collect_paths(
            DISK, **{"states": [[0.1, 0.2]], "inputs": [[1.0]], "steps": 2, "dt": 0.01, **arguments}
        )


@pytest.fixture
def pendulum():
    """Gymnasium's pendulum, as an env of somebody else, with its state set and read."""
    env = gym.make("Pendulum-v1")
    yield env, lambda e, x: setattr(e.unwrapped, "state", x), lambda e: e.unwrapped.state
    env.close()


def test_an_env_of_somebody_else_moves_as_it_does(pendulum):
    step = env_step(*pendulum)
    x, u = np.array([[0.1, 0.0], [2.0, -1.0], [-1.0, 0.5]]), np.array([[0.0], [1.0], [-2.0]])
    before = x.copy()
    speed = x[:, 1] + (15.0 * np.sin(x[:, 0]) + 3.0 * u[:, 0]) * 0.05
    expected = np.stack([x[:, 0] + speed * 0.05, speed], axis=1)
    np.testing.assert_allclose(step(x, u, np.random.default_rng(0)), expected, atol=1e-12)
    np.testing.assert_array_equal(x, before)


def test_an_env_of_somebody_else_feeds_the_collector(pendulum):
    step = env_step(*pendulum, to_action=lambda u: (u / 10.0).astype(np.float32))
    settings = {"inputs": [(-1.0,), (1.0,)], "step": step, "dt": 0.05, "seed": 3}
    one, same = (collect(make_problem("Pendulum-v0"), 10, **settings) for _ in range(2))
    np.testing.assert_array_equal(one.successors, same.successors)
    expected = one.x[:, 1] + (15.0 * np.sin(one.x[:, 0]) + 0.3 * one.u[:, 0]) * 0.05
    np.testing.assert_allclose(one.successors[:, 0, 1], expected, atol=1e-7)


def test_noise_of_an_env_is_of_the_generator(pendulum):
    env, set_state, _ = pendulum
    step = env_step(env, set_state, lambda e: e.unwrapped.np_random.normal(size=2))
    x, u, rng = np.zeros((3, 2)), np.zeros((3, 1)), np.random.default_rng(0)
    one, going_on = step(x, u, rng), step(x, u, rng)
    assert not np.isin(one, going_on).any()
    np.testing.assert_array_equal(step(x, u, np.random.default_rng(0)), one)


def test_states_that_do_not_fit_into_memory_are_not_drawn():
    with pytest.raises(ConfigurationError, match="1000000000000 states"):
        draw_states(DISK, 10**12, np.random.default_rng(0))


def test_a_step_of_ones_own_may_be_that_of_any_plant():
    assert collect(DISK, 3).signature.plant == (("a", 0.6), ("sigma_1", 0.2), ("sigma_2", 0.2))
    assert collect(DISK, 3, step=shifted).signature.plant == ()


# As they are given.


def logged(**changes):
    """Three steps, each repeated twice."""
    data = {
        "x": [[0.0, 0.1], [0.2, 0.3], [0.4, 0.5]],
        "u": [[1.0], [-1.0], [1.0]],
        "successors": np.arange(12.0).reshape(3, 2, 2),
        "dt": 0.01,
    }
    return Transitions(SIGNATURE, **{**data, **changes})


def assert_same(one, other):
    for name in ("x", "u", "successors", "dt"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert (one.signature, one.seed) == (other.signature, other.seed)


def test_sizes_and_time():
    data = logged(dt=[0.01, 0.02, 0.03])
    assert (data.points, data.repetitions, data.count) == (3, 2, 6)
    assert data.observed == pytest.approx(0.12)
    assert data.x.dtype == data.u.dtype == data.successors.dtype == float
    np.testing.assert_array_equal(logged().dt, [0.01] * 3)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"x": [[0.0], [0.2], [0.4]]}, r"x \(3, 1\)"),
        ({"u": [[1.0], [1.0]]}, r"u \(2, 1\)"),
        ({"successors": np.ones((3, 2))}, r"successors \(3, 2\).*give .*\(P, K, 2\)"),
        ({"dt": [0.01, 0.01]}, r"dt \(2,\)"),
        (
            {"x": np.empty((0, 2)), "u": np.empty((0, 1)), "successors": np.empty((0, 2, 2))},
            "there are no data",
        ),
        ({"successors": np.empty((3, 0, 2))}, "there are no data"),
        ({"x": [[0.0, 0.1], [0.2]]}, "x is no array of numbers"),
        (
            {"x": np.ma.masked_greater([[0.0, 0.1], [0.2, 0.3], [0.4, 0.5]], 0.45)},
            "x has masked entries",
        ),
        (
            {"x": list(np.ma.masked_greater([[0.0, 0.1], [0.2, 0.3], [0.4, 0.5]], 0.45))},
            "x has masked entries",
        ),
        ({"u": np.array([[1.0], [1j], [1.0]])}, "u is complex; give real numbers"),
        ({"x": [[0.0, 0.1], [0.2, np.nan], [0.4, 0.5]]}, r"x\[1, 1\] = nan, one of 1 entries"),
        (
            {"successors": np.full((3, 2, 2), np.inf)},
            r"successors\[0, 0, 0\] = inf, one of 12 entries",
        ),
        ({"dt": 0.0}, r"dt\[0\] = 0.0 s; a step needs a positive duration"),
        ({"dt": [0.01, -0.01, 0.01]}, r"dt\[1\] = -0.01 s"),
    ],
)
def test_what_is_no_data_is_refused(changes, told):
    with pytest.raises(InvalidInputError, match=told):
        logged(**changes)


def test_copied_rows_are_refused():
    x, u, successors = (
        [[0.0, 0.1], [0.2, 0.3], [0.0, 0.1]],
        [[1.0]] * 3,
        np.arange(12.0).reshape(3, 2, 2),
    )
    successors[2] = successors[0]
    with pytest.raises(InvalidInputError, match=r"rows 0 and 2 are the same.*drop the copies"):
        logged(x=x, u=u, successors=successors)
    # Another input, another duration, or another second successor is another row.
    assert logged(x=x, successors=successors, u=[[1.0], [1.0], [-1.0]]).points == 3
    assert logged(x=x, successors=successors, u=u, dt=[0.01, 0.01, 0.02]).points == 3
    successors[2, 1, 1] += 1e-9
    assert logged(x=x, u=u, successors=successors).points == 3


def test_repetitions_may_agree_without_noise():
    assert logged(successors=np.repeat(np.arange(6.0).reshape(3, 1, 2), 4, axis=1)).repetitions == 4


def test_a_log_equals_collected_data():
    data = collect(DISK, 20, seed=3)
    log = Transitions.from_log(
        DISK, data.x.tolist(), data.u.tolist(), data.successors[:, 0].tolist(), DISK.dt
    )
    # Of which plant a log is, nobody knows.
    data = replace(data, seed=None, signature=replace(data.signature, plant=()))
    assert_same(data, log)
    assert_same(
        Transitions.from_log(SIGNATURE, data.x, data.u, data.successors[:, 0], data.dt), log
    )


def test_split_keeps_rows_of_one_state_together():
    data = collect(DISK, 30, repetitions=2, inputs=[(-1.0,), (0.0,), (1.0,)])
    rest, held = data.split(0.2, np.random.default_rng(0))
    assert (rest.points, held.points) == (24 * 3, 6 * 3)
    assert not {row.tobytes() for row in rest.x} & {row.tobytes() for row in held.x}
    # Nothing is lost, and what is left keeps its order.
    position = {row.tobytes(): i for i, row in enumerate(data.successors)}
    found = [[position[row.tobytes()] for row in part.successors] for part in (rest, held)]
    assert all(rows == sorted(rows) for rows in found)
    assert sorted(found[0] + found[1]) == list(range(90))
    assert_same(held, data.split(0.2, np.random.default_rng(0))[1])


def test_split_leaves_both_parts_something():
    two = collect(DISK, 2)
    for share in (1e-6, 1.0 - 1e-6):
        assert [part.points for part in two.split(share, np.random.default_rng(0))] == [2, 2]
    with pytest.raises(InvalidInputError, match="two states at least"):
        collect(DISK, 1).split(0.5, np.random.default_rng(0))
    with pytest.raises(ConfigurationError, match=r"share = 1\.0"):
        two.split(1.0, np.random.default_rng(0))


def test_saved_and_loaded(tmp_path):
    for kept in (collect(DISK, 5, repetitions=3, seed=8), logged()):
        kept.save(tmp_path / "data.npz")
        assert_same(Transitions.load(tmp_path / "data.npz"), kept)


@pytest.mark.parametrize(
    ("kind", "details", "arrays", "told"),
    [
        ("network", {}, {"x": np.zeros(2)}, "network"),
        ("transitions", {"seed": 0}, {"x": np.zeros((1, 2))}, "incomplete: 'u'"),
        ("transitions", {"seed": 0}, {"x": np.zeros((1, 3)), **ONE}, "shapes"),
        *(
            ("transitions", details, {"x": np.zeros((1, 2)), **ONE}, "incomplete")
            for details in ({}, {"seed": "x"}, {"seed": 1.5}, {"seed": -1}, {"seed": [1]})
        ),
    ],
)
def test_files_of_something_else_are_refused(kind, details, arrays, told, tmp_path):
    save(tmp_path / "data.npz", kind, SIGNATURE, details, arrays)
    with pytest.raises(LearnedFileError, match=told):
        Transitions.load(tmp_path / "data.npz")


LOG = ([[0.0, 0.1]], [[1.0]], [[0.1, 0.1]], 0.01)


@pytest.mark.parametrize(
    ("call", "error", "told"),
    [
        (lambda: logged(seed=-1), ConfigurationError, "seed = -1"),
        (lambda: Transitions.from_log(None, *LOG), ConfigurationError, "SafetyProblem"),
        (lambda: Transitions.from_log("Cubic", *LOG), ConfigurationError, "SafetyProblem"),
        (lambda: Transitions("Cubic", *LOG), ConfigurationError, "signature = "),
        (
            lambda: Transitions.from_log(DISK, logged().x, logged().u, logged().successors, 0.01),
            InvalidInputError,
            r"\(3, 2, 2\)",
        ),
        (lambda: logged().require(make_problem("Scalar-v0")), LearnedFileError, "CubicSDEDisk"),
    ],
)
def test_what_data_are_of_is_checked(call, error, told):
    logged().require(DISK)
    with pytest.raises(error, match=told):
        call()


# Their randomness.

_SEED = 7


def first_draws(rng):
    return tuple(rng.integers(2**63, size=4).tolist())


def test_no_two_uses_of_a_seed_share_their_randomness():
    """Among them those that NumPy makes the same: a seed, the same with a 0 behind it, and the
    children of either."""
    found = {"plain": np.random.default_rng(_SEED)}
    found |= {
        f"child {i}": np.random.default_rng(child)
        for i, child in enumerate(np.random.SeedSequence(_SEED).spawn(3))
    }
    found |= {f"small {i}": np.random.default_rng([_SEED, i]) for i in range(1, 10)}
    for purpose in Purpose:
        found[purpose.name] = random_stream(_SEED, purpose)
        found |= {
            f"{purpose.name} {i}": child
            for i, child in enumerate(random_stream(_SEED, purpose).spawn(2))
        }
    draws = {name: first_draws(rng) for name, rng in found.items()}
    for one, other in itertools.combinations(draws, 2):
        assert draws[one] != draws[other], (one, other)
    assert first_draws(random_stream(np.int64(_SEED), Purpose.DATA)) == draws["DATA"]
