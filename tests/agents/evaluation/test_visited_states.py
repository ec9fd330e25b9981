"""States that are kept of episodes: the same in whatever batches they come."""

from __future__ import annotations

from functools import reduce

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from safe_envs.agents.evaluation.episodes import StateWatch, VisitedStates

EPISODES, STEPS = 90, 4


def watched(x, slack, h):
    """What a watch keeps of episodes, from states (STEPS + 1, 2, B), slacks (STEPS, B) and h (STEPS
    + 1, B)."""
    watch, safe, h_min = StateWatch(tuple(x[0]), h[0], 1), h[0] > 0, h[0].copy()
    alive = np.ones(len(h_min), dtype=bool)
    for k in range(STEPS):
        counts = alive & safe
        watch.add(tuple(x[k]), (x[k, 0] - x[k, 1],), slack[k], counts)
        watch.reached(tuple(x[k + 1]), h[k + 1], h_min, alive, counts)
        h_min, safe = np.minimum(h_min, h[k + 1]), safe & (h[k + 1] > 0)
    return watch


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.integers(1, EPISODES),
    missing=st.sampled_from([0.0, 0.5, 0.95, 1.0]),
)
def test_batches_of_any_size_keep_the_same(seed, size, missing):
    rng = np.random.default_rng(seed)
    x, h = rng.normal(size=(STEPS + 1, 2, EPISODES)), rng.normal(size=(STEPS + 1, EPISODES)) + 1.0
    slack = rng.random((STEPS, EPISODES)) * (rng.random((STEPS, EPISODES)) >= missing)
    whole = watched(x, slack, h)
    found = whole.visited(EPISODES)
    parts = [slice(i, min(i + size, EPISODES)) for i in range(0, EPISODES, size)]
    batches = [
        watched(x[..., part], slack[:, part], h[:, part]).visited(part.stop - part.start)
        for part in parts
    ]
    joined = reduce(VisitedStates.joined, batches)
    for one, other in zip(vars(found).values(), vars(joined).values(), strict=True):
        np.testing.assert_array_equal(one, other)
    # By hand: the steps up to the first violation, and the worst of each episode.
    safe = np.cumprod(h > 0, axis=0, dtype=bool)
    missed = np.where(safe[:-1], slack, 0.0)
    most = np.sort(missed.max(axis=0))[::-1]
    np.testing.assert_array_equal(found.slack, most[most > 0][:64])
    for state, action, size_of in zip(found.violating, found.actions, found.slack, strict=True):
        k, i = np.argwhere(missed == size_of)[0]
        np.testing.assert_array_equal(state, x[k, :, i])
        assert action == x[k, 0, i] - x[k, 1, i]
    depth = np.where(
        np.concatenate([np.ones((1, EPISODES), dtype=bool), safe[:-1]]), h, -np.inf
    ).max(axis=0)
    np.testing.assert_array_equal(found.depth, np.sort(depth)[::-1][:64])
    violated = np.flatnonzero(h.min(axis=0) <= 0)
    np.testing.assert_array_equal(
        whole.lowest.T[violated],
        [x[h[:, i].argmin(), :, i] for i in violated.tolist()] or np.empty((0, 2)),
    )
