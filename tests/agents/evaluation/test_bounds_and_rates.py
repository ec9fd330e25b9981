"""The estimated bound beside a measured rate, or why there is none."""

from __future__ import annotations

import math

import numpy as np
import pytest
import sympy as sp

from safe_envs import Barrier, ControlAffineSDE, SafetyProblem
from safe_envs.agents import evaluate
from safe_envs.problem.signals import Variable
from safe_envs.problem.starts import Start

pytestmark = pytest.mark.slow


@pytest.mark.slow
def test_bounds_stand_beside_the_rates_or_say_why_not():
    cubic = evaluate(
        "CubicSDEDisk-v0",
        filters=["none", "scbf", "szcbf", "cbf"],
        options={"start": [0.3, 0.4]},
        episodes=20,
    )
    bare, scbf, szcbf, cbf = cubic.rows
    assert (bare.continuous_bound, bare.continuous_note) == (None, "there is no filter")
    # h = .75, c = 1, A h >= -.08 at worst, over 1 s; and with A h + 2 h >= 0 everywhere.
    assert scbf.continuous_bound == pytest.approx(0.75 - 0.08, abs=1e-4)
    assert "by up to 0.08" in scbf.continuous_note
    assert (szcbf.continuous_bound, szcbf.continuous_note) == (
        pytest.approx(0.75 * math.exp(-2.0), abs=1e-4),
        "",
    )
    assert (cbf.continuous_bound, cbf.continuous_note) == (None, "cbf ignores the noise")
    # Leaving the workspace ends an episode, so that h = 1 - x is at most 4 over x >= -3; A h >= 0
    # can be met everywhere.
    (scalar,) = evaluate(
        "Scalar-v0", filters=["scbf"], options={"horizon": 1.0, "start": [0.0]}, episodes=50
    ).rows
    assert (scalar.continuous_bound, scalar.continuous_note, scalar.withheld) == (
        pytest.approx(0.25),
        "",
        None,
    )
    (mismatch,) = evaluate(
        "DubinsDisk-v0", filters=["hocbf"], options={"horizon": 1.0}, episodes=5
    ).rows
    assert (mismatch.continuous_bound, mismatch.continuous_note) == (
        None,
        "the model differs from the plant in v",
    )


def test_bound_is_the_mean_over_the_starts():
    answer = evaluate("CubicSDEDisk-v0", filters=["szcbf"], episodes=50, num_envs=16, record=True)
    starts = answer.trajectories["szcbf"].states[0]
    assert len(starts) == 32
    first = evaluate("CubicSDEDisk-v0", filters=["szcbf"], episodes=32, num_envs=7)
    assert first.rows[0].continuous_bound == pytest.approx(
        np.mean(1 - starts[:, 0] ** 2 - starts[:, 1] ** 2) * math.exp(-2.0), rel=1e-3
    )
    assert first.rows[0].continuous_bound != answer.rows[0].continuous_bound
    h = 1 - starts[:, 0] ** 2 - starts[:, 1] ** 2
    assert first.rows[0].continuous_error == pytest.approx(
        np.std(h, ddof=1) / math.sqrt(32) * math.exp(-2.0), rel=1e-3
    )


def test_a_bound_that_cannot_be_computed_does_not_end_an_evaluation():
    x, u = sp.symbols("x u", real=True)
    system = ControlAffineSDE(
        (x,), (u,), [-sp.sqrt(x + 0.5)], [1], [sp.Rational(1, 100)]
    )  # no value at x < -.5, which C holds
    problem = SafetyProblem(
        "Root",
        plant=system,
        model=system,
        barriers=(Barrier(1 - x**2),),
        states=(Variable(x, -2.0, 2.0),),
        inputs=(Variable(u, -3.0, 3.0),),
        reward=sp.Integer(0),
        nominal=(sp.Integer(1),),
        starts={"middle": Start.at((0.5,))},
        dt=0.05,
        horizon=0.2,
    )
    (row,) = evaluate(problem, filters=["scbf"], episodes=5).rows
    assert row.safe == 5
    assert row.continuous_bound is None
    assert "finite value" in row.continuous_note
