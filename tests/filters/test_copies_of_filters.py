"""Filters, policies and what was learned: the same decisions after pickling and copying."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch

from safe_envs.agents.policies.registry import make_policy
from safe_envs.filters.conditions.registry import LEARNED
from safe_envs.filters.learning.bayesian import identify
from safe_envs.filters.learning.generator import learn_generator
from safe_envs.filters.safety_filter import SafetyFilter
from safe_envs.filters.torch_layer import TorchFilter
from tests.conftest import problem_of

COPIES = {"pickle": lambda given: pickle.loads(pickle.dumps(given)), "deepcopy": copy.deepcopy}
copied = pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)


def assert_decides_like(other, given, rows=20):
    """Check that two filters decide alike, for one state and for a batch."""
    n, m = given.model.n, given.model.m
    drawn = np.random.default_rng(0).uniform(0.1, 0.4, (rows, n + m))
    for x, u in ((drawn[:, :n], 5 * drawn[:, n:]), (drawn[0, :n], 5 * drawn[0, n:])):
        for mine, theirs in zip(other.filter(x, u), given.filter(x, u), strict=True):
            np.testing.assert_array_equal(mine, theirs)


@copied
@pytest.mark.parametrize("used", [False, True])
def test_the_filter_of_every_system(env_id, copied, used):
    problem = problem_of(env_id)
    given = SafetyFilter.for_problem(problem, problem.filter)
    if used:
        assert_decides_like(given, given)
    assert_decides_like(copied(given), given)


@pytest.mark.parametrize(
    ("name", "env", "learn"),
    [
        ("ddscbf", "ACCGap", lambda p: learn_generator(p, points=50, repetitions=50)),
        ("bayesian-scbf", "CubicSDEDisk", lambda p: identify(p, starts=100, repetitions=20)),
    ],
)
def test_learned_filters(name, env, learn):
    problem = problem_of(f"safe_envs/{env}-v0")
    model = learn(problem)
    for made in COPIES.values():
        condition = LEARNED[name].from_learned(made(model), problem.gains_of(0))
        given = SafetyFilter.for_problem(problem, [condition])
        assert_decides_like(made(given), given)


@copied
def test_differentiable_filters(copied):
    given = TorchFilter.for_problem(problem_of("safe_envs/StochasticDubins-v0"), "scbf")
    x, found = torch.tensor([2.5, 1.0, 0.3]).double(), []
    for layer in (given, copied(given)):
        u = torch.tensor([5.0]).double().requires_grad_()
        action = layer(x, u)
        action.sum().backward()
        found.append((action.tolist(), u.grad.tolist()))
    assert found[0] == found[1]


@copied
@pytest.mark.parametrize(
    ("name", "system"),
    [("nominal", "Quadrotor"), ("zero", "Scalar"), ("clf", "ACC"), ("random", "Pendulum")],
)
def test_policies(name, system, copied):
    problem = problem_of(f"safe_envs/{system}-v0")
    policy = make_policy(name, problem)
    policy.begin(range(1), 3)
    seen = np.array([0.1 * i for i, _ in enumerate(problem.features)])
    policy.predict(seen)
    other = copied(policy)
    for _ in range(3):
        np.testing.assert_array_equal(other.predict(seen)[0], policy.predict(seen)[0])
