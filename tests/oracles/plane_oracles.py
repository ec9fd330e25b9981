"""Problems of two inputs, and what is right for them by enumeration."""

from __future__ import annotations

import itertools

import numpy as np

from safe_envs.engine.qp import plane
from safe_envs.engine.qp.dispatch import project_arrays, project_floats

EPS = float(np.finfo(float).eps)
LOW, HIGH = [-1.0, -1.0], [1.0, 1.5]


def one(a, b, v, low=LOW, high=HIGH, w=(1.0, 1.0), priority=None):
    return project_floats(a, b, v, low, high, list(w), priority or [1.0] * len(b))


def many(a, b, v, low, high, w, priority):
    """Solve a (N, k, 2), b (N, k), and v, low, high, w (N, 2) in one batch, and check that the
    floats give the same: the same bits where the batch meets the rows at once, else the same flags
    and the same inputs up to 1e-12 of themselves and of the half-width of their bounds, where that
    is at most 1."""
    k = b.shape[1]
    rows = [[a[:, i, j] for j in (0, 1)] for i in range(k)]
    *parts, feasible = project_arrays(
        rows, list(b.T), list(v.T), list(low.T), list(high.T), list(w.T), priority
    )
    u, margin, active = [np.array(part).T for part in parts]
    for i in range(len(b)):
        of_one = [part[i].tolist() for part in (a, b, v, low, high, w)]
        found = project_floats(*of_one, priority)
        assert (active[i].tolist(), bool(feasible[i])) == found[2:]
        if plane.project_floats(*of_one):
            assert (u[i].tolist(), margin[i].tolist()) == found[:2]
        reach = 1e-12 * (np.abs(found[0]) + np.minimum((high[i] - low[i]) / 2, 1.0))
        assert np.all(np.abs(u[i] - found[0]) <= reach)
    assert np.all((u >= low) & (u <= high))
    np.testing.assert_allclose(margin, dot(a, u) + b, rtol=0, atol=4 * EPS * terms(a, b, u).max())
    return u, margin, active, feasible


def dot(a, u):
    return np.einsum("nij,nj->ni", a, u)


def terms(a, b, u):
    return dot(np.abs(a), np.abs(u)) + np.abs(b)


def with_faces(a, b, low, high):
    eye = np.broadcast_to(np.eye(2), (len(b), 2, 2))
    return np.concatenate([a, eye, -eye], axis=1), np.concatenate([b, -low, high], axis=1)


def nearest_oracle(a, b, v, low, high, w):
    """Of v, its foot on each line and all crossings, the nearest that meets the rows and the box;
    NaN if none does."""
    a, b = with_faces(a, b, low, high)
    with np.errstate(all="ignore"):
        lines = a / w[:, None, :]
        feet = v[:, None, :] - ((dot(a, v) + b) / (a * lines).sum(axis=2))[:, :, None] * lines
        i, j = np.array(list(itertools.combinations(range(b.shape[1]), 2))).T
        cross = a[:, i, 0] * a[:, j, 1] - a[:, i, 1] * a[:, j, 0]
        crossings = np.stack(
            [
                b[:, j] * a[:, i, 1] - b[:, i] * a[:, j, 1],
                b[:, i] * a[:, j, 0] - b[:, j] * a[:, i, 0],
            ],
            axis=2,
        )
        points = np.concatenate([v[:, None, :], feet, crossings / cross[:, :, None]], axis=1)
        value = np.einsum("nij,npj->npi", a, points) + b[:, None, :]
        size = (
            np.einsum("nij,npj->npi", np.abs(a), np.abs(points) + np.abs(v)[:, None, :])
            + np.abs(b)[:, None, :]
        )
        met = np.all(value >= -1e-11 * size, axis=2)
        cost = np.where(met, (w[:, None, :] * (points - v[:, None, :]) ** 2).sum(axis=2), np.inf)
    best = np.nanargmin(cost, axis=1)
    states = np.arange(len(b))
    return np.where(np.isfinite(cost[states, best])[:, None], points[states, best], np.nan)


def least_sum_oracle(a, b, low, high, priority):
    """The least sum over the minimisers of every violated set on the inside, the edges and the
    corners of the box, shape (N,)."""
    best = np.full(len(b), np.inf)
    units = np.sqrt(priority)
    for chosen in itertools.product((0.0, 1.0), repeat=b.shape[1]):
        rows, offsets = a * (units * chosen)[None, :, None], b * units * chosen
        for face in itertools.product((-1, 0, 1), repeat=2):
            fixed = np.array(face) != 0
            u = np.where(np.array(face) < 0, low, high) * fixed
            rest = offsets + dot(rows, u)
            free = rows * ~fixed
            u = u - np.einsum("nji,ni->nj", np.linalg.pinv(free), rest)
            u = np.where(
                np.all((u >= low - 1e-12) & (u <= high + 1e-12), axis=1)[:, None],
                np.clip(u, low, high),
                np.nan,
            )
            best = np.fmin(best, (priority * np.minimum(dot(a, u) + b, 0.0) ** 2).sum(axis=1))
    return best


def random_batch(rng, size, k, kind):
    a, b, v = (
        rng.normal(size=(size, k, 2)),
        rng.normal(size=(size, k)) * 0.7,
        rng.normal(size=(size, 2)) * 2,
    )
    low, high = np.tile(LOW, (size, 1)), np.tile(HIGH, (size, 1))
    w = 10.0 ** rng.uniform(-1, 1, (size, 2))
    if kind == "sizes":
        scale = 10.0 ** rng.uniform(-3, 6, (size, k))
        a, b = a * scale[:, :, None], b * scale
    if kind == "flat":
        a[rng.random((size, k, 2)) < 0.4] = 0.0
    if kind == "integers":  # crossings, duplicates, opposite rows and corners that coincide exactly
        a, b = rng.integers(-2, 3, (size, k, 2)) * 1.0, rng.integers(-2, 3, (size, k)) * 1.0
        v, low, high, w = (
            rng.integers(-3, 4, (size, 2)) * 1.0,
            -np.ones((size, 2)),
            np.ones((size, 2)),
            np.ones((size, 2)),
        )
    if kind == "thousands":
        a[:, :, 0] /= 5000.0
        low[:, 0], high[:, 0], v[:, 0] = -5000.0, 5000.0, v[:, 0] * 5000.0
        w[:, 1] = 10.0 ** rng.uniform(-4, 8, size)
    if kind == "endless":
        low, high = (
            -(10.0 ** rng.choice([8, 100], (size, 2))),
            10.0 ** rng.choice([8, 100], (size, 2)),
        )
        low[rng.random((size, 2)) < 0.3] = 0.0
    if kind == "far":
        v *= 10.0 ** rng.uniform(0, 6, (size, 1))
    return a, b, v, low, high, w
