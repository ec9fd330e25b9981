"""Policies in compiled programs: the inputs that the envs execute for what `predict` returns."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, define_problem
from safe_envs.agents.policies.network_policy import NetworkPolicy, Normalization
from safe_envs.agents.policies.nominal import (
    CLFController,
    NominalController,
    RandomPolicy,
    ZeroController,
)
from safe_envs.agents.policies.policy_source import policy_source
from safe_envs.agents.policies.registry import as_policy
from safe_envs.dynamics.noise import POLICY
from safe_envs.engine import slots
from safe_envs.engine.program import Program
from safe_envs.engine.slots import Data
from safe_envs.envs.spaces import BatchActions
from safe_envs.errors import NotCompilableError
from safe_envs.filters.learning.models.network import Network
from safe_envs.problem.clf import CLF
from tests.conftest import problem_of

DUBINS = "safe_envs/StochasticDubins-v0"
COUNT = 30


def inputs_of(policy, problem, observations, key=(0, 0)):
    """What `act` returns at one observation a period, in plain Python."""
    data = Data()
    source = policy_source(policy, problem, data)
    act = Program("a policy", [slots.act], source).plain()["act"]
    numbers, work = data.array(), np.full(source.work, np.nan)
    return np.array(
        [act(tuple(o), k, *key, numbers, work) for k, o in enumerate(observations.tolist())]
    )


def executed(problem, actions):
    """The inputs that a vector env executes."""
    return np.stack(BatchActions(problem, len(actions)).physical(actions), axis=-1)


def predicted(policy, observations):
    """Actions at one observation at a time: NumPy rounds the functions of arrays differently."""
    return np.array([policy.predict(o)[0] for o in observations])


def observations_of(problem, count=COUNT):
    low, high = np.array([(f.low, f.high) for f in problem.features]).T
    return np.random.default_rng(0).uniform(1.2 * low, 1.2 * high, (count, len(low))).astype("f4")


@pytest.mark.parametrize("kind", [NominalController, ZeroController])
def test_inputs_are_those_that_envs_execute(env_id, kind):
    problem = problem_of(env_id)
    policy, seen = kind(problem), observations_of(problem)
    found = inputs_of(policy, problem, seen)
    # The arc tangent of programs is not that of the C library to the last bit.
    expected = executed(problem, predicted(policy, seen))
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-14 * np.abs(expected).max())
    assert np.isfinite(found).all()


@pytest.mark.parametrize("key", [(7, 0), (2**64 - 1, 2**63 + 5)])
def test_random_actions_are_the_words_of_a_stream(env_id, key):
    problem = problem_of(env_id)
    seen, m = observations_of(problem), len(problem.inputs)
    stream = np.random.Generator(
        np.random.Philox(key=np.array(key, dtype=np.uint64), counter=[0, 0, POLICY, 0])
    )
    actions = 2.0 * stream.random((COUNT, m)) - 1.0
    found = inputs_of(RandomPolicy(problem), problem, seen, key)
    np.testing.assert_array_equal(found, executed(problem, actions))
    assert len(np.unique(found)) == COUNT * m


def some_network(inputs, outputs, activation, hidden=(7, 5), seed=3):
    rng, sizes = np.random.default_rng(seed), [inputs, *hidden, outputs]
    weights = [0.4 * rng.normal(size=(b, a)) / a**0.5 for a, b in pairwise(sizes)]
    biases = [0.3 * rng.normal(size=b) for b in sizes[1:]]
    return Network.unscaled(weights, biases, activation)


@pytest.mark.parametrize(
    ("activation", "output", "hidden", "normal", "other_box"),
    [
        ("tanh", "clip", (7, 5), False, False),
        ("relu", "tanh", (6,), True, False),
        ("silu", "tanh", (4, 4, 4), False, True),
        ("elu", "clip", (5,), True, True),
        ("leaky_relu", "tanh", (3, 2), False, False),
        ("identity", "tanh", (), False, False),
    ],
)
@pytest.mark.parametrize("env_id", [DUBINS, "safe_envs/Quadrotor-v0"])
def test_networks(env_id, activation, output, hidden, normal, other_box):
    problem = problem_of(env_id)
    k, box = len(problem.features), np.array(problem.input_bounds)
    numbers = tuple(0.5 * i for i in range(k))
    scaling = Normalization(numbers, numbers, 1.5, 1e-3) if normal else None
    boxes = (0.7 * box + 0.1, box) if other_box else None
    network = some_network(k, len(problem.inputs), activation, hidden)
    policy = NetworkPolicy(network, output, scaling, boxes)
    seen = observations_of(problem)
    found = inputs_of(policy, problem, seen)
    actions, _ = policy.predict(seen)
    # Rounded to single precision, which sums in another order seldom change.
    apart = found != executed(problem, actions)
    assert apart.mean() <= 0.1
    np.testing.assert_allclose(found, executed(problem, actions), rtol=3e-7, atol=1e-7)
    assert len(np.unique(found)) > COUNT / 4


def planar_problem():
    x, y, u, v = sp.symbols("x y u v", real=True)
    system = ControlAffineSDE((x, y), (u, v), [x, -y], [[1, y], [0, 2]], [[0.3, 0.2], [0.0, 0.4]])
    numbers = {"start": [0.0, 0.0], "dt": 0.1, "horizon": 0.5, "nominal": [0, 0]}
    return define_problem(system, 3 - x - y, input_bounds=[(-1.0, 2.0), (-0.5, 0.5)], **numbers)


@pytest.mark.parametrize("weight", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("kind", ["CubicSDE", "ACC", "two inputs"])
def test_clf_controllers(kind, weight):
    problem = planar_problem() if kind == "two inputs" else problem_of(f"safe_envs/{kind}-v0")
    total = sum((state - 1.0) ** 2 for state in problem.model.states)
    policy = CLFController(problem, CLF(total, 2.0, 0.3, weight))
    shape = (COUNT, len(problem.features))
    seen = np.random.default_rng(1).normal(1.0, 1.0, shape).astype("f4")
    found = inputs_of(policy, problem, seen)
    np.testing.assert_array_equal(found, executed(problem, predicted(policy, seen)))
    assert len(np.unique(found)) > COUNT / 4


@pytest.mark.parametrize("kind", [NominalController, CLFController, NetworkPolicy])
def test_nan_stays_nan(kind):
    problem = problem_of("safe_envs/CubicSDE-v0")
    policy = kind(some_network(2, 1, "tanh"), "clip") if kind is NetworkPolicy else kind(problem)
    seen = np.array([[0.5, math.nan], [0.5, 0.5]])
    found = inputs_of(policy, problem, seen)
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()


@pytest.mark.parametrize("given", [lambda rows: rows[:, 0], "predict"])
def test_policies_from_outside_are_refused(given):
    class Outside:
        def predict(self, *_):
            raise NotImplementedError

    problem = problem_of(DUBINS)
    policy = as_policy(Outside() if given == "predict" else given, problem)
    with pytest.raises(NotCompilableError, match="NumPy"):
        policy_source(policy, problem, Data())


@pytest.mark.parametrize("method", ["actions", "predict", "begin"])
def test_classes_that_compute_otherwise_are_refused(method):
    derived = type("Derived", (NominalController,), {method: getattr(NominalController, method)})
    problem = problem_of(DUBINS)
    with pytest.raises(NotCompilableError, match="Derived"):
        policy_source(derived(problem), problem, Data())
    as_before = type("AsBefore", (NominalController,), {})
    assert policy_source(as_before(problem), problem, Data()).text
