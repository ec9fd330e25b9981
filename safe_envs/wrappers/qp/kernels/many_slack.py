"""`safe_envs.wrappers.qp.bounded_least_squares` for one state, without LAPACK."""

from __future__ import annotations

from math import sqrt

import numpy as np

from safe_envs.compiled.plain_natives import table_view, vector_view
from safe_envs.wrappers.qp.kernels.many_fit import fit_missed, work_of_fit

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
