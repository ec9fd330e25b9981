"""The least number whose bounded expectation is a wanted level, as a kernel."""

from __future__ import annotations

from math import inf

import numpy as np

from safe_envs.values.expected_value_kernel import box_value, move_by_inputs

_ROUNDS = 60


def promise_expected(
    k: int, layer: int, rest: float, table: np.ndarray, data: np.ndarray, work: np.ndarray
) -> float:
    """Bound the expected next value under the tried input from below, for the worst scenario.

    Args:
        k: the control instant.
        layer: place of the first entry of a table.
        rest: what noise beyond all boxes adds.
        table: values.
        data: numbers of the program.
        work: scratch array.

    Returns:
        The bound.
    """
    boxes, weights, worst = int(data[AT_BOXES]), int(data[AT_WEIGHTS]), inf
    if data[AT_IS_AFFINE] == 0.0:
        promise_images(k, data, work)
    for r in range(int(data[AT_SCENARIOS])):
        promise_shifts(r, data, work)
        total = rest
        for w in range(boxes):
            value = promise_box(layer, r * boxes + w, table, data, work)
            total += data[weights + w] * value
        worst = min(worst, total)
    return worst


def promise_sufficient(
    k: int, layer: int, level: float, table: np.ndarray, data: np.ndarray, work: np.ndarray
) -> tuple[float, float]:
    """Return the bound under the tried input, and the least c for which E min(c, L) is a level.

    Args:
        k: the control instant.
        layer: place of the first entry of a table.
        level: that is wanted.
        table: values.
        data: numbers of the program.
        work: scratch array.
    """
    if data[AT_SEES_VALUES] == 0.0:
        return promise_expected(k, layer, 0.0, table, data, work), inf
    boxes, weights = int(data[AT_BOXES]), int(data[AT_WEIGHTS])
    cap, worst = level, inf
    if data[AT_IS_AFFINE] == 0.0:
        promise_images(k, data, work)
    for r in range(int(data[AT_SCENARIOS])):
        promise_shifts(r, data, work)
        total = 0.0
        for w in range(boxes):
            value = promise_box(layer, r * boxes + w, table, data, work)
            work[IN_ARRAYS + w] = value
            total += data[weights + w] * value
        worst = min(worst, total)
        cap = promise_capped(level, cap, data, work) if total > level else inf
    return worst, cap


def promise_capped(level: float, cap: float, data: np.ndarray, work: np.ndarray) -> float:
    """Return the least number, no less than one that is too small, whose bound is the level.

    Args:
        level: that is wanted.
        cap: the number to begin with.
        data: numbers of the program.
        work: scratch array with the values of the boxes of noise.
    """
    boxes, weights = int(data[AT_BOXES]), int(data[AT_WEIGHTS])
    for _ in range(CAP_ROUNDS):
        bound, slope = 0.0, 0.0
        for w in range(boxes):
            value, weight = work[IN_ARRAYS + w], data[weights + w]
            if value > cap:
                bound += weight * cap
                slope += weight
            else:
                bound += weight * value
        if bound >= level:
            return cap
        if slope <= 0.0:
            return inf
        # A little more than the root, for rounding.
        cap += (level - bound) / slope * (1.0 + 1e-9) + 1e-16
    return inf


def promise_scan(
    k: int,
    layer: int,
    rest: float,
    inputs: int,
    count: int,
    table: np.ndarray,
    data: np.ndarray,
    work: np.ndarray,
) -> int:
    """Put the bounds under several inputs into the scratch array; return the place of the largest.

    Args:
        k: the control instant.
        layer: place of the first entry of a table.
        rest: what noise beyond all boxes adds.
        inputs: place of the inputs.
        count: their number.
        table: values.
        data: numbers of the program.
        work: scratch array.

    Returns:
        Which of them has the largest bound, the first one of several.
    """
    m, values, best = int(data[AT_INPUTS]), IN_ARRAYS + int(data[AT_BOXES]), 0
    for v in range(count):
        for j in range(m):
            work[IN_TRIED + j] = data[inputs + v * m + j]
        work[values + v] = promise_expected(k, layer, rest, table, data, work)
        if work[values + v] > work[values + best]:
            best = v
    return best


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
