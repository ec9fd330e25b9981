"""The least sum of squared slacks of one state, by bounded-variable least squares.

With p the positive and s the negative part of a constraint's margin, min |a u + b - p|^2 over u
within the input bounds and p >= 0 leaves s as the residual. The active-set method of Stark and
Parker (1995) solves that: constraints with p = 0 take part in a least-squares problem, those with p
> 0 do not, and a step ends where an input meets its bound or a constraint without a part its zero.
SciPy's version stops where a step is too short to change the sum, and so too early where several
bounds meet in a point.
"""

from __future__ import annotations

import numpy as np

_STEPS = 20
"""Steps for each constraint and input: many times more than were ever seen."""

_NO_FORCE = 1e-12
"""Part of the forces on an input that is rounding."""


def least_violating(
    a: np.ndarray,
    b: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    priority: np.ndarray,
    start: np.ndarray,
) -> np.ndarray:
    """Return an action of least sum_i priority_i slack_i^2.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        priority: positive weights of the squared slacks, shape (k,).
        start: an action inside the input bounds, shape (m,).
    """
    units = np.sqrt(priority)
    size = (units[:, None] * np.abs(a)).max() or 1.0  # so that squares neither overflow nor vanish
    a, b, u = units[:, None] * a / size, units * b / size, start.copy()
    margin = a @ u + b
    k, m = a.shape
    missed, held = margin < 0.0, np.zeros(m, dtype=bool)
    # What was let go last, constraints first and then inputs; and what came back at once, because
    # the force on it was rounding.
    freed, barred = -1, np.zeros(k + m, dtype=bool)
    for _ in range(_STEPS * (k + m)):
        step = np.zeros(len(u))
        step[~held] = np.linalg.lstsq(a[np.ix_(missed, ~held)], -margin[missed])[0]
        ends = np.where(step > 0.0, high, low)
        change = a @ step
        to_ends = np.divide(ends - u, step, out=np.full(len(u), np.inf), where=step != 0.0)
        to_rows = np.divide(
            np.maximum(margin, 0.0),
            -change,
            out=np.full(len(b), np.inf),
            where=~missed & (change < 0.0),
        )
        length = min(to_ends.min(), to_rows.min(), 1.0)
        stops = to_ends <= length
        u = np.where(stops, ends, np.clip(u + length * step, low, high))
        margin = a @ u + b
        if length < 1.0:
            meets = to_rows <= length
            barred &= length == 0.0
            if length == 0.0 and freed >= 0:
                barred[freed] |= np.concatenate([meets, stops])[freed]
            held, missed, freed = held | stops, missed | meets, -1
            continue
        press = np.where(missed, -margin, 0.0)
        forces = press[:, None] * a
        inwards = np.where(u >= high, -1.0, 1.0) * forces.sum(axis=0)
        inwards[~held | barred[k:] | (inwards <= _NO_FORCE * np.abs(forces).sum(axis=0))] = 0.0
        pulls = -press * np.abs(a).max(axis=1)
        pulls[barred[:k] | (pulls <= _NO_FORCE * np.abs(forces).max())] = 0.0
        if pulls.any():
            freed = int(pulls.argmax())
            missed[freed] = False
        elif inwards.any():
            freed = k + int(inwards.argmax())
            held[freed - k] = False
        else:
            break
    # The margins are those of a long way; a last step along the same constraints takes back its
    # rounding, or leads astray.
    last = u.copy()
    last[~held] += np.linalg.lstsq(a[np.ix_(missed, ~held)], -margin[missed])[0]
    return min(
        u, np.clip(last, low, high), key=lambda q: float((np.minimum(a @ q + b, 0.0) ** 2).sum())
    )
