"""Paths that are taken up again, one by one."""

from __future__ import annotations

import numpy as np
import pytest

from safe_envs.agents import ZeroController
from safe_envs.agents.rare_events.numpy_paths import NumpyPaths, TiltedNoiseEnv
from safe_envs.agents.rare_events.splitting import Particles, PathKeys, Records
from safe_envs.dynamics.noise import SPLIT
from tests.oracles.laws import X, brownian

pytestmark = pytest.mark.slow


class Watching(ZeroController):
    """Keeps what it sees beside the states that it is of."""

    def __init__(self, problem):
        super().__init__(problem)
        self.env, self.seen = None, []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.seen.append((observation[:, 0].copy(), self.env.components[0].copy()))
        return super().predict(observation)


def particles_of(problem, policy, count):
    def make(lengths):
        env = TiltedNoiseEnv(problem, lengths)
        policy.env = env
        return env

    return Particles(NumpyPaths(problem, make, policy, count), PathKeys(0, SPLIT), np.zeros(count))


def test_paths_go_on_from_where_others_fell_below_a_level():
    problem = brownian(0.05, 1.0, 0.0, 0.3)
    policy = Watching(problem)
    paths = particles_of(problem, policy, 64)
    order = np.argsort(paths.lowest)
    killed, parents = order[2:], np.resize(order[:2], 62)
    levels = 0.5 * (1.0 + paths.lowest[parents])
    policy.seen.clear()
    ends = []
    for _ in range(2):
        paths.branch(killed, parents, levels)
        assert (paths.lowest[killed] < levels).all()
        ends.append(paths.lowest[killed].copy())
    # The policy sees the state of each row, and the noise is fresh each time.
    rows = slice(0, killed.size)
    for observation, x in policy.seen:
        assert observation[rows] == pytest.approx(x[rows], abs=1e-6)
    first = policy.seen[0][1][rows]
    assert len(np.unique(first)) == 2
    assert (1 - first < levels.max()).all()
    for end in ends:
        assert len(np.unique(end)) > killed.size / 2
    assert (ends[0] != ends[1]).mean() > 0.5


def test_several_barriers_are_compared_in_units_of_their_own():
    policy = Watching(brownian(0.05, 1.0, 0.0, 0.3, [1 - X, 100 * (1 + X)]))
    problem = brownian(0.05, 1.0, 0.0, 0.3, [1 - X, 100 * (1 + X)])
    paths = particles_of(problem, policy, 64)
    same = particles_of(brownian(0.05, 1.0, 0.0, 0.3, [1 - X, 1 + X]), Watching(problem), 64)
    assert paths.lowest == pytest.approx(same.lowest)


def test_records_find_the_first_one_below_a_level():
    generator = np.random.default_rng(0)
    paths, steps = 7, 300
    records, heights = (
        Records(paths, 2),
        np.minimum.accumulate(
            generator.standard_normal((steps, paths)).cumsum(axis=0) - 0.1, axis=0
        ),
    )
    for k, row in enumerate(heights):
        fell = np.flatnonzero(row < heights[k - 1]) if k else np.arange(paths)
        state = np.stack([row[fell], np.full(len(fell), k)], axis=1)
        records.add(
            fell,
            row[fell],
            np.full(len(fell), k),
            np.zeros(len(fell), dtype=bool),
            state,
            -state,
        )
    levels = heights[-1] + generator.uniform(0.1, 3.0, paths)
    height, time, _, state, girsanov_integrals = records.first_below(levels, np.arange(paths))
    wanted = [int(np.argmax(heights[:, i] < levels[i])) for i in range(paths)]
    assert time.tolist() == wanted
    assert height.tolist() == [heights[k, i] for i, k in enumerate(wanted)]
    assert (
        state.tolist()
        == (-girsanov_integrals).tolist()
        == [[heights[k, i], k] for i, k in enumerate(wanted)]
    )
    records.keep(np.array([3]), 0)
    records.add(
        np.array([3]),
        *(np.array([v]) for v in (0.5, 4, True)),
        np.zeros((1, 2)),
        np.zeros((1, 2)),
    )
    assert records.first_below(np.array([1.0]), np.array([3]))[1].tolist() == [4]
    assert records.last(np.array([3]))[1].tolist() == [4]
