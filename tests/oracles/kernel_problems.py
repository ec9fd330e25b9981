"""QPs of any size for the kernels: ordinary, degenerate and of all scales."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safe_envs.engine.qp.dispatch import project_arrays

KINDS = [
    "plain",
    "unmet",
    "sizes",
    "flat",
    "integers",
    "parallel",
    "thousands",
    "endless",
    "far",
    "touching",
]


class Problems(NamedTuple):
    """a (N, k, m), b (N, k), v, low, high and w (N, m), priority (k,)."""

    a: np.ndarray
    b: np.ndarray
    v: np.ndarray
    low: np.ndarray
    high: np.ndarray
    w: np.ndarray
    priority: np.ndarray


class Answers(NamedTuple):
    """u (N, m), margin and active (N, k), feasible (N,)."""

    u: np.ndarray
    margin: np.ndarray
    active: np.ndarray
    feasible: np.ndarray


def random_problems(rng, size, k, m, kind):
    a, b = rng.normal(size=(size, k, m)), rng.normal(size=(size, k)) * 0.7
    v, w = rng.normal(size=(size, m)) * 2, 10.0 ** rng.uniform(-1, 1, (size, m))
    low, high = -rng.uniform(0.5, 1.5, (size, m)), rng.uniform(0.5, 2.0, (size, m))
    if kind == "unmet":
        b -= 1.8 * np.abs(a).max(axis=2) * rng.random((size, k))
    if kind == "sizes":
        scale = 10.0 ** rng.uniform(-8, 8, (size, k))
        a, b = a * scale[:, :, None], b * scale
    if kind == "flat":  # inputs that no row mentions, and rows that mention no input
        a[rng.random(a.shape) < 0.4] = 0.0
    if kind == "integers":  # crossings, duplicates and corners that coincide exactly
        a, b = rng.integers(-2, 3, a.shape) * 1.0, rng.integers(-2, 3, b.shape) * 1.0
        v, w = rng.integers(-3, 4, v.shape) * 1.0, np.ones((size, m))
        low, high = -np.ones((size, m)), np.ones((size, m))
    if kind == "parallel":  # duplicates and opposite rows, redundant ones among them
        for i in range(1, k):
            chosen, factor = rng.random(size) < 0.7, rng.choice([-1.0, 1.0, 2.0, -0.5], size)
            a[chosen, i] = a[chosen, 0] * factor[chosen, None]
            meeting = chosen & (rng.random(size) < 0.3)
            b[meeting, i] = (b[:, 0] * factor)[meeting]
    if kind == "thousands":
        a[:, :, 0] /= 5000.0
        for part in (v, low, high):
            part[:, 0] *= 5000.0
        w[:, -1] = 10.0 ** rng.uniform(-4, 8, size)
    if kind == "endless":
        half = 10.0 ** rng.choice([8, 100], (size, m))
        low, high = np.where(rng.random((size, m)) < 0.3, 0.0, -half), half
    if kind == "far":
        v *= 10.0 ** rng.uniform(0, 8, (size, 1))
    if kind == "touching":  # rows through one point, at times a corner of the box
        point = np.where(
            rng.random((size, m)) < 0.3, high, low + (high - low) * rng.random((size, m))
        )
        b = -(a @ point[:, :, None])[:, :, 0]
    return Problems(a, b, v, low, high, w, 10.0 ** rng.uniform(-1, 1, k))


def reference(problems):
    """What the dispatcher says."""
    a, b, v, low, high, w, priority = problems
    rows = [list(row) for row in a.transpose(1, 2, 0).copy()]
    columns = [list(part.T.copy()) for part in (b, v, low, high, w)]
    u, margin, active, feasible = project_arrays(rows, *columns, priority.tolist())
    return Answers(np.array(u).T, np.array(margin).T, np.array(active).T, feasible)


def solve(kernel, length, problems):
    """What a kernel says, one problem after the other, in a scratch array that holds rubbish."""
    a, b, v, low, high, w, priority = problems
    size, k, m = a.shape
    found = Answers(np.empty((size, m)), np.empty((size, k)), np.empty((size, k)), np.empty(size))
    work = np.full(length, np.nan)
    for i in range(size):
        u, margin, active = found.u[i], found.margin[i], found.active[i]
        found.feasible[i] = kernel(
            a[i], b[i], v[i], low[i], high[i], w[i], priority, u, margin, active, work
        )
    return found


def differences(found, expected, problems):
    """The largest errors of inputs and of margins, relative to their terms, and which problems have
    another flag (N,)."""
    reach = np.maximum(np.abs(expected.u), 1e-3 * (problems.high - problems.low).clip(max=1.0))
    terms = (np.abs(problems.a) @ np.abs(expected.u)[:, :, None])[:, :, 0] + np.abs(problems.b)
    flags = (found.active != expected.active).any(axis=1) | (found.feasible != expected.feasible)
    return (
        (np.abs(found.u - expected.u) / reach).max(),
        (np.abs(found.margin - expected.margin) / np.maximum(terms, 1e-300)).max(),
        flags,
    )
