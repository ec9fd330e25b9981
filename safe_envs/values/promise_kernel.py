"""The least number whose bounded expectation is a wanted level, as a kernel."""

from __future__ import annotations

from math import inf

import numpy as np

from safe_envs.values.expected_value_kernel import box_value, move_by_inputs

_ROUNDS = 60


def kept_values(  # noqa: PLR0913
    first: int,
    last: int,
    images: np.ndarray,
    effects: np.ndarray,
    inputs: np.ndarray,
    weights: np.ndarray,
    layers: np.ndarray,
    tables: np.ndarray,
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
    shifts: np.ndarray,
    values: np.ndarray,
    levels: np.ndarray,
    expected: np.ndarray,
    caps: np.ndarray,
) -> None:
    """Bound expected values, and find the least c for which E min(c, L) is a wanted level.

    The bound is B(c) = sum_w P(w) min(c, v_w) with the least value v_w of the cells that box w of
    the noise leads to, for the worst scenario. B is concave and piecewise linear: Newton's method
    from the left ends after a few steps.

    Args:
        first: state to begin with.
        last: state to end before.
        images: see `bellman_kernel`, shape (B, 1, R, W, n, 2).
        effects: see there.
        inputs: one for each state, shape (B, 1, m, 2).
        weights: probability of each box of the noise, shape (W,).
        layers: which of the tables to take for each state, shape (B,).
        tables: values of the next control instant, shape (T, cells).
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
        shifts: scratch array of 8 entries.
        values: scratch array (W,).
        levels: that are wanted, shape (B,).
        expected: receives the lower bounds of the expected values, shape (B,).
        caps: receives c, inf where no number is enough, shape (B,).
    """
    n = effects.shape[2]
    for a in range(first, last):
        cap, worst = levels[a], inf
        for r in range(images.shape[2]):
            move_by_inputs(a, r, a, 0, effects, inputs, scales, shifts)
            total = 0.0
            for w in range(images.shape[3]):
                values[w] = box_value(
                    images[a, 0, r, w], n, shifts, layers[a], tables, counts, places, edges, scales
                )
                total += weights[w] * values[w]
            worst = min(worst, total)
            cap = capped_at(levels[a], cap, values, weights) if total > levels[a] else inf
        expected[a], caps[a] = worst, cap


def capped_at(level: float, cap: float, values: np.ndarray, weights: np.ndarray) -> float:
    """Return the least number, no less than one that is too small, whose bound is the level.

    Args:
        level: that is wanted.
        cap: the number to begin with.
        values: of the boxes of noise, shape (W,).
        weights: their probabilities, shape (W,).
    """
    for _ in range(_ROUNDS):
        bound, slope = 0.0, 0.0
        for w in range(len(weights)):
            if values[w] > cap:
                bound += weights[w] * cap
                slope += weights[w]
            else:
                bound += weights[w] * values[w]
        if bound >= level:
            return cap
        if slope <= 0.0:
            return inf
        # A little more than the root, for rounding.
        cap += (level - bound) / slope * (1.0 + 1e-9) + 1e-16
    return inf
