"""States and actions that are no real numbers: refused by one error, wherever they are given."""

from __future__ import annotations

from fractions import Fraction

import gymnasium as gym
import numpy as np
import pytest
import torch

from safe_envs import InvalidInputError
from safe_envs.arrays import real_array
from safe_envs.wrappers import (
    FilterSpec,
    SafetyFilter,
    SafetyFilterVectorWrapper,
    SafetyFilterWrapper,
    SafetyMonitor,
)
from safe_envs.wrappers.monitor import SafetyMonitorVector
from tests.conftest import problem_of

NO_NUMBERS = {
    "text": "fast",
    "numbers as text": ["1.0"],
    "None": None,
    "None inside": [None],
    "ragged": [[1.0], [1.0, 2.0]],
    "beyond floats": [10**400],
    "too long to be written": [10**5000],
    "complex": np.array([1.0 + 0.0j]),
    "masked": np.ma.masked_all(1),
    "partly masked": np.ma.array([1.0, 2.0], mask=[False, True]),
    "a mapping": {"u": 1.0},
    "a date": np.array(["2020-01-01"], dtype="datetime64[D]"),
    "with a gradient": torch.ones(1, requires_grad=True),
    "an array of objects": np.array([object()]),
}


def spec():
    problem = problem_of("safe_envs/Pendulum-v0")
    return FilterSpec(problem.model, problem.barriers[0].expression, lambda o: o[..., :2], dt=0.05)


@pytest.fixture(scope="module")
def places():
    safety_filter = SafetyFilter.for_problem(problem_of("safe_envs/Scalar-v0"), "cbf")
    envs = [
        gym.make("safe_envs/Scalar-v0", disable_env_checker=True),
        gym.make_vec("safe_envs/Scalar-v0", num_envs=1),
        SafetyFilterWrapper(gym.make("safe_envs/Scalar-v0", disable_env_checker=True), "cbf"),
        SafetyFilterVectorWrapper(gym.make_vec("safe_envs/Scalar-v0", num_envs=1), "cbf"),
        SafetyMonitor(gym.make("Pendulum-v1", disable_env_checker=True), spec()),
        SafetyMonitorVector(
            gym.make_vec("Pendulum-v1", num_envs=1, vectorization_mode="sync"), spec()
        ),
    ]
    for env in envs:
        env.reset(seed=0)
    steps = {f"{type(env).__name__} of {env.unwrapped}": env.step for env in envs}
    return {
        **steps,
        "input": lambda u: safety_filter.filter([0.0], u),
        "state": lambda x: safety_filter.filter(x, [0.0]),
    }


@pytest.mark.parametrize("kind", NO_NUMBERS)
def test_what_is_no_number_is_refused_everywhere(kind, places):
    for name, use in places.items():
        with pytest.raises(
            InvalidInputError, match=r"(?s)^the .* is .*; give an array of real numbers"
        ) as caught:
            use(NO_NUMBERS[kind])
        assert len(str(caught.value)) < 400, name


@pytest.mark.parametrize(
    "given",
    [
        np.float32(0.25),
        0.25,
        [0.25],
        (Fraction(1, 4),),
        np.array([0.25], dtype=np.longdouble),
        torch.tensor([0.25]),
    ],
)
def test_what_is_a_number_is_converted(given):
    found = real_array("action", given)
    assert found.dtype.kind == "f"
    assert found.dtype.itemsize <= 8
    assert found.ravel().tolist() == [0.25]


def test_arrays_of_floats_come_back_as_they_are():
    for given in (np.zeros(2), np.zeros((3, 1), dtype=np.float32)):
        assert real_array("action", given) is given
    assert real_array("action", [True, 2]).tolist() == [1.0, 2.0]
