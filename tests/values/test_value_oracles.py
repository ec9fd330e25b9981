"""Envelopes of registered problems against simulations, frames and hostile policies."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.agents.evaluation.evaluate import evaluate
from safe_envs.agents.evaluation.statistics import rate_interval
from safe_envs.envs.simulation import Simulation
from safe_envs.registry import make_problem
from safe_envs.values.look_ahead import LookAhead, draw_starts, start_values
from safe_envs.values.promise_filter import PromiseFilter, PromiseMemory, PromiseSettings
from safe_envs.values.reduction import reduced
from safe_envs.values.solve import solve
from safe_envs.values.tables import ValueSettings

pytestmark = pytest.mark.oracle

_GRIDS = {
    "Scalar": (2000,),
    "QuadrotorAltitude": (300, 200),
    "DubinsDisk": (200, 200),
    "CubicSDE": (200, 200),
    "CubicSDEDisk": (300, 240),
    "Pendulum": (300, 80),
    "StochasticDubins": (40, 40),
}


@pytest.fixture(scope="module")
def tables():
    found = {}

    def table(name):
        if name not in found:
            problem = make_problem(f"safe_envs/{name}-v0")
            asked = ValueSettings(knowledge="plant", cells=_GRIDS[name])
            found[name] = problem, LookAhead(solve(problem, asked), problem)
        return found[name]

    return table


@pytest.mark.parametrize("name", sorted(_GRIDS))
def test_no_filter_is_safer_than_the_upper_envelope(tables, name):
    problem, look_ahead = tables(name)
    upper = start_values(look_ahead, problem).upper
    result = evaluate(f"safe_envs/{name}-v0", episodes=2000, confidence=0.999, bounds=False)
    for row in result.rows:
        assert upper >= row.ci_low, row.filter


def test_the_frame_of_the_disk_agrees_with_all_coordinates():
    options = {"horizon": 0.5}
    framed = make_problem("safe_envs/StochasticDubins-v0", **options)
    # Noises that differ by nothing that matters have no frame.
    whole = make_problem("safe_envs/StochasticDubins-v0", noise=(0.2, 0.200001), **options)
    assert len(reduced(whole, "plant").coordinates) == 3
    rng = np.random.default_rng(0)
    x = (*rng.uniform(-1.9, 1.9, (2, 300)), rng.uniform(-3.1, 3.1, 300))
    ends = []
    for problem, cells in ((framed, (60, 60)), (whole, (90, 90, 48))):
        table = solve(problem, ValueSettings(knowledge="plant", cells=cells))
        ends.append(LookAhead(table, problem).start_bounds(x))
    (low, high), (other_low, other_high) = ends
    assert (low <= other_high + 1e-6).all()
    assert (other_low <= high + 1e-6).all()
    assert (high - low).mean() < 0.1


@pytest.mark.parametrize("probability", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("name", ["Scalar", "Pendulum"])
def test_a_hostile_policy_does_not_break_the_promise(tables, name, probability):
    problem, look_ahead = tables(name)
    episodes = 100_000
    memory = PromiseMemory(
        PromiseFilter(look_ahead, PromiseSettings(probability), problem), episodes
    )
    x = draw_starts(problem, episodes, 1)
    simulation = Simulation(problem, "arrays")
    memory.begin(x)
    promised = memory.levels.mean()
    safe, rng = np.ones(episodes, dtype=bool), np.random.default_rng(2)
    middle = tuple(np.full(episodes, sum(pair) / 2) for pair in problem.input_bounds)
    gone = np.zeros(episodes, dtype=bool)
    for k in range(problem.steps):
        # The input after which the least is left, among those at the ends of the bounds.
        ends = np.array(problem.input_bounds).T[None].repeat(episodes, axis=0)
        left = look_ahead.expected(np.full(episodes, k), x, ends)
        worst = np.take_along_axis(ends, left.argmin(axis=1)[:, None, None], axis=1)[:, 0]
        decision = memory.decide_arrays(x, tuple(worst.T))
        draws = rng.normal(size=(simulation.integrator.channels, episodes))
        x = simulation.integrator.step(x, decision.action, draws)
        _, h, _, outside, _ = simulation.measure(x, middle, 0.0)
        gone |= np.broadcast_to(outside > 0.0, episodes)
        safe &= np.all([np.broadcast_to(each > 0.0, episodes) for each in h], axis=0) & ~gone
        memory.advance(x, ~safe)
    _, high = rate_interval(int(safe.sum()), episodes, 0.999)
    assert high >= promised
    assert memory.losses == 0
