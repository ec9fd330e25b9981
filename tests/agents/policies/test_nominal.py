"""The policies without training: what they see, and what they do."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from safe_envs import ConfigurationError, InvalidInputError, NumericalError, SafeEnv
from safe_envs.agents import (
    NominalController,
    RandomPolicy,
    ZeroController,
    make_policy,
    make_problem,
)

pytestmark = pytest.mark.slow

NAMES = ["nominal", "zero", "random"]


def observations(problem, count, seed=0):
    rng = np.random.default_rng(seed)
    low, high = np.array([(f.low, f.high) for f in problem.features]).T
    return rng.uniform(low, high, (count, len(low))).astype(np.float32)


def physical(problem, actions):
    """From actions in [-1, 1] to the box, written down independently."""
    low, high = np.array(problem.input_bounds).T
    return low + (np.asarray(actions) + 1.0) / 2.0 * (high - low)


@pytest.mark.parametrize("name", NAMES)
def test_actions_of_one_and_of_many_observations(env_id, name):
    problem = make_problem(env_id)
    policy = make_policy(name, problem)
    many = observations(problem, 50)
    m = len(problem.inputs)
    actions, state = policy.predict(many, "passed on", np.ones(50, dtype=bool), deterministic=True)
    assert actions.shape == (50, m)
    assert state == "passed on"
    assert np.abs(actions).max() <= 1.0 + 1e-12
    assert policy.predict(many[:1])[0].shape == (1, m)
    singles = [policy.predict(o)[0] for o in many]
    assert {a.shape for a in singles} == {(m,)}
    if name == "random":
        assert not np.allclose(singles, actions)
    else:
        np.testing.assert_allclose(singles, actions, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(policy.predict(many[::-1])[0][::-1], actions)
        np.testing.assert_array_equal(policy.predict(many.astype(np.float64))[0], actions)


def test_nominal_controllers_know_the_model_and_never_the_plant(env_id):
    given = make_problem(env_id)
    levels = {p.name: value for p, value in given.plant.parameters.items()}
    elsewhere = {name: 1.3 * value + 0.1 for name, value in levels.items()}
    many = observations(given, 200)
    actions = NominalController(given).predict(many)[0]
    with_plant = given.configured(plant=elsewhere)
    assert with_plant.plant != given.plant
    np.testing.assert_array_equal(NominalController(with_plant).predict(many)[0], actions)
    with_model = NominalController(given.configured(model=elsewhere)).predict(many)[0]
    used = set().union(*(law.free_symbols for law in given.nominal)) & set(given.model.parameters)
    assert (not np.array_equal(with_model, actions)) == bool(used)


def test_zero_controller_executes_the_point_of_the_box_nearest_to_zero(env_id):
    problem = make_problem(env_id)
    action = ZeroController(problem).predict(observations(problem, 3))[0]
    np.testing.assert_allclose(physical(problem, action), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("box", "wanted"),
    [([-2.0, 6.0], 0.0), ([1.0, 6.0], 1.0), ([-6.0, -2.0], -2.0), ([0.0, 3.0], 0.0)],
)
def test_zero_controller_in_boxes_off_centre(box, wanted):
    env = gym.make("safe_envs/Scalar-v0", input_bounds=box).unwrapped
    assert isinstance(env, SafeEnv)
    action = ZeroController(env.problem).predict(np.zeros(1))[0]
    assert env.physical_action(action)[0] == pytest.approx(wanted, abs=1e-12)


def test_nominal_actions_are_clipped_to_the_box():
    problem = make_problem("Scalar-v0", input_bounds=[-0.5, 2.0])
    observation = np.array([[-2.5], [0.0], [1.9]])
    np.testing.assert_allclose(
        physical(problem, NominalController(problem).predict(observation)[0]),
        [[2.0], [1.0], [-0.5]],
    )


def test_quadrotor_law_is_the_closed_form():
    problem = make_problem(
        "QuadrotorAltitude-v0", model={"m": 0.45}, plant={"m": 0.9}, input_bounds=[-1000.0, 1000.0]
    )
    given = observations(problem, 300)
    z, zdot, z_ref, z_ref_rate = given.astype(float).T
    thrust = 0.45 * (9.81 + 6 * (z_ref - z) + 4 * (z_ref_rate - zdot))
    np.testing.assert_allclose(
        physical(problem, NominalController(problem).predict(given)[0])[:, 0],
        thrust,
        rtol=1e-9,
        atol=1e-9,
    )


def test_full_quadrotor_has_the_thrust_of_the_altitude_law():
    problem = make_problem("Quadrotor-v0", input_bounds=[-1e9, 1e9])
    given = observations(problem, 100)
    names = [f.name for f in problem.features]
    z, zdot, z_ref, z_ref_rate = (
        given[:, names.index(n)].astype(float) for n in ("z", "zdot", "z_ref", "z_ref_rate")
    )
    squared_speeds = physical(problem, NominalController(problem).predict(given)[0])
    thrust = 0.4 * (9.81 + 6 * (z_ref - z) + 4 * (z_ref_rate - zdot))
    np.testing.assert_allclose(3.13e-5 * squared_speeds.sum(axis=1), thrust, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("env_id", "speed", "rate", "slack_weight", "sigma"),
    [("ACC-v0", "x_1", 5, 0.02, 1.2), ("ACCGap-v0", "v", 1, 2, 0.05)],
)
def test_cruise_law_solves_its_quadratic_program(env_id, speed, rate, slack_weight, sigma):
    # min 2 (u/M)^2 + w_d d^2 subject to A V + rate V <= d with V = (v - 22)^2, over u/M, with the
    # best d for each u.
    M = 1500.0
    problem = make_problem(env_id, model={"sigma_1": sigma, "M": M}, input_bounds=[-1e6, 1e6])
    column = [f.name for f in problem.features].index(speed)
    given = observations(problem, 60, seed=3)
    given[:30, column] = np.linspace(21.01, 23.0, 30)
    forces = physical(problem, NominalController(problem).predict(given)[0])[:, 0]
    active = 0
    for v, force in zip(given[:, column].astype(float), forces, strict=True):
        e = v - 22.0

        def decay(a, v=v, e=e):
            return 2 * e * (a - (0.1 + 5 * v + 0.25 * v**2) / M) + sigma**2 + rate * e**2

        def cost(a, decay=decay):
            return 2 * a**2 + slack_weight * max(decay(a), 0.0) ** 2

        best = minimize_scalar(
            cost, bounds=(-300.0, 300.0), method="bounded", options={"xatol": 1e-10}
        )
        assert cost(force / M) <= best.fun * (1 + 1e-9) + 1e-12
        assert force / M == pytest.approx(best.x, rel=1e-5, abs=1e-5)
        active += abs(force) > 0
    # With so little noise the drag alone makes V decay a little above the desired speed.
    assert (active < 60) == (sigma < 0.1)
    assert active > 20


@pytest.mark.parametrize("name", NAMES)
def test_wrong_shapes_are_errors(name):
    policy = make_policy(name, make_problem("QuadrotorAltitude-v0"))
    for shape in [(), (3,), (5,), (4, 3), (1, 2, 4), (0,)]:
        with pytest.raises(InvalidInputError, match=r"\(4,\) or \(B, 4\)"):
            policy.predict(np.zeros(shape))


def test_no_finite_value_is_an_error_that_names_the_observation():
    policy = make_policy("nominal", make_problem("QuadrotorAltitude-v0"))
    for given in (
        np.array([5.0, np.nan, 5.0, 0.0]),
        np.array([[5.0, 0.0, 5.0, 0.0], [5.0, np.nan, 5.0, 0.0]]),
    ):
        with pytest.raises(NumericalError, match="nan"):
            policy.predict(given)


def test_random_policy_does_not_depend_on_the_batch():
    problem = make_problem("Quadrotor-v0")
    width, steps = len(problem.features), 300  # more than are drawn at once
    together = RandomPolicy(problem)
    together.begin(range(10), seed=5)
    all_actions = np.stack([together.predict(np.zeros((10, width)))[0] for _ in range(steps)])
    apart = RandomPolicy(problem, seed=8)
    for rows in (range(3), range(3, 4), range(4, 10)):
        apart.begin(rows, seed=5)
        actions = np.stack([apart.predict(np.ones((len(rows), width)))[0] for _ in range(steps)])
        np.testing.assert_array_equal(actions, all_actions[:, rows.start : rows.stop])
    together.begin(range(10), seed=6)
    assert not np.isin(together.predict(np.zeros((10, width)))[0], all_actions).any()


def test_random_policy_is_uniform_and_independent():
    problem = make_problem("Quadrotor-v0")
    policy = RandomPolicy(problem)
    policy.begin(range(40), seed=0)
    drawn = np.stack([policy.predict(np.zeros((40, len(problem.features))))[0] for _ in range(200)])
    assert np.unique(drawn).size == drawn.size
    assert -1.0 <= drawn.min() < -0.99 < 0.99 < drawn.max() <= 1.0
    assert abs(drawn.mean()) < 5 / np.sqrt(3 * drawn.size)
    correlation = np.corrcoef(drawn.reshape(200, -1).T)
    off_diagonal = correlation[~np.eye(len(correlation), dtype=bool)]
    assert np.abs(off_diagonal).max() < 6 / np.sqrt(200)
    assert not policy.deterministic


def test_random_policy_outside_an_evaluation_follows_its_seed():
    problem = make_problem("Scalar-v0")
    first, second, other = (
        RandomPolicy(problem, seed).predict(np.zeros((5, 1)))[0] for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first, second)
    assert not np.allclose(first, other)


def test_unknown_policies_name_the_nearest_one():
    problem = make_problem("Scalar-v0")
    with pytest.raises(ConfigurationError, match="unknown policy 'nominl'; did you mean 'nominal'"):
        make_policy("nominl", problem)
