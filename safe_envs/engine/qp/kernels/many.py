"""`safe_envs.engine.qp.dispatch` for one state: several constraints on three and more inputs.

Where one constraint binds at most, its closed form; else the constraints and bounds that the method
of Goldfarb and Idnani finds, if the point of their equations nearest to the proposal proves to be
the minimiser; else, in particular where the constraints cannot be met together, the nearest of the
least-violating actions.

It begins at the clipped proposal, the minimiser under the input bounds alone, and takes in one
missed constraint or bound after the other; on the way, those are let go whose pressures would
change their sign.

Source: D. Goldfarb, A. Idnani, A numerically stable dual method for solving strictly convex
    quadratic programs, Mathematical Programming 27, 1983.

In an orthonormal basis of the constraints, in which the problem has full rank.

Vectors are rows of a table. Those that are taken count, and of these the entries that are free,
where `at` is 0. One that depends on those before it is left out, up to rounding.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from safe_envs.engine.plain_natives import table_view, vector_view
from safe_envs.engine.qp.kernels.one_constraint import (
    project_single_active,
    row_margin,
    row_tolerance,
    work_of_single_active,
)

DEPENDENT = 1e-14
"""Part of a vector that the rounding of others leaves of it."""


def span_of_rows(
    rows: np.ndarray,
    taken: np.ndarray,
    at: np.ndarray,
    basis: np.ndarray,
    triangle: np.ndarray,
    order: np.ndarray,
) -> int:
    """Orthonormalise vectors: each is the sum of `triangle` times `basis`, up to its own place.

    Args:
        rows: the vectors, at least as many as `taken` says, of n entries.
        taken: positive for those that count.
        at: 0 for free entries, shape (n,).
        basis: receives the basis, as many rows as can be independent.
        triangle: receives the coefficients, the vectors in columns.
        order: receives the number of the vector for each one of the basis.

    Returns:
        How many are in the basis.
    """
    n, count, most = len(at), 0, min(len(order), len(at))
    for i in range(len(taken)):
        if taken[i] > 0.0 and count < most:
            size = 0.0
            for j in range(n):
                basis[count, j] = rows[i, j] if at[j] == 0.0 else 0.0
                size += basis[count, j] * basis[count, j]
            for c in range(count):
                triangle[c, count] = 0.0
            for _ in range(2):  # the second time takes back the rounding of the first
                for c in range(count):
                    share = 0.0
                    for j in range(n):
                        share += basis[c, j] * basis[count, j]
                    triangle[c, count] += share
                    for j in range(n):
                        basis[count, j] -= share * basis[c, j]
            left = 0.0
            for j in range(n):
                left += basis[count, j] * basis[count, j]
            if left > DEPENDENT * DEPENDENT * size:
                length = sqrt(left)
                for j in range(n):
                    basis[count, j] /= length
                triangle[count, count] = length
                order[count] = i
                count += 1
    return count


def split_along_span(
    count: int,
    vector: np.ndarray,
    at: np.ndarray,
    basis: np.ndarray,
    triangle: np.ndarray,
    shares: np.ndarray,
    rest: np.ndarray,
) -> None:
    """Write the free entries of a vector as a sum of vectors and a rest that is normal to them.

    Args:
        count: how many are in the basis.
        vector: the vector, shape (n,).
        at: 0 for free entries, shape (n,).
        basis: see `span_of_rows`.
        triangle: see there.
        shares: receives the coefficients of the vectors in the basis, in its order.
        rest: receives the rest, 0 for entries that are not free, shape (n,).
    """
    n = len(at)
    for j in range(n):
        rest[j] = vector[j] if at[j] == 0.0 else 0.0
    for c in range(count):
        shares[c] = 0.0
    for _ in range(2):
        for c in range(count):
            share = 0.0
            for j in range(n):
                share += basis[c, j] * rest[j]
            shares[c] += share
            for j in range(n):
                rest[j] -= share * basis[c, j]
    for back in range(count):
        c = count - 1 - back
        for d in range(c + 1, count):
            shares[c] -= triangle[c, d] * shares[d]
        shares[c] /= triangle[c, c]


def least_step_in_span(
    count: int,
    values: np.ndarray,
    basis: np.ndarray,
    triangle: np.ndarray,
    step: np.ndarray,
) -> None:
    """Find the shortest step along which the vectors in the basis have given products.

    Args:
        count: how many are in the basis.
        values: the products, in the order of the basis, which are overwritten.
        basis: see `span_of_rows`.
        triangle: see there.
        step: receives the step, shape (n,).
    """
    for j in range(len(step)):
        step[j] = 0.0
    for c in range(count):
        for d in range(c):
            values[c] -= triangle[d, c] * values[d]
        values[c] /= triangle[c, c]
        for j in range(len(step)):
            step[j] += values[c] * basis[c, j]


def normals_of_rows(
    a: np.ndarray, w: np.ndarray, normals: np.ndarray, unit: np.ndarray, roots: np.ndarray
) -> None:
    """Write the constraints in inputs times the roots of their weights, with unit length.

    Args:
        a: constraints, shape (k, m).
        w: positive weights, shape (m,).
        normals: receives the constraints, shape (k, m).
        unit: receives their lengths, 0 for those that say nothing of the input, shape (k,).
        roots: receives the roots, shape (m,).
    """
    k, m = a.shape
    for j in range(m):
        roots[j] = sqrt(w[j])
    for i in range(k):
        size, square = 0.0, 0.0
        for j in range(m):
            normals[i, j] = a[i, j] / roots[j]
            size = max(size, abs(normals[i, j]))
        if size > 0.0:
            for j in range(m):
                normals[i, j] /= size  # so that squares neither overflow nor vanish
                square += normals[i, j] * normals[i, j]
            for j in range(m):
                normals[i, j] /= sqrt(square)
        unit[i] = size * sqrt(square)


BINDING_STEPS = 10
"""Steps for each constraint and input: many times more than were ever seen."""
NO_WAY = 1e-12
"""Part of a constraint of unit length that rounding leaves."""
BOUNDLESS = 1.7976931348623157e308
"""Length of a step that nothing stops."""


def work_of_binding(k: int, m: int) -> int:
    """Return the length of the scratch array of `find_binding`.

    Args:
        k: number of constraints.
        m: number of inputs.
    """
    return 2 * (m * m + 3 * m + k)


def find_binding(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    roots: np.ndarray,
    normals: np.ndarray,
    unit: np.ndarray,
    u: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Find what holds the minimiser.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        roots: of the weights, shape (m,).
        normals: constraints of unit length, over the roots, shape (k, m).
        unit: their lengths, 0 for those that say nothing of the input, shape (k,).
        u: receives the minimiser, up to rounding, shape (m,).
        rows: receives which constraints hold it, 1 or 0, shape (k,).
        at: receives which bounds do, -1 for a lower and 1 for an upper one, shape (m,).
        work: scratch of `work_of_binding`.

    Returns:
        Whether the method came to an end. It does not where the constraints contradict each other.
    """
    k, m = len(b), len(v)
    basis, triangle = table_view(work, 0, m, m), table_view(work, m * m, m, m)
    place = 2 * m * m
    order, shares = vector_view(work, place, m), vector_view(work, place + m, m)
    step, normal = vector_view(work, place + 2 * m, m), vector_view(work, place + 3 * m, m)
    pressure = vector_view(work, place + 4 * m, k + m)
    rate = vector_view(work, place + 5 * m + k, k + m)
    for i in range(k):
        rows[i] = pressure[i] = 0.0
    for j in range(m):
        u[j] = low[j] if v[j] < low[j] else high[j] if v[j] > high[j] else v[j]
        at[j] = -1.0 if v[j] < low[j] else 1.0 if v[j] > high[j] else 0.0
        pressure[k + j] = abs(v[j] - u[j]) * roots[j]
    new, side = -1, 0.0
    for _ in range(BINDING_STEPS * (k + m)):
        if new < 0:
            new = furthest_outside(a, b, low, high, roots, unit, rows, u)
            if new < 0:
                return True
            pressure[new] = 0.0
            side = normal_of_new(new, normals, low, u, normal)
        count = span_of_rows(normals, rows, at, basis, triangle, order)
        split_along_span(count, normal, at, basis, triangle, shares, step)
        length, first = how_far_pressures_allow(
            count, normals, normal, at, order, shares, pressure, rate
        )
        if new < k:
            missing = -row_margin(a, new, b[new], u) / unit[new]
        else:
            missing = max(low[new - k] - u[new - k], u[new - k] - high[new - k]) * roots[new - k]
        square = 0.0
        for j in range(m):
            square += step[j] * step[j]
        moves = square > NO_WAY * NO_WAY
        whole = max(missing, 0.0) / square if moves else BOUNDLESS
        if first < 0 and not moves:
            return False
        taken = min(length, whole)
        for c in range(k + m):
            pressure[c] = max(pressure[c] - taken * rate[c], 0.0)
        pressure[new] += taken
        if moves:
            for j in range(m):
                u[j] += taken * step[j] / roots[j]
        if whole <= length:
            if new < k:
                rows[new] = 1.0
            else:
                at[new - k] = side
                u[new - k] = low[new - k] if side < 0.0 else high[new - k]
            new = -1
        elif first < k:
            rows[first] = 0.0
        else:
            at[first - k] = 0.0
    return False


def normal_of_new(
    new: int, normals: np.ndarray, low: np.ndarray, u: np.ndarray, normal: np.ndarray
) -> float:
    """Write the normal of a missed constraint or bound.

    Args:
        new: the constraint, or k plus the input.
        normals: constraints of unit length, shape (k, m).
        low: lower bounds, shape (m,).
        u: inputs, shape (m,).
        normal: receives it, shape (m,).

    Returns:
        -1 for a lower bound, 1 for an upper one, 0 for a constraint.
    """
    k = len(normals)
    for j in range(len(u)):
        normal[j] = normals[new, j] if new < k else 0.0
    if new < k:
        return 0.0
    side = -1.0 if u[new - k] < low[new - k] else 1.0
    normal[new - k] = -side
    return side


def furthest_outside(
    a: np.ndarray,
    b: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    roots: np.ndarray,
    unit: np.ndarray,
    rows: np.ndarray,
    u: np.ndarray,
) -> int:
    """Return the constraint, or k plus the input whose bound, is violated most; -1 if none is.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        roots: of the weights, shape (m,).
        unit: lengths of the constraints, 0 for those without a say, shape (k,).
        rows: positive for those that hold the input and are not asked, shape (k,).
        u: inputs, shape (m,).
    """
    k, found, most = len(b), -1, 0.0
    for i in range(k):
        if unit[i] > 0.0 and rows[i] == 0.0:
            margin = row_margin(a, i, b[i], u)
            if margin < -row_tolerance(a, i, b[i], u) and -margin / unit[i] > most:
                found, most = i, -margin / unit[i]
    for j in range(len(u)):
        outside = max(low[j] - u[j], u[j] - high[j]) * roots[j]
        if outside > most:
            found, most = k + j, outside
    return found


def how_far_pressures_allow(
    count: int,
    normals: np.ndarray,
    normal: np.ndarray,
    at: np.ndarray,
    order: np.ndarray,
    shares: np.ndarray,
    pressure: np.ndarray,
    rate: np.ndarray,
) -> tuple[float, int]:
    """Return how far a new constraint may press until a pressure vanishes, and which does.

    Args:
        count: number of constraints that hold the input.
        normals: constraints of unit length, shape (k, m).
        normal: the new one, shape (m,).
        at: which bounds hold the input, shape (m,).
        order: numbers of the constraints that hold it.
        shares: theirs of the new one.
        pressure: of constraints and bounds, shape (k + m,).
        rate: receives by how much each falls, shape (k + m,).

    Returns:
        The length, and the constraint, or k plus the input, or -1.
    """
    k, m = len(normals), len(at)
    for i in range(k):
        rate[i] = 0.0
    for c in range(count):
        rate[int(order[c])] = shares[c]
    for j in range(m):
        push = 0.0
        if at[j] != 0.0:
            push = -normal[j]
            for c in range(count):
                push += shares[c] * normals[int(order[c]), j]
            push *= at[j]
        rate[k + j] = push
    length, first = BOUNDLESS, -1
    for c in range(k + m):
        if rate[c] > NO_WAY and (first < 0 or pressure[c] < length * rate[c]):
            length, first = pressure[c] / rate[c], c
    return length, first


NEAREST_STEPS = 20
"""Steps for each constraint and input: many times more than were ever seen."""
ALONG_ROW = 1e-13
"""Part of a step along which a constraint changes by rounding only."""
NO_DISTANCE = 1e-13
"""Part of the way to the proposal that is rounding."""


def work_of_many_nearest(m: int) -> int:
    """Return the length of the scratch array of `approach_proposal` for m inputs."""
    return 2 * m * m + 5 * m


def approach_proposal(
    normals: np.ndarray,
    spare: np.ndarray,
    way: np.ndarray,
    ends: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
    work: np.ndarray,
) -> None:
    """Go towards the proposal as far as constraints and bounds allow, by a primal method.

    Where no step leads nearer, the rest of the way is a sum of the normals of what holds the step.
    What has the wrong sign in it is let go.

    Args:
        normals: constraints of unit length, shape (k, m).
        spare: by how much each may fall, shape (k,).
        way: to the proposal, shape (m,).
        ends: lowest and highest entries of a step, shape (2, m).
        rows: receives which constraints hold the step, 1 or 0, shape (k,).
        at: receives which bounds do, -1 for a lower and 1 for an upper one, shape (m,).
        work: scratch of `work_of_many_nearest`; receives the step in front.
    """
    k, m = len(spare), len(way)
    step, rest = vector_view(work, 0, m), vector_view(work, m, m)
    move, shares = vector_view(work, 2 * m, m), vector_view(work, 3 * m, m)
    order, basis = vector_view(work, 4 * m, m), table_view(work, 5 * m, m, m)
    triangle = table_view(work, 5 * m + m * m, m, m)
    whole = 0.0
    for i in range(k):
        rows[i] = 0.0
    for j in range(m):
        step[j] = at[j] = 0.0
        whole = max(whole, abs(way[j]))
    for _ in range(NEAREST_STEPS * (k + m)):
        count = span_of_rows(normals, rows, at, basis, triangle, order)
        left, size = 0.0, 0.0
        for j in range(m):
            rest[j] = way[j] - step[j]
        split_along_span(count, rest, at, basis, triangle, shares, move)
        for j in range(m):
            if at[j] == 0.0:
                left = max(left, abs(rest[j]))
                size = max(size, abs(move[j]))
        if size > NO_DISTANCE * left and move_until_stopped(
            normals, spare, ends, size, move, step, rows, at
        ):
            continue
        if not release_pulled(count, normals, rest, NO_DISTANCE * whole, order, shares, rows, at):
            break


def move_until_stopped(
    normals: np.ndarray,
    spare: np.ndarray,
    ends: np.ndarray,
    size: float,
    move: np.ndarray,
    step: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
) -> bool:
    """Make a move, which the first constraint or bound stops that it meets.

    Args:
        normals: constraints of unit length, shape (k, m).
        spare: by how much each may fall from the start, shape (k,).
        ends: lowest and highest entries of a step, shape (2, m).
        size: largest entry of the move.
        move: the move, shape (m,).
        step: the step so far, shape (m,), which is changed.
        rows: which constraints hold the step, shape (k,); receives one that stops it.
        at: which bounds do, shape (m,), likewise.

    Returns:
        Whether something stopped it.
    """
    m = len(step)
    length, stop = 1.0, -1
    for j in range(m):
        if move[j] != 0.0:
            to_end = (ends[1 if move[j] > 0.0 else 0, j] - step[j]) / move[j]
            if to_end < length:
                length, stop = to_end, j
    for i in range(len(spare)):
        change, left = 0.0, 0.0
        for j in range(m):
            change += normals[i, j] * move[j]
            left += normals[i, j] * step[j]
        if rows[i] == 0.0 and change < -ALONG_ROW * size:
            to_row = max(left + spare[i], 0.0) / -change
            if to_row < length:
                length, stop = to_row, m + i
    for j in range(m):
        step[j] = min(max(step[j] + length * move[j], ends[0, j]), ends[1, j])
    if stop >= m:
        rows[stop - m] = 1.0
    elif stop >= 0:
        # One at a time, so that the normals stay independent.
        step[stop] = ends[1 if move[stop] > 0.0 else 0, stop]
        at[stop] = 1.0 if move[stop] > 0.0 else -1.0
    return stop >= 0


def release_pulled(
    count: int,
    normals: np.ndarray,
    rest: np.ndarray,
    nothing: float,
    order: np.ndarray,
    shares: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
) -> bool:
    """Let go what holds the step back from the proposal with the wrong sign, if anything does.

    Args:
        count: number of constraints that hold the step.
        normals: constraints of unit length, shape (k, m).
        rest: the rest of the way, shape (m,).
        nothing: what counts as no pull.
        order: numbers of the constraints that hold the step.
        shares: coefficients of the rest in these.
        rows: which constraints hold the step, shape (k,), which is changed.
        at: which bounds do, shape (m,), likewise.

    Returns:
        Whether something was let go.
    """
    freed, strongest = -1, nothing
    for c in range(count):
        if shares[c] > strongest:
            freed, strongest = int(order[c]), shares[c]
    k = len(rows)
    for j in range(len(at)):
        if at[j] != 0.0:
            push = rest[j]
            for c in range(count):
                push -= shares[c] * normals[int(order[c]), j]
            if -at[j] * push > strongest:
                freed, strongest = k + j, -at[j] * push
    if freed >= k:
        at[freed - k] = 0.0
    elif freed >= 0:
        rows[freed] = 0.0
    return freed >= 0


ROUNDING = 3.552713678800501e-15
"""That of `safe_envs.engine.qp.rounding`, 16 eps."""
CORRECTIONS = 2
"""How often the equations are solved: the second time takes back the rounding of a long way."""


def work_of_proof(m: int) -> int:
    """Return the length of the scratch array of `prove_binding` for m inputs."""
    return 2 * m * m + 4 * m


def prove_binding(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    roots: np.ndarray,
    normals: np.ndarray,
    unit: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Find the point nearest to the proposal where some constraints and bounds hold.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        roots: of the weights, shape (m,).
        normals: constraints of unit length, over the roots, shape (k, m).
        unit: their lengths, 0 for those that say nothing of the input, shape (k,).
        rows: positive for the constraints that hold, shape (k,).
        at: which bounds hold, -1 for a lower and 1 for an upper one, shape (m,).
        u: receives the point, shape (m,).
        work: scratch of `work_of_proof`.

    Returns:
        Whether it is the minimiser: it meets all constraints, and what holds presses in the right
        direction.
    """
    m = len(u)
    for j in range(m):
        u[j] = low[j] if at[j] < 0.0 else high[j] if at[j] > 0.0 else v[j]
    count = settle_on_rows(a, b, roots, normals, unit, rows, at, u, work)
    for j in range(m):
        u[j] = min(max(u[j], low[j]), high[j])
    nothing = drop_rounding(v, low, high, roots, u)
    for i in range(len(b)):
        if unit[i] > 0.0:
            margin, allowed = row_margin(a, i, b[i], u), row_tolerance(a, i, b[i], u)
            if margin < -allowed or (rows[i] > 0.0 and margin > allowed):
                return False
    basis, triangle = table_view(work, 0, m, m), table_view(work, m * m, m, m)
    place = 2 * m * m
    order, shares = vector_view(work, place, m), vector_view(work, place + m, m)
    way, rest = vector_view(work, place + 2 * m, m), vector_view(work, place + 3 * m, m)
    for j in range(m):
        way[j] = (u[j] - v[j]) * roots[j]
    split_along_span(count, way, at, basis, triangle, shares, rest)
    for c in range(count):
        if not shares[c] >= -nothing:
            return False
    for j in range(m):
        left = way[j]
        for c in range(count):
            left -= shares[c] * normals[int(order[c]), j]
        # A bound presses inwards, as strongly as it takes.
        wrong = -left if at[j] < 0.0 else left if at[j] > 0.0 else abs(left)
        if not wrong <= nothing:
            return False
    return True


def settle_on_rows(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
    roots: np.ndarray,
    normals: np.ndarray,
    unit: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> int:
    """Move inputs that no bound holds by the shortest way to where some constraints are 0.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        roots: of the weights, shape (m,).
        normals: constraints of unit length, over the roots, shape (k, m).
        unit: their lengths, shape (k,).
        rows: positive for the constraints that are to be 0, shape (k,).
        at: 0 for the inputs that no bound holds, shape (m,).
        u: inputs, shape (m,), which are moved.
        work: scratch of `work_of_proof`; receives basis, triangle and order of `span_of_rows`.

    Returns:
        How many constraints are in the basis.
    """
    m = len(u)
    basis, triangle = table_view(work, 0, m, m), table_view(work, m * m, m, m)
    place = 2 * m * m
    order, values = vector_view(work, place, m), vector_view(work, place + m, m)
    step = vector_view(work, place + 2 * m, m)
    count = span_of_rows(normals, rows, at, basis, triangle, order)
    for _ in range(CORRECTIONS):
        for c in range(count):
            i = int(order[c])
            values[c] = row_margin(a, i, b[i], u) / unit[i]
        least_step_in_span(count, values, basis, triangle, step)
        for j in range(m):
            u[j] -= step[j] / roots[j]
    return count


def drop_rounding(
    v: np.ndarray, low: np.ndarray, high: np.ndarray, roots: np.ndarray, u: np.ndarray
) -> float:
    """Set inputs that are nothing but rounding of the way from the proposal to 0.

    A constraint of such an input alone may ask for that.

    Args:
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        roots: of the weights, shape (m,).
        u: inputs, shape (m,), which are changed.

    Returns:
        The rounding of the way.
    """
    way = 0.0
    for j in range(len(u)):
        way = max(way, abs(u[j] - v[j]) * roots[j])
    for j in range(len(u)):
        if abs(u[j]) <= ROUNDING * way / roots[j]:
            u[j] = min(max(0.0, low[j]), high[j])
    return ROUNDING * way


NO_ROW = 1e-14
"""Part of the largest constraint that rounding leaves of another."""


def work_of_fit(k: int, m: int) -> int:
    """Return the length of the scratch array of `fit_missed`.

    Args:
        k: number of constraints.
        m: number of inputs.
    """
    return 2 * k * m + 2 * m * m + 3 * (k + m)


def fit_missed(
    scaled: np.ndarray,
    margins: np.ndarray,
    missed: np.ndarray,
    held: np.ndarray,
    step: np.ndarray,
    work: np.ndarray,
) -> None:
    """Find the shortest step that leaves the least sum of squares of the margins that take part.

    Args:
        scaled: coefficients, shape (k, m).
        margins: margins, shape (k,).
        missed: positive for the constraints that take part, shape (k,).
        held: 0 for the inputs that may move, shape (m,).
        step: receives the step, shape (m,).
        work: scratch of `work_of_fit`.
    """
    k, m = len(margins), len(step)
    columns, table = table_view(work, 0, m, k), table_view(work, k * m, k, m)
    place = 2 * k * m
    space, triangle = table_view(work, place, m, m), table_view(work, place + m * m, m, m)
    place += 2 * m * m
    wanted, whole = vector_view(work, place, k), vector_view(work, place + k, k)
    rest, taken = vector_view(work, place + 2 * k, k), vector_view(work, place + 3 * k, m)
    order = vector_view(work, place + 3 * k + m, m)
    shares = vector_view(work, place + 3 * k + 2 * m, m)
    for i in range(k):
        wanted[i] = -margins[i] if missed[i] > 0.0 else 0.0
        whole[i] = 0.0
        for j in range(m):
            table[i, j] = scaled[i, j] if missed[i] > 0.0 and held[j] == 0.0 else 0.0
    size = space_of_rows(table, space)
    for c in range(m):
        taken[c] = 1.0 if c < size else 0.0
        for i in range(k):
            columns[c, i] = 0.0
            if c < size and missed[i] > 0.0:
                for j in range(m):
                    columns[c, i] += scaled[i, j] * space[c, j]
    basis = table_view(work, k * m, m, k)  # in place of `table`, which has served
    count = span_of_rows(columns, taken, whole, basis, triangle, order)
    split_along_span(count, wanted, whole, basis, triangle, shares, rest)
    for j in range(m):
        step[j] = 0.0
        for c in range(count):
            step[j] += shares[c] * space[int(order[c]), j]


def space_of_rows(table: np.ndarray, space: np.ndarray) -> int:
    """Find an orthonormal basis of the rows of a table, the largest ones first.

    Args:
        table: the rows, shape (k, m), which are overwritten.
        space: receives the basis, shape (m, m).

    Returns:
        How many there are.
    """
    k, m = table.shape
    count, least = 0, 0.0
    while count < m:
        chosen, largest = -1, least
        for i in range(k):
            square = 0.0
            for j in range(m):
                square += table[i, j] * table[i, j]
            if square > largest:
                chosen, largest = i, square
        if chosen < 0:
            break
        if count == 0:
            least = NO_ROW * NO_ROW * largest
        for j in range(m):
            space[count, j] = table[chosen, j] / sqrt(largest)
        for c in range(count):  # takes back rounding
            share = 0.0
            for j in range(m):
                share += space[c, j] * space[count, j]
            for j in range(m):
                space[count, j] -= share * space[c, j]
        length = 0.0
        for j in range(m):
            length += space[count, j] * space[count, j]
        for j in range(m):
            space[count, j] /= sqrt(length)
        for i in range(k):
            share = 0.0
            for j in range(m):
                share += table[i, j] * space[count, j]
            for j in range(m):
                table[i, j] = table[i, j] - share * space[count, j] if i != chosen else 0.0
        count += 1
    return count


SLACK_STEPS = 20
"""Steps for each constraint and input: many times more than were ever seen."""
NO_PUSH = 1e-12
"""Part of the forces on an input that is rounding."""
BEYOND_STEP = 2.0
"""Length of a step that meets nothing; it ends at 1."""


def work_of_many_slack(k: int, m: int) -> int:
    """Return the length of the scratch array of `least_violating_of_many`.

    Args:
        k: number of constraints.
        m: number of inputs.
    """
    return k * m + 4 * (k + m) + work_of_fit(k, m)


def least_violating_of_many(
    a: np.ndarray,
    b: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    priority: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> None:
    """Minimise the sum of weighted squared slacks by the method of Stark and Parker (1995).

    Args:
        a: constraints, shape (k, m), not all of which are 0.
        b: offsets, shape (k,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        priority: positive weights of the squared slacks, shape (k,).
        u: inputs to begin with, inside the input bounds, shape (m,); receives the minimiser.
        work: scratch of `work_of_many_slack`.
    """
    k, m = len(b), len(u)
    scaled = table_view(work, 0, k, m)
    rest = k * m
    offsets, margins = vector_view(work, rest, k), vector_view(work, rest + k, k)
    missed, held = vector_view(work, rest + 2 * k, k), vector_view(work, rest + 3 * k, m)
    barred = vector_view(work, rest + 3 * k + m, k + m)
    step = vector_view(work, rest + 4 * k + 2 * m, m)
    last = vector_view(work, rest + 4 * k + 3 * m, m)
    room = vector_view(work, rest + 4 * k + 4 * m, work_of_fit(k, m))
    scale_slacks(a, b, priority, scaled, offsets)
    squares_of_missed(scaled, offsets, u, margins)
    for i in range(k):
        missed[i] = 1.0 if margins[i] < 0.0 else 0.0
    for j in range(m):
        held[j] = 0.0
    for c in range(k + m):
        barred[c] = 0.0
    freed, done = -1, False
    for _ in range(SLACK_STEPS * (k + m)):
        fit_missed(scaled, margins, missed, held, step, room)
        if done:
            break
        length = advance_to_stop(
            scaled, offsets, low, high, step, u, margins, missed, held, vector_view(room, 0, k)
        )
        if length < 1.0:
            if length > 0.0:
                for c in range(k + m):
                    barred[c] = 0.0
            elif 0 <= freed < k:
                barred[freed] = max(barred[freed], missed[freed])
            elif freed >= k:
                barred[freed] = max(barred[freed], held[freed - k])
            freed = -1
        else:
            freed = release_strongest(scaled, high, u, margins, missed, held, barred)
            done = freed < 0
    # The margins are those of a long way; a last step along the same constraints takes back its
    # rounding, or leads astray.
    for j in range(m):
        last[j] = min(max(u[j] + step[j], low[j]), high[j])
    before = squares_of_missed(scaled, offsets, u, margins)
    if squares_of_missed(scaled, offsets, last, margins) < before:
        for j in range(m):
            u[j] = last[j]


def scale_slacks(
    a: np.ndarray, b: np.ndarray, priority: np.ndarray, scaled: np.ndarray, offsets: np.ndarray
) -> None:
    """Weigh the constraints, over the largest coefficient of all.

    So squares neither overflow nor vanish. A constraint that says nothing of the input gets the
    offset 0, with which it has no slack.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        priority: positive weights of the squared slacks, shape (k,).
        scaled: receives the coefficients, shape (k, m).
        offsets: receives the offsets, shape (k,).
    """
    size = 0.0
    for i in range(len(b)):
        for j in range(a.shape[1]):
            size = max(size, sqrt(priority[i]) * abs(a[i, j]))
    for i in range(len(b)):
        says = False
        for j in range(a.shape[1]):
            scaled[i, j] = sqrt(priority[i]) * a[i, j] / size
            says = says or a[i, j] != 0.0
        offsets[i] = sqrt(priority[i]) * b[i] / size if says else 0.0


def squares_of_missed(
    scaled: np.ndarray, offsets: np.ndarray, u: np.ndarray, margins: np.ndarray
) -> float:
    """Return the sum of squared slacks, and record the margins.

    Args:
        scaled: coefficients, shape (k, m).
        offsets: offsets, shape (k,).
        u: inputs, shape (m,).
        margins: receives the margins, shape (k,).
    """
    total = 0.0
    for i in range(len(offsets)):
        margin = 0.0
        for j in range(len(u)):
            margin += scaled[i, j] * u[j]
        margin += offsets[i]
        margins[i] = margin
        if margin < 0.0:
            total += margin * margin
    return total


def advance_to_stop(  # noqa: PLR0913
    scaled: np.ndarray,
    offsets: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    step: np.ndarray,
    u: np.ndarray,
    margins: np.ndarray,
    missed: np.ndarray,
    held: np.ndarray,
    to_rows: np.ndarray,
) -> float:
    """Go as far as no input meets its bound and no constraint without a part its zero.

    Those that stop the step are held, or take part, from then on.

    Args:
        scaled: coefficients, shape (k, m).
        offsets: offsets, shape (k,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        step: the step, shape (m,).
        u: inputs, shape (m,), which are moved.
        margins: margins, shape (k,), likewise.
        missed: positive for the constraints that take part, shape (k,), likewise.
        held: positive for the inputs at a bound, shape (m,), likewise.
        to_rows: scratch, shape (k,).

    Returns:
        The part of the step that was taken, 1 if nothing stopped it.
    """
    k, m = len(margins), len(u)
    length = 1.0
    for j in range(m):
        if step[j] != 0.0:
            length = min(length, ((high[j] if step[j] > 0.0 else low[j]) - u[j]) / step[j])
    for i in range(k):
        change = 0.0
        for j in range(m):
            change += scaled[i, j] * step[j]
        to_rows[i] = BEYOND_STEP
        if missed[i] == 0.0 and change < 0.0:
            to_rows[i] = max(margins[i], 0.0) / -change
        length = min(length, to_rows[i])
    for j in range(m):
        if step[j] != 0.0:
            end = high[j] if step[j] > 0.0 else low[j]
            if (end - u[j]) / step[j] <= length:
                u[j] = end
                if length < 1.0:
                    held[j] = 1.0
            else:
                u[j] = min(max(u[j] + length * step[j], low[j]), high[j])
    squares_of_missed(scaled, offsets, u, margins)
    if length < 1.0:
        for i in range(k):
            if to_rows[i] <= length:
                missed[i] = 1.0
    return length


def release_strongest(
    scaled: np.ndarray,
    high: np.ndarray,
    u: np.ndarray,
    margins: np.ndarray,
    missed: np.ndarray,
    held: np.ndarray,
    barred: np.ndarray,
) -> int:
    """Let go the constraint that is met with most room, or an input that is pushed inwards.

    Args:
        scaled: coefficients, shape (k, m).
        high: upper bounds, shape (m,).
        u: inputs, shape (m,).
        margins: margins, shape (k,).
        missed: positive for the constraints that take part, shape (k,), which is changed.
        held: positive for the inputs at a bound, shape (m,), which is changed.
        barred: positive for what is not to be let go, shape (k + m,).

    Returns:
        The constraint, or k plus the input, or -1.
    """
    k, m = len(margins), len(u)
    largest = 0.0
    for i in range(k):
        if missed[i] > 0.0:
            for j in range(m):
                largest = max(largest, abs(margins[i] * scaled[i, j]))
    freed, strongest = -1, NO_PUSH * largest
    for i in range(k):
        if missed[i] > 0.0 and barred[i] == 0.0:
            pull = 0.0
            for j in range(m):
                pull = max(pull, margins[i] * abs(scaled[i, j]))
            if pull > strongest:
                freed, strongest = i, pull
    if freed >= 0:
        missed[freed] = 0.0
        return freed
    strongest = 0.0
    for j in range(m):
        if held[j] > 0.0 and barred[k + j] == 0.0:
            push, terms = 0.0, 0.0
            for i in range(k):
                if missed[i] > 0.0:
                    push -= margins[i] * scaled[i, j]
                    terms += abs(margins[i] * scaled[i, j])
            if u[j] >= high[j]:
                push = -push
            if push > NO_PUSH * terms and push > strongest:
                freed, strongest = k + j, push
    if freed >= 0:
        held[freed - k] = 0.0
    return freed


LOST = 4.0
"""How many tolerances of a constraint the way to the nearest action may cost."""


def work_of_many(k: int, m: int) -> int:
    """Return the length of the scratch array of `project_many`.

    Args:
        k: number of constraints.
        m: number of inputs.
    """
    rooms = (
        work_of_binding(k, m),
        work_of_proof(m),
        k + 4 * m + max(work_of_many_slack(k, m), work_of_many_nearest(m), work_of_proof(m)),
    )
    return max(work_of_single_active(k, m), k * m + 3 * k + 3 * m + max(rooms))


def project_many(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    priority: np.ndarray,
    u: np.ndarray,
    margin: np.ndarray,
    active: np.ndarray,
    work: np.ndarray,
) -> bool:
    """Project the inputs of one state.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        w: positive weights, shape (m,).
        priority: positive weights of the squared slacks, shape (k,).
        u: receives the inputs, shape (m,).
        margin: receives the margins, shape (k,).
        active: receives which constraints bind or cannot be met, 1 or 0, shape (k,).
        work: scratch of `work_of_many`.

    Returns:
        Whether all constraints can be met.
    """
    k, m = len(b), len(v)
    solved, feasible = project_single_active(
        a, b, v, low, high, w, priority, u, margin, active, work
    )
    if solved:
        return feasible
    normals, place = table_view(work, 0, k, m), k * m
    unit, roots = vector_view(work, place, k), vector_view(work, place + k, m)
    rows, at = vector_view(work, place + k + m, k), vector_view(work, place + 2 * k + m, m)
    used = place + 3 * k + 3 * m
    room = vector_view(work, used, len(work) - used)
    offsets = vector_view(work, place + 2 * k + 2 * m, k)
    normals_of_rows(a, w, normals, unit, roots)
    for i in range(k):
        offsets[i] = b[i]
    if not (
        find_binding(a, b, v, low, high, roots, normals, unit, u, rows, at, room)
        and prove_binding(a, offsets, v, low, high, roots, normals, unit, rows, at, u, room)
    ):
        approach_least_violating(
            a, b, v, low, high, priority, roots, normals, unit, rows, at, offsets, u, room
        )
        drop_rounding(v, low, high, roots, u)
    for i in range(k):
        if unit[i] > 0.0:
            margin[i] = row_margin(a, i, b[i], u)
            allowed = row_tolerance(a, i, b[i], u)
            active[i] = 1.0 if margin[i] <= allowed else 0.0
            feasible = feasible and margin[i] >= -allowed
    return feasible


def approach_least_violating(  # noqa: PLR0913
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    priority: np.ndarray,
    roots: np.ndarray,
    normals: np.ndarray,
    unit: np.ndarray,
    rows: np.ndarray,
    at: np.ndarray,
    offsets: np.ndarray,
    u: np.ndarray,
    work: np.ndarray,
) -> None:
    """Find the nearest of the least-violating inputs; see `safe_envs.engine.qp.working_set`.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        priority: positive weights of the squared slacks, shape (k,).
        roots: of the weights, shape (m,).
        normals: constraints of unit length, over the roots, shape (k, m).
        unit: their lengths, 0 for those that say nothing of the input, shape (k,).
        rows: receives which constraints hold the inputs, shape (k,).
        at: receives which bounds do, shape (m,).
        offsets: receives the offsets of the constraints less their slacks, shape (k,).
        u: receives the inputs, shape (m,).
        work: scratch of k + 4 m entries, and of each of the three steps.
    """
    k, m = len(b), len(u)
    spare, start = vector_view(work, 0, k), vector_view(work, k, m)
    way, ends = vector_view(work, k + m, m), table_view(work, k + 2 * m, 2, m)
    room = vector_view(work, k + 4 * m, len(work) - k - 4 * m)
    for j in range(m):
        u[j] = min(max(v[j], low[j]), high[j])
    least_violating_of_many(a, b, low, high, priority, u, room)
    for i in range(k):
        reached = row_margin(a, i, b[i], u)
        slack = -reached if reached < -row_tolerance(a, i, b[i], u) else 0.0
        offsets[i] = b[i] + slack
        spare[i] = max(reached + slack, 0.0) / unit[i] if unit[i] > 0.0 else 0.0
    for j in range(m):
        start[j] = u[j]
        ends[0, j], ends[1, j] = (low[j] - u[j]) * roots[j], (high[j] - u[j]) * roots[j]
        way[j] = 0.0
        for i in range(k):
            if a[i, j] != 0.0:
                way[j] = (v[j] - u[j]) * roots[j]
    approach_proposal(normals, spare, way, ends, rows, at, room)
    moves = False
    for j in range(m):
        moves = moves or room[j] != 0.0
        moved = start[j] + room[j] / roots[j]
        u[j] = low[j] if at[j] < 0.0 else high[j] if at[j] > 0.0 else moved
    # Where there is no way to go, constraints that are nearly parallel would only add rounding.
    if moves:
        settle_on_rows(a, offsets, roots, normals, unit, rows, at, u, room)
    astray = False
    for j in range(m):
        u[j] = min(max(u[j], low[j]), high[j])
    # Where constraints or inputs differ by many orders of magnitude, rounding may lead astray: then
    # the least-violating action itself is safer.
    for i in range(k):
        worse = max(-row_margin(a, i, b[i], u), 0.0) - max(-row_margin(a, i, b[i], start), 0.0)
        allowed = row_tolerance(a, i, b[i], u) + row_tolerance(a, i, b[i], start)
        astray = astray or not worse <= LOST * allowed
    if astray:
        for j in range(m):
            u[j] = start[j]
