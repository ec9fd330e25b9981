"""The collector: which states and inputs, in which order, and with what successors."""

from __future__ import annotations

import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import sympy as sp

from safe_envs import ENV_IDS
from safe_envs.errors import ConfigurationError, InvalidInputError, NumericalError
from safe_envs.filters.learning import collection as module
from safe_envs.filters.learning.collection import (
    collect,
    collect_paths,
    draw_states,
    env_step,
    plant_step,
)
from safe_envs.problem.problem import Barrier
from safe_envs.problem.starts import SamplingDomain
from safe_envs.registry import make_problem

DISK = make_problem("safe_envs/CubicSDEDisk-v0")
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


def test_inputs_of_the_exploration_are_the_default():
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


def test_start_states_do_not_depend_on_the_repetitions():
    np.testing.assert_array_equal(
        collect(DISK, 6, seed=4).x, collect(DISK, 6, repetitions=7, seed=4).x
    )


@pytest.mark.parametrize("at_once", [1, 4, 7])
def test_parts_make_the_whole(monkeypatch, at_once):
    def fill():
        return collect(SMOOTH, 5, repetitions=3, steps=2, seed=2)

    whole = fill()
    monkeypatch.setattr(module, "_AT_ONCE", at_once)
    sizes = []
    step = plant_step(SMOOTH)

    def counted(x, u, rng):
        sizes.append(len(x))
        return step(x, u, rng)

    np.testing.assert_array_equal(fill().successors, whole.successors)
    collect(SMOOTH, 5, repetitions=3, steps=2, step=counted)
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


@pytest.mark.parametrize("env_id", ENV_IDS)
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


def test_progress_is_told():
    told = []
    collect(DISK, 3, steps=4, progress=told.append)
    assert told == pytest.approx([0.25, 0.5, 0.75, 1.0])


def test_a_step_of_ones_own():
    data = collect(DISK, 3, repetitions=2, step=shifted, dt=0.5)
    np.testing.assert_array_equal(
        data.successors, np.repeat((data.x + 0.01 * data.u)[:, None], 2, axis=1)
    )
    assert (data.dt == 0.5).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": 0}, "points = 0; give a whole number from 1"),
        ({"points": 2.0}, r"points = 2\.0"),
        ({"repetitions": 0}, "repetitions = 0"),
        ({"steps": True}, "steps = True"),
        ({"seed": -1}, "seed = -1"),
        ({"dt": 0.0}, r"dt = 0\.0 s"),
        ({"dt": math.nan}, "dt = nan"),
        (
            {"points": 10**9, "repetitions": 100},
            r"data of 1 steps from 1000000000 points .* take \d.*GB; at most 2 GB",
        ),
        ({"inputs": [(10.5,)]}, r"\[10\.5\] is outside the bounds \(\(-10\.0, 10\.0\),\) of u"),
        ({"inputs": [(math.nan,)]}, "outside the bounds"),
        ({"inputs": [(1.0, 1.0)]}, "vectors of 1 numbers each: u"),
        ({"inputs": [1.0]}, "vectors of 1 numbers"),
        ({"inputs": []}, "one or more vectors"),
    ],
)
def test_arguments_that_are_not_allowed(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        collect(DISK, **{"points": 2, **arguments})


def test_a_region_without_safe_states_is_an_error():
    x_1 = DISK.plant.states[0]
    with pytest.raises(
        ConfigurationError,
        match=r"only 0 of \d+ states drawn from the region .*nearer to the safe set",
    ):
        collect(replace(DISK, barriers=(Barrier(-1 - x_1**2),)), 3)


def test_an_undefined_barrier_is_not_explored():
    x_1 = DISK.plant.states[0]
    assert (
        draw_states(
            replace(DISK, barriers=(Barrier(sp.log(x_1) + 10),)), 50, np.random.default_rng(0)
        )[:, 0]
        > 0
    ).all()


def test_a_step_that_is_not_finite_names_its_state_and_input():
    def diverging(x, u, rng):
        return np.where(u > 0, np.inf, x)

    with pytest.raises(
        NumericalError, match=r"from x = \[.*\] under u = \[1\.\] led to \[inf inf\]"
    ):
        collect(DISK, 3, step=diverging)
    plant = replace(
        SMOOTH.plant, drift=[1 / (DISK.plant.states[0] - DISK.plant.states[0] ** 2 * 0 - 1), 0]
    )
    region = SamplingDomain(region=((1.0, 1.0 + 1e-15), (-1.0, 1.0)))
    singular = replace(SMOOTH, plant=plant, barriers=(Barrier(sp.Integer(1)),), sampling=region)
    with pytest.raises(NumericalError, match="give a smaller dt"):
        collect(singular, 200)


def test_a_step_has_to_return_states():
    with pytest.raises(InvalidInputError, match=r"from states \(6, 2\) returned \(2,\)"):
        collect(DISK, 3, step=lambda x, u, rng: x[0])


def test_data_without_news_are_refused():
    with pytest.raises(InvalidInputError, match="rows 0 and 1 are the same"):
        collect(DISK, 3, inputs=[(1.0,), (1.0,)], step=at_rest)


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
        ({"dt": -1.0}, ConfigurationError, r"dt = -1\.0 s"),
        ({"inputs": [[11.0]]}, ConfigurationError, "outside the bounds"),
        ({"states": [0.1, 0.2]}, InvalidInputError, r"shape \(2,\); give \(1, 2\)"),
        ({"states": [[0.1, 0.2]] * 2}, InvalidInputError, "a row for each of the inputs"),
        ({"states": [[0.1, math.nan]]}, InvalidInputError, "finite"),
        ({"states": [[0.1], [0.1, 0.2]]}, InvalidInputError, "states is no array of numbers"),
    ],
)
def test_paths_that_are_not_allowed(arguments, error, message):
    with pytest.raises(error, match=message):
        collect_paths(
            DISK, **{"states": [[0.1, 0.2]], "inputs": [[1.0]], "steps": 2, "dt": 0.01, **arguments}
        )


class TestEnvStep:
    """Gymnasium's pendulum, as an env of somebody else."""

    @pytest.fixture
    def pendulum(self):
        env = gym.make("Pendulum-v1")
        yield env
        env.close()

    @staticmethod
    def set_state(env, x):
        env.unwrapped.state = x

    @staticmethod
    def get_state(env):
        return env.unwrapped.state

    def test_it_is_the_env_that_moves(self, pendulum):
        step = env_step(pendulum, self.set_state, self.get_state)
        x, u = np.array([[0.1, 0.0], [2.0, -1.0], [-1.0, 0.5]]), np.array([[0.0], [1.0], [-2.0]])
        before = x.copy()
        speed = x[:, 1] + (15.0 * np.sin(x[:, 0]) + 3.0 * u[:, 0]) * 0.05
        expected = np.stack([x[:, 0] + speed * 0.05, speed], axis=1)
        np.testing.assert_allclose(step(x, u, np.random.default_rng(0)), expected, atol=1e-12)
        np.testing.assert_array_equal(x, before)

    def test_it_feeds_the_collector(self, pendulum):
        problem = make_problem("safe_envs/Pendulum-v0")
        step = env_step(
            pendulum,
            self.set_state,
            self.get_state,
            to_action=lambda u: (u / 10.0).astype(np.float32),
        )
        one, same = (
            collect(problem, 10, inputs=[(-1.0,), (1.0,)], step=step, dt=0.05, seed=3)
            for _ in range(2)
        )
        np.testing.assert_array_equal(one.successors, same.successors)
        expected = one.x[:, 1] + (15.0 * np.sin(one.x[:, 0]) + 0.3 * one.u[:, 0]) * 0.05
        np.testing.assert_allclose(one.successors[:, 0, 1], expected, atol=1e-7)

    def test_noise_of_the_env_is_of_the_generator(self, pendulum):
        def get_noisy(env):
            return env.unwrapped.state + env.unwrapped.np_random.normal(size=2)

        step = env_step(pendulum, self.set_state, get_noisy)
        x, u = np.zeros((3, 2)), np.zeros((3, 1))
        rng = np.random.default_rng(0)
        one, going_on = step(x, u, rng), step(x, u, rng)
        assert not np.isin(one, going_on).any()
        np.testing.assert_array_equal(step(x, u, np.random.default_rng(0)), one)


def test_sizes_are_checked_before_anything_is_drawn():
    with pytest.raises(
        ConfigurationError, match=r"1000000000000 states of CubicSDEDisk take 1\.6e"
    ):
        draw_states(DISK, 10**12, np.random.default_rng(0))
    with pytest.raises(ConfigurationError, match="1 paths of 1000000000000 steps take"):
        collect_paths(DISK, [[0.1, 0.2]], [[1.0]], 10**12, 0.01)


def test_a_step_of_ones_own_may_be_that_of_any_plant():
    assert collect(DISK, 3).signature.plant == (("a", 0.6), ("sigma_1", 0.2), ("sigma_2", 0.2))
    assert collect(DISK, 3, step=shifted).signature.plant == ()


def test_numbers_of_numpy_are_numbers():
    data = collect(DISK, np.int64(3), repetitions=np.int32(2), seed=np.int64(1))
    np.testing.assert_array_equal(
        data.successors, collect(DISK, 3, repetitions=2, seed=1).successors
    )


@pytest.mark.parametrize("problem", ["safe_envs/Pendulum-v0", None])
def test_what_is_no_problem_is_refused(problem):
    with pytest.raises(
        ConfigurationError, match=r"problem = .* give a SafetyProblem, as make_problem"
    ):
        collect(problem, 3)
