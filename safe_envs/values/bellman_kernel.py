"""The Bellman operator on the cells of a grid, as kernels.

A state goes to one of a number of boxes, each with a probability; what is taken of a box is the
least value of the cells that it touches. Upper envelopes are computed as lower ones of their
negative values.

`images` holds for each state, input, scenario of the uncertain parameters, and box of the noise the
ends of each coordinate, without what an input adds in proportion; `effects` holds the ends of the
proportion for each state, scenario, coordinate and input. `counts`, `places` and `scales` describe
a grid: see `GridArrays`.
"""

from __future__ import annotations

from math import inf

import numpy as np

from safe_envs.values.expected_value_kernel import expected_value

_LOSS = 0.0001
"""Of the value of a state in a step, for which it does not pay to try all inputs."""


def expected_values(  # noqa: PLR0913
    first: int,
    last: int,
    images: np.ndarray,
    effects: np.ndarray,
    inputs: np.ndarray,
    weights: np.ndarray,
    layers: np.ndarray,
    tables: np.ndarray,
    rest: float,
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
    shifts: np.ndarray,
    found: np.ndarray,
) -> None:
    """Bound the expected value of states under inputs from below.

    Args:
        first: state to begin with.
        last: state to end before.
        images: see the module, shape (B, 1 or V, R, W, n, 2).
        effects: see the module, shape (B, R, n, m, 2).
        inputs: ends of each input, shape (B or 1, V, m, 2).
        weights: probability of each box of the noise, shape (W,).
        layers: which of the tables to take for each state, shape (B,).
        tables: values of the next control instant, shape (T, cells).
        rest: what the noise beyond all boxes adds.
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
        shifts: scratch array of 8 entries.
        found: receives the bounds, shape (B, V).
    """
    several = images.shape[1] > 1
    own = inputs.shape[0] > 1
    for a in range(first, last):
        for u in range(inputs.shape[1]):
            found[a, u] = expected_value(
                a,
                u if several else 0,
                a if own else 0,
                u,
                images,
                effects,
                inputs,
                weights,
                layers[a],
                tables,
                rest,
                counts,
                places,
                edges,
                scales,
                shifts,
            )


def sweep_lower(  # noqa: PLR0913
    first: int,
    last: int,
    turn: int,
    images: np.ndarray,
    effects: np.ndarray,
    inputs: np.ndarray,
    weights: np.ndarray,
    tables: np.ndarray,
    rest: float,
    neighbours: np.ndarray,
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
    shifts: np.ndarray,
    best: np.ndarray,
    found: np.ndarray,
) -> None:
    """Maximise the bound of the expected value over some of the inputs.

    Any input gives a lower envelope. The best one of the last sweep and, in turn, one next to it or
    any other find nearly the maximum of all; where they lose much, all inputs are tried.

    Args:
        first: state to begin with.
        last: state to end before.
        turn: number of the sweep.
        images: see `expected_values`, as for all others.
        effects: see there.
        inputs: see there, shape (1, U, m, 2).
        weights: see there.
        tables: see there.
        rest: see there.
        neighbours: of each input, shape (U, N), -1 for none.
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
        shifts: scratch array of 8 entries.
        best: the best input of the last sweep, which is replaced, shape (B,); -1 where none is
            wanted.
        found: holds values that are good enough, and receives the bounds, shape (B,).
    """
    several = images.shape[1] > 1
    tried = inputs.shape[1]
    for a in range(first, last):
        if best[a] < 0:
            continue
        largest, chosen = -inf, int(best[a])
        few = 1 + turn % 2
        # The number of inputs is small where nothing is lost, and nothing can be won then.
        for j in range(few + tried):
            if j == few and largest >= found[a] - _LOSS:
                break
            if j >= few:
                u = j - few
            elif j == 0:
                u = chosen
            elif turn % 8 == 1:
                u = (7 * a + turn // 8) % tried
            else:
                u = int(neighbours[chosen, (a + turn // 2) % neighbours.shape[1]])
            if u >= 0:
                value = expected_value(
                    a,
                    u if several else 0,
                    0,
                    u,
                    images,
                    effects,
                    inputs,
                    weights,
                    0,
                    tables,
                    rest,
                    counts,
                    places,
                    edges,
                    scales,
                    shifts,
                )
                if value > largest:
                    largest, chosen = value, u
                if j >= few and largest >= found[a]:
                    break
        best[a] = chosen
        found[a] = largest


def sweep_upper(  # noqa: PLR0913
    first: int,
    last: int,
    images: np.ndarray,
    effects: np.ndarray,
    inputs: np.ndarray,
    weights: np.ndarray,
    tables: np.ndarray,
    rest: float,
    counts: np.ndarray,
    places: np.ndarray,
    edges: np.ndarray,
    scales: np.ndarray,
    shifts: np.ndarray,
    known: np.ndarray,
    leader: np.ndarray,
    rival: np.ndarray,
    found: np.ndarray,
) -> None:
    """Maximise an upper bound of the expected value over all inputs.

    Upper envelopes do not rise backwards in time, so that what was found for an input in an earlier
    sweep is a bound still: only inputs whose bound is the largest are computed again.

    Args:
        first: state to begin with.
        last: state to end before.
        images: see `expected_values`, as for all others.
        effects: see there.
        inputs: boxes that cover all inputs, shape (1, U, m, 2).
        weights: see there.
        tables: see there; the negative values.
        rest: see there.
        counts: of the grid.
        places: of the grid.
        edges: of the grid.
        scales: of the grid.
        shifts: scratch array of 8 entries.
        known: upper bounds for each input, which are replaced, shape (B, U).
        leader: the input of the largest of them, which is replaced, shape (B,).
        rival: the largest bound of all others, which is replaced, shape (B,).
        found: receives the upper bounds, shape (B,).
    """
    several = images.shape[1] > 1
    tried = inputs.shape[1]
    for a in range(first, last):
        for _ in range(tried + 1):
            u = int(leader[a])
            value = -expected_value(
                a,
                u if several else 0,
                0,
                u,
                images,
                effects,
                inputs,
                weights,
                0,
                tables,
                rest,
                counts,
                places,
                edges,
                scales,
                shifts,
            )
            # Rounding may lift a bound by a little.
            settled = min(value, known[a, u])
            known[a, u] = settled
            if settled >= rival[a]:
                break
            largest, second, chosen = -inf, -inf, u
            for v in range(tried):
                bound = known[a, v]
                if bound > largest:
                    largest, second, chosen = bound, largest, v
                elif bound > second:
                    second = bound
            leader[a], rival[a] = chosen, second
            if chosen == u:
                break
        found[a] = known[a, leader[a]]
