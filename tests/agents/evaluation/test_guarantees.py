"""How many starts lie outside of what a condition keeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from safe_envs import ControlAffineSDE, state_problem
from safe_envs.agents import evaluate
from safe_envs.agents.evaluation.bounds import together
from safe_envs.agents.evaluation.rows import BoundSummary, PosteriorSummary


@pytest.fixture(scope="module")
def falling():
    x, v, u, sigma = sp.symbols("x v u sigma", real=True)
    system = ControlAffineSDE.from_rate(
        (x, v), (u,), [v, u], diffusion=[0, sigma], parameters={sigma: 0.1}
    )
    return state_problem(
        system,
        [1.0 * x, 1 - 0.5 * x],
        box=(-5.0, 5.0),
        start=[(-0.2, 1.0), (-3.0, 1.0)],
        dt=0.05,
        horizon=0.1,
        nominal=0,
        gains=(2.0, 2.0),
    )


@pytest.mark.parametrize(
    ("name", "p"),
    [("scbf", 0.0), ("szcbf:alphas=1,1", 1.0), ("hocbf:p=3,1", 3.0), ("ecbf:poles=-4,-2", 2.0)],
)
def test_starts_outside_the_kept_sets_are_counted(falling, name, p):
    answer = evaluate(falling, filters=name, episodes=100, num_envs=64, record=True)
    (row,) = answer.rows
    x, v = answer.trajectories[name].states[0].T
    h, rate = np.stack((x, 1 - 0.5 * x)), np.stack((v, -0.5 * v))
    outside = (h > 0).all(axis=0) & (rate + p * h <= 0).any(axis=0)
    # Of those that are kept for pictures; the row has all of them.
    again = evaluate(falling, filters=[name], episodes=len(x), num_envs=7).rows[0]
    assert again.outside_rate == np.mean(outside) > 0
    assert 0 < row.outside_rate <= 1


def test_where_there_is_no_chain_no_start_is_outside_of_it():
    bare, scbf = evaluate(
        "Scalar-v0", filters=["none", "scbf"], episodes=5, options={"horizon": 0.1}
    ).rows
    assert bare.outside_rate is None
    assert scbf.outside_rate == 0.0


def test_of_several_identifications_the_mean_counts():
    rates = [BoundSummary(continuous_note="", outside_rate=rate) for rate in (0.25, 0.5)]
    assert together(rates).outside_rate == 0.375
    assert together([rates[0], BoundSummary()]).outside_rate is None
    robust = [replace(each, posterior_bound=PosteriorSummary(0.5, "")) for each in rates]
    assert together(robust).outside_rate == 0.375
