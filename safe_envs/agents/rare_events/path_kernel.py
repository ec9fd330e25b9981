"""Paths from their last records to a violation or to their end, in one compiled function.

See also `safe_envs.engine.slots`.
"""

from __future__ import annotations

import numpy as np

from safe_envs.agents.evaluation.episode_kernel import is_finite_input
from safe_envs.dynamics.noise import BRIDGE, NOISE
from safe_envs.engine.draws import draw_start, fill_normals, fill_uniforms, store_row
from safe_envs.engine.slots import (
    State,
    act,
    advance,
    barriers_of,
    decide,
    has_ended,
    is_finite,
    measure,
    observation_of,
    resting_input,
)


def state_in(row: np.ndarray) -> State:
    """Return the state that an array holds."""
    raise NotImplementedError


def tilt_direction(x: State, barriers: tuple[float, ...], data: np.ndarray) -> tuple[float, ...]:
    """Return the direction in which the smallest barrier rises fastest; see `TiltedNoiseEnv`.

    It has an entry for each noise channel, and a single one, 0, without noise.
    """
    raise NotImplementedError


def lowest_relative(
    x: State,
    before: tuple[float, ...],
    after: tuple[float, ...],
    units: np.ndarray,
    uniforms: np.ndarray,
    first: int,
    data: np.ndarray,
) -> float:
    """Return the smallest h that counts in a control period, relative to the units of the barriers.

    Args:
        x: state at its beginning.
        before: barriers there.
        after: barriers at its end.
        units: of the barriers.
        uniforms: numbers in [0, 1); from `first` on there is one for each barrier, if any is used.
        first: where those of this period begin.
        data: numbers of the program.
    """
    raise NotImplementedError


DONE = 0
FULL = 1
FAILED = 2


def draw_path_starts(
    keys: np.ndarray,
    states: np.ndarray,
    barriers: np.ndarray,
    data: np.ndarray,
    uniforms: np.ndarray,
) -> int:
    """Draw the starts of paths, up to the first path that has none.

    Args:
        keys: of the paths, uint64 (B,).
        states: receives the states, (B, n).
        barriers: receives the barriers there, (B, k).
        data: numbers of the program.
        uniforms: scratch array, with an entry for each uniform of the distribution.

    Returns:
        How many paths have one.
    """
    for row in range(len(keys)):
        x = draw_start(keys[row], 0, 0, uniforms, data)
        values = measure(x, resting_input(data), 0.0, data)
        if not is_finite(x, values):
            return row
        store_row(states[row], x)
        store_row(barriers[row], barriers_of(values))
    return len(keys)


def play_paths(  # noqa: PLR0913
    paths: np.ndarray,
    keys: np.ndarray,
    kinds: np.ndarray,
    weights: np.ndarray,
    units: np.ndarray,
    sizes: tuple[int, int, int],
    scales: tuple[float, float, float],
    count: np.ndarray,
    heights: np.ndarray,
    instants: np.ndarray,
    ended: np.ndarray,
    states: np.ndarray,
    integrals: np.ndarray,
    ends: np.ndarray,
    outcomes: np.ndarray,
    data: np.ndarray,
    noise: np.ndarray,
    bridge: np.ndarray,
    work: np.ndarray,
) -> int:
    """Play paths.

    Each goes on from its last record to a violation, to the end of the episode, or until there is
    no room for a record; then it can go on from its last one again.

    Args:
        paths: their numbers, int64 (B,).
        keys: of all paths, uint64 (paths,), which give their noise.
        kinds: columns of `weights` for all paths, int64 (paths,).
        weights: heights over the smallest relative barriers, for each control instant, (steps + 1,
            kinds).
        units: of the barriers, (k,).
        sizes: control periods that are drawn ahead, a multiple of 4, and standard normals and
            uniforms of the bridges for each.
        scales: control period in s, length of the drift against h in 1/sqrt(s), and root of the
            integration step in sqrt(s).
        count: as in `Records`, of all paths; so are the following.
        heights: see above.
        instants: see above.
        ended: see above.
        states: see above.
        integrals: see above.
        ends: receives the last control instant of each path, int64 (paths,).
        outcomes: receives `DONE`, `FULL` (no room) or `FAILED` (what NumPy has an error for), int64
            (paths,).
        data: numbers of the program.
        noise: scratch array for the normals that are drawn ahead.
        bridge: the same for the uniforms of the bridges.
        work: scratch array.

    Returns:
        How many paths there are.
    """
    for i in range(len(paths)):
        path = int(paths[i])
        ends[path], outcomes[path], count[path] = play_path(
            keys[path],
            weights[:, kinds[path]],
            units,
            sizes,
            scales,
            count[path],
            heights[path],
            instants[path],
            ended[path],
            states[path],
            integrals[path],
            data,
            noise,
            bridge,
            work,
        )
    return len(paths)


def play_path(  # noqa: PLR0913
    key: int,
    weights: np.ndarray,
    units: np.ndarray,
    sizes: tuple[int, int, int],
    scales: tuple[float, float, float],
    count: int,
    heights: np.ndarray,
    instants: np.ndarray,
    ended: np.ndarray,
    states: np.ndarray,
    integrals: np.ndarray,
    data: np.ndarray,
    noise: np.ndarray,
    bridge: np.ndarray,
    work: np.ndarray,
) -> tuple[int, int, int]:
    """Play a path; return its last control instant, the outcome, and the number of its records.

    For the arguments see `play_paths`.
    """
    ahead, channels, draws = sizes
    dt, length, root = scales
    steps, row = len(weights) - 1, count - 1
    lowest, begin = heights[row], instants[row]
    if lowest <= 0.0 or ended[row]:
        return begin, DONE, count
    across, along = integrals[row, 0], integrals[row, 1]
    x = before = state_in(states[row])
    action = resting_input(data)
    barriers = barriers_of(measure(x, action, begin * dt, data))
    drawn = ahead
    # A state is read in the period that it begins, so that functions of it are computed once.
    for k in range(begin, steps + 1):
        values = measure(x, action, k * dt, data)
        after = barriers_of(values)
        if k > begin:
            if not is_finite(x, values):
                return k, FAILED, row + 1
            place = (drawn - 1) * draws
            height = lowest_relative(before, barriers, after, units, bridge, place, data)
            height *= weights[k]
            over = has_ended(values) or k == steps
            if height < lowest:
                lowest = height
                row += 1
                if row == len(heights):
                    return k, FULL, row
                heights[row], instants[row], ended[row] = height, k, over
                integrals[row, 0], integrals[row, 1] = across, along
                store_row(states[row], x)
            if over or lowest <= 0.0:
                return k, DONE, row + 1
        if drawn == ahead:
            # Blocks of the streams have four words.
            drawn = k % 4
            fill_normals(noise, (k - drawn) * channels, 0, NOISE, key, 0)
            fill_uniforms(bridge, (k - drawn) * draws, 0, BRIDGE, key, 0)
        proposed = act(observation_of(values), k, key, 0, data, work)
        action, _, _, _, _, _, sound = decide(x, proposed, data, work)
        if not (sound and is_finite_input(proposed)):
            return k, FAILED, row + 1
        if channels:
            direction = tilt_direction(x, after, data)
            added = tilt(noise, drawn * channels, channels, direction, length * root)
            across += root * added[0]
            along += root * root * added[1]
        before, barriers = x, after
        x = advance(x, action, noise, drawn * channels, data)
        drawn += 1
    return steps, DONE, row + 1


def tilt(
    noise: np.ndarray, place: int, channels: int, direction: tuple[float, ...], shift: float
) -> tuple[float, float]:
    """Add the drift to the standard normals z of a period.

    Args:
        noise: standard normals, which are changed.
        place: of the first one.
        channels: how many there are, substep by substep.
        direction: e.
        shift: by which they move against it.

    Returns:
        The sums of e z, with the drift in z, and of e e.
    """
    across, along = 0.0, 0.0
    for i in range(channels):
        e = direction[i % len(direction)]
        noise[place + i] -= shift * e
        across += e * noise[place + i]
        along += e * e
    return across, along
