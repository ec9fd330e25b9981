"""The search of a box of states for those where a function is largest, or zero.

SciPy's differential evolution in place of `search`, with the same populations and numbers of
rounds, was measured for 11 registered problems: slower for every one, 2 to 11 times, never with a
meaningfully larger supremum or shortfall, and with a smaller one for five. It has neither the
steps of all sizes, which follow ridges, nor periodic states.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from safe_envs.wrappers.verification.region import Region

Score = Callable[[np.ndarray], np.ndarray]
"""From states (B, n) to numbers (B,)."""

_ROUNDS = (240, 100)
_CONVERGED = 1e-13
_FINEST = -10.0
_POPULATION = 96
_ELITE = 8
_NEWTON = 8
_STEP = 1e-7


def largest(
    score: Score, points: np.ndarray, region: Region, rng: np.random.Generator
) -> tuple[float, np.ndarray]:
    """Return the largest score that is found, and the state (n,) that has it.

    Args:
        score: -inf or NaN where a state does not count.
        points: states to begin with, shape (B, n); some of them should count.
        region: where to look.
        rng: of all randomness.
    """
    population, values = search(score, points, region, rng)
    best = int(values.argmax())
    return float(values[best]), population[best]


def search(
    score: Score,
    points: np.ndarray,
    region: Region,
    rng: np.random.Generator,
    until: Callable[[np.ndarray], bool] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Differential evolution, twice: the final population and its scores.

    It begins with the best points and a few others, and again with what was best so far among
    random ones: a population that has gathered sees no other peak. Kinks in the score and the edge
    of the set make ridges here, on which gradients fail. Differences of members take on the shape
    of such a ridge.

    Args:
        score: see `largest`.
        points: see `largest`.
        region: see `largest`.
        rng: see `largest`.
        until: ends the search, given the scores of the population.
    """
    values = _scores(score, points)
    best = np.argsort(-values)[: _POPULATION // 2]
    x, value = _evolved(
        score, *_joined(points, values, best, region, score, rng), region, rng, _ROUNDS[0], until
    )
    if until is not None:
        return x, value
    elite = np.argsort(-value)[:_ELITE]
    tried, found = np.concatenate([x[elite], points]), np.concatenate([value[elite], values])
    return _evolved(
        score,
        *_joined(tried, found, np.arange(len(elite)), region, score, rng),
        region,
        rng,
        _ROUNDS[1],
        until,
    )


def _joined(
    points: np.ndarray,
    values: np.ndarray,
    chosen: np.ndarray,
    region: Region,
    score: Score,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return a population of the chosen points and others, of near ones where there are few."""
    counting = np.flatnonzero(np.isfinite(values))
    pool = counting if len(counting) else np.arange(len(points))
    others = rng.choice(pool, min(len(pool), _POPULATION - len(chosen)), replace=False)
    members = np.concatenate([chosen, others])
    x, value = points[members], values[members]
    if len(x) < _POPULATION:
        near = np.resize(x, (_POPULATION - len(x), x.shape[1]))
        near = region.inside(
            near + 1e-3 * (region.high - region.low) * rng.standard_normal(near.shape)
        )
        x, value = np.concatenate([x, near]), np.concatenate([value, _scores(score, near)])
    return x, value


def _evolved(
    score: Score,
    x: np.ndarray,
    value: np.ndarray,
    region: Region,
    rng: np.random.Generator,
    rounds: int,
    until: Callable[[np.ndarray], bool] | None,
) -> tuple[np.ndarray, np.ndarray]:
    for _ in range(rounds):
        lowest, highest = float(value.min()), float(value.max())
        if math.isfinite(lowest) and highest - lowest <= _CONVERGED * abs(highest):
            break
        if until is not None and until(value):
            break
        trial = region.inside(_moved(x, x[int(value.argmax())], region, rng))
        reached = _scores(score, trial)
        better = reached >= value
        x, value = np.where(better[:, None], trial, x), np.where(better, reached, value)
    return x, value


def _moved(x: np.ndarray, top: np.ndarray, region: Region, rng: np.random.Generator) -> np.ndarray:
    """Return a trial for each member, by a difference or by a normal step.

    A quarter begins at the best member, the others at themselves. Normal steps are of all
    sizes, along one axis or all: where a whole ridge is best, differences never get small.
    """
    size, n = x.shape
    base = np.where(rng.random((size, 1)) < 0.25, top, x)
    difference = rng.uniform(0.3, 1.0, (size, 1)) * (
        x[rng.permutation(size)] - x[rng.permutation(size)]
    )
    chosen = (rng.random((size, 1)) < 0.5) | (rng.integers(n, size=(size, 1)) == np.arange(n))
    length = (region.high - region.low) * 10.0 ** rng.uniform(_FINEST, 0.0, (size, 1))
    normal = length * chosen * rng.standard_normal((size, n))
    return base + np.where(rng.random((size, 1)) < 0.5, difference, normal)


def _scores(score: Score, x: np.ndarray) -> np.ndarray:
    values = score(x)
    return np.where(np.isnan(values), -np.inf, values)


def towards_zero(
    function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, region: Region
) -> np.ndarray:
    """Move states to where a function is zero by Newton's method; they may end where it is not.

    Args:
        function: from states (B, n) to values (B, m).
        x: states near its zeros, shape (B, n).
        region: where they have to stay.

    Returns:
        States, shape (B, n).
    """
    steps = _STEP * (region.high - region.low)
    for _ in range(_NEWTON):
        value = function(x)
        slopes = [(function(x + step) - value) / step.sum() for step in np.diag(steps)]
        jacobian = np.nan_to_num(np.stack(slopes, axis=2), posinf=0.0, neginf=0.0)
        shift = np.linalg.pinv(jacobian) @ np.nan_to_num(value, posinf=0.0, neginf=0.0)[:, :, None]
        x = region.inside(x - shift[:, :, 0])
    return x
