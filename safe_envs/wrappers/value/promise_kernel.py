"""The decision of a promise filter at one state, as kernels with flat arrays.

The operations are those of `PromiseFilter` and `PromiseMemory`, in the same order. Three tables are
only read: `ahead` and `above` hold the smoothed lower envelope and the smoothed negative upper one,
`lower` the lower envelope itself.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from safe_envs.wrappers.value.promise_bound_kernel import (
    promise_expected,
    promise_scan,
    promise_sufficient,
)
from safe_envs.wrappers.value.promise_cell_kernel import promise_cell
from safe_envs.wrappers.value.promise_layout import (
    AT_BOUNDS,
    AT_BOXES,
    AT_CELLS,
    AT_CELLS_SIZE,
    AT_COARSE,
    AT_COARSE_INPUTS,
    AT_COARSE_SPACING,
    AT_COORDINATES,
    AT_FIRST,
    AT_INPUTS,
    AT_MEANS_SIZE,
    AT_PROBABILITY,
    AT_REST,
    AT_SCANNED,
    AT_SCANNED_INPUTS,
    AT_SPACING,
    AT_STEPS,
    IN_ARRAYS,
    IN_CHOSEN,
    IN_ORIGIN,
    IN_POINT,
    IN_TRIED,
)
from safe_envs.wrappers.value.promise_slots import (
    promise_has_barriers,
    promise_images,
    promise_is_assumed,
    promise_is_safe,
    promise_point,
)

SEARCHES = 2
SHARES = 8
TINY_LENGTH = 1e-300


def promise_closest(
    inputs: int,
    count: int,
    level: float,
    u: tuple[float, ...],
    data: np.ndarray,
    work: np.ndarray,
) -> float:
    """Choose the input nearest to the proposed one whose bound is the level; return its bound.

    Where there is none it is the first one.

    Args:
        inputs: place of the inputs.
        count: their number.
        level: that is wanted.
        u: the proposed input.
        data: numbers of the program.
        work: scratch array with the bounds.

    Returns:
        The bound of the chosen input.
    """
    m, values = int(data[AT_INPUTS]), IN_ARRAYS + int(data[AT_BOXES])
    least, best = inf, 0
    for v in range(count):
        distance = 0.0
        for j in range(m):
            way = data[inputs + v * m + j] - u[j]
            distance += way * way
        if work[values + v] >= level and distance < least:
            least, best = distance, v
    for j in range(m):
        work[IN_CHOSEN + j] = data[inputs + best * m + j]
    return work[values + best]


def promise_nearer(  # noqa: PLR0913
    k: int,
    layer: int,
    level: float,
    found: float,
    spacing: float,
    u: tuple[float, ...],
    table: np.ndarray,
    data: np.ndarray,
    work: np.ndarray,
) -> float:
    """Go from the chosen input towards the proposed one; return the bound where that ends.

    Args:
        k: the control instant.
        layer: place of the first entry of a table.
        level: that is wanted.
        found: the bound of the chosen input.
        spacing: how far the inputs that were looked at are apart.
        u: the proposed input.
        table: values.
        data: numbers of the program.
        work: scratch array.

    Returns:
        The bound of the input that is chosen then.
    """
    m, bounds, total = int(data[AT_INPUTS]), int(data[AT_BOUNDS]), 0.0
    for j in range(m):
        work[IN_ORIGIN + j] = work[IN_CHOSEN + j]
        way = u[j] - work[IN_ORIGIN + j]
        total += way * way
    length = sqrt(total)
    width, gone = spacing / max(max(length, spacing), TINY_LENGTH), 0.0
    for _ in range(SEARCHES):
        for part in range(1, SHARES):
            share = gone + width * (float(SHARES - part) / float(SHARES))
            for j in range(m):
                point = work[IN_ORIGIN + j] + share * (u[j] - work[IN_ORIGIN + j])
                point = min(max(point, data[bounds + 2 * j]), data[bounds + 2 * j + 1])
                work[IN_TRIED + j] = point
            value = promise_expected(k, layer, 0.0, table, data, work)
            if value >= level:
                gone, found = share, value
                for j in range(m):
                    work[IN_CHOSEN + j] = work[IN_TRIED + j]
                break
        width = width / float(SHARES)
    return found


def promise_best(
    k: int, layer: int, ahead: np.ndarray, above: np.ndarray, data: np.ndarray, work: np.ndarray
) -> float:
    """Choose the scanned input of the largest bound; return the bound.

    Where the table says nothing, the upper envelope decides.

    Args:
        k: the control instant.
        layer: place of the first entry of a table.
        ahead: lower envelope, smoothed.
        above: negative upper envelope, smoothed.
        data: numbers of the program.
        work: scratch array.

    Returns:
        The bound of the chosen input.
    """
    m, bounds = int(data[AT_INPUTS]), int(data[AT_BOUNDS])
    inputs, count = int(data[AT_SCANNED_INPUTS]), int(data[AT_SCANNED])
    values = IN_ARRAYS + int(data[AT_BOXES])
    best = promise_scan(k, layer, 0.0, inputs, count, ahead, data, work)
    found = work[values + best]
    if found <= 0.0:
        promise_scan(k, layer, data[AT_REST], inputs, count, above, data, work)
        best = 0
        for v in range(count):
            if -work[values + v] > -work[values + best]:
                best = v
    for j in range(m):
        chosen = data[inputs + best * m + j]
        work[IN_CHOSEN + j] = min(max(chosen, data[bounds + 2 * j]), data[bounds + 2 * j + 1])
    return found


def promise_reached(
    x: tuple[float, ...], k: int, lower: np.ndarray, data: np.ndarray, work: np.ndarray
) -> float:
    """Return the lower envelope at a state, 0 outside the safe set.

    Args:
        x: components of the state.
        k: the control instant.
        lower: lower envelope.
        data: numbers of the program.
        work: scratch array with the coordinates.
    """
    cell = 0
    if not (promise_is_assumed(x, k, data) and promise_is_safe(x, k, data, work)):
        return 0.0
    for i in range(int(data[AT_COORDINATES])):
        axis, value = int(data[AT_CELLS]) + 8 * i, work[IN_POINT + i]
        count, first = int(data[axis]), int(data[axis + 1])
        place = promise_cell(value, axis, data)
        if place == count and value == data[first + count]:
            place = count - 1
        if place < 0 or place >= count:
            return 0.0
        cell = cell * count + place
    row = max(k - int(data[AT_FIRST]), 0)
    return float(lower[row * int(data[AT_CELLS_SIZE]) + cell])


def promise_decision(  # noqa: PLR0913
    x: tuple[float, ...],
    u: tuple[float, ...],
    instant: int,
    level: float,
    expected: float,
    cap: float,
    is_begun: bool,
    ahead: np.ndarray,
    above: np.ndarray,
    lower: np.ndarray,
    data: np.ndarray,
    work: np.ndarray,
) -> tuple[float, float, float, bool]:
    """Go on with what is remembered to a state, and choose an input there.

    Args:
        x: components of the state.
        u: components of the proposed input, within its bounds.
        instant: control periods that have passed.
        level: p_k of the decision before.
        expected: q_k of the input that it chose.
        cap: what no p_{k+1} needs to exceed, inf where no number is known.
        is_begun: whether there was a decision before.
        ahead: lower envelope, smoothed.
        above: negative upper envelope, smoothed.
        lower: lower envelope.
        data: numbers of the program.
        work: scratch array; receives the chosen input.

    Returns:
        q_k, p_k and the cap for the next decision, and whether the proposed input is replaced.
    """
    last = int(data[AT_STEPS]) - 1
    k, m = min(instant, last), int(data[AT_INPUTS])
    layer = max(k + 1 - int(data[AT_FIRST]), 0) * int(data[AT_MEANS_SIZE])
    inputs, count = int(data[AT_SCANNED_INPUTS]), int(data[AT_SCANNED])
    values = IN_ARRAYS + int(data[AT_BOXES])
    is_assumed, replaced = promise_is_assumed(x, k, data), True
    promise_point(x, data, work)
    promise_images(k, data, work)
    if is_begun:
        reached = promise_reached(x, min(instant, last + 1), lower, data, work)
        wanted = cap if cap < inf else level / (expected if level > 0.0 else 1.0) * reached
        level = min(max(wanted, 0.0), reached) if level > 0.0 else 0.0
    else:
        best = promise_scan(k, layer, 0.0, inputs, count, ahead, data, work)
        largest = work[values + best]
        is_safe = promise_has_barriers(x, data)
        level = min(largest, data[AT_PROBABILITY]) if is_safe and largest > 0.0 else 0.0
    level = level if is_assumed and instant <= last else 0.0
    for j in range(m):
        work[IN_TRIED + j], work[IN_CHOSEN + j] = u[j], u[j]
    expected, cap = promise_sufficient(k, layer, level, ahead, data, work)
    if expected >= level and level > 0.0:
        replaced = False
    elif level > 0.0:
        coarse, few = int(data[AT_COARSE_INPUTS]), int(data[AT_COARSE])
        promise_scan(k, layer, 0.0, coarse, few, ahead, data, work)
        expected, spacing = (
            promise_closest(coarse, few, level, u, data, work),
            data[AT_COARSE_SPACING],
        )
        # What is between these inputs decides where none of them is allowed.
        if expected < level:
            best = promise_scan(k, layer, 0.0, inputs, count, ahead, data, work)
            level, spacing = min(level, max(work[values + best], 0.0)), data[AT_SPACING]
            expected = promise_closest(inputs, count, level, u, data, work)
        if level > 0.0:
            expected = promise_nearer(k, layer, level, expected, spacing, u, ahead, data, work)
            for j in range(m):
                work[IN_TRIED + j] = work[IN_CHOSEN + j]
            _, cap = promise_sufficient(k, layer, level, ahead, data, work)
    if level <= 0.0:
        expected = promise_best(k, layer, ahead, above, data, work)
        expected = expected if is_assumed else 0.0
    return expected, level, cap, replaced
