"""Where and how a problem is explored: what is completed, and what cannot be."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs.errors import SystemDefinitionError
from safe_envs.problem.signals import Variable
from safe_envs.problem.starts import SamplingDomain
from safe_envs.registry import make_problem

DISK = make_problem("safe_envs/CubicSDEDisk-v0")
x, theta, w = sp.symbols("x theta w", real=True)


def bare(**changes):
    """The disk, of whose domain nothing is said."""
    return replace(DISK, **{"sampling": SamplingDomain(), **changes})


def test_defaults_are_the_workspace_and_halfway_inputs():
    domain = bare().sampling_domain
    assert domain.region == ((-2.0, 2.0), (-2.0, 2.0))
    assert domain.inputs == ((-5.0,), (5.0,))
    assert domain.coordinates == DISK.plant.states


def test_what_is_given_is_kept():
    given = SamplingDomain(((0.0, 1.0), (-1.0, 0.0)), ((0.5,),), (DISK.plant.states[0] ** 2,))
    assert bare(sampling=given).sampling_domain == given


def test_unbounded_radians_are_angles_and_are_explored_over_a_whole_turn():
    angle = Variable(theta, -math.inf, math.inf, "rad")
    found = SamplingDomain().completed((Variable(x, -1.0, 3.0, "rad"), angle), ((-1.0, 1.0),))
    assert found.region == ((-1.0, 3.0), (-math.pi, math.pi))
    assert found.coordinates == (x, sp.cos(theta), sp.sin(theta))


@pytest.mark.parametrize(("low", "unit"), [(-math.inf, "m"), (0.0, "rad")])
def test_other_states_without_bounds_cannot_be_explored(low, unit):
    x_1, x_2 = DISK.plant.states
    states = (Variable(x_1, -1.0, 1.0), Variable(x_2, low, math.inf, unit))
    with pytest.raises(SystemDefinitionError, match=rf"cannot explore x_2 in \[{low}, inf\]"):
        _ = bare(states=states).sampling_domain


def test_each_input_goes_halfway_with_the_others_at_the_centre():
    found = SamplingDomain().completed((Variable(x, 0.0, 1.0),), ((-2.0, 2.0), (0.0, 8.0)))
    assert found.inputs == ((-1.0, 4.0), (1.0, 4.0), (0.0, 2.0), (0.0, 6.0))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"region": ((0.0, 1.0),)}, "1 ranges for 2 states"),
        ({"region": ((0.0, 1.0),) * 3}, "3 ranges for 2 states"),
        ({"region": ((0.0, math.inf), (0.0, 1.0))}, r"x_1 in \[0\.0, inf\]"),
        ({"region": ((0.0, 1.0), (math.nan, 1.0))}, "cannot explore x_2"),
        ({"region": ((0.0, 1.0), (1.0, 1.0))}, r"x_2 in \[1\.0, 1\.0\]"),
        ({"inputs": ((1.0, 2.0),)}, "needs 1 finite numbers"),
        ({"inputs": ((1.0,), ())}, "needs 1 finite numbers"),
        ({"coordinates": (w,)}, r"(?s)coordinate of the sampling domain.*w"),
    ],
)
def test_what_does_not_fit_is_refused(given, message):
    with pytest.raises(SystemDefinitionError, match=message):
        _ = bare(sampling=SamplingDomain(**given)).sampling_domain


def test_every_problem_can_be_explored(env_id):
    problem = make_problem(env_id)
    domain = problem.sampling_domain
    assert len(domain.region) == len(problem.states)
    low, high = np.array(problem.input_bounds).T
    assert all(((low <= u) & (u <= high)).all() for u in np.array(domain.inputs))
    assert set().union(*(c.free_symbols for c in domain.coordinates)) <= set(problem.plant.states)
