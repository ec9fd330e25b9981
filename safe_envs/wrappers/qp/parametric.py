"""Working sets of a batch, by a parametric active-set method for soft constraints.

    min 1/2 sum_j w_j (u_j - v_j)^2 + 1/(2 e) sum_i priority_i slack_i^2,   low <= u <= high

With all constraints loosened by as much as the furthest is missed, the clipped proposal is the
minimiser. They are tightened together; the minimiser moves along lines, and where one ends, a
constraint or bound begins to count or no longer does. That is a principal pivot of

    r = t - y + N' p,   s = c + N y + D p

with inputs y, pressures p, margins s and forces r on the inputs, of which each pair (y, r) and (p,
s) has one member that follows from the others; `table` holds how. D is small and positive, so that
every pivot is possible. All states take their pivots at the same time.

Source: R. W. Cottle, J.-S. Pang, R. E. Stone, The Linear Complementarity Problem, 1992, Sec. 4.5.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from safe_envs.wrappers.qp.rounding import total
from safe_envs.wrappers.qp.working_set_batch import ArrayQP

_STILL = 1e-13
"""Change of a variable that is rounding."""
_SMALLEST = 1e-50
"""Of the lengths of constraints, over the largest: the squares of smaller ones would vanish."""
_MANY = 200
"""States of which arrays with all their variables are too long for one operation."""
_PIVOTS = 5
"""Pivots for each constraint and input."""


def propose(p: ArrayQP, soft: float, firm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the constraints (k, B) that count and the bounds (m, B) that hold the inputs.

    Args:
        p: the QPs.
        soft: D of the constraint that weighs least.
        firm: least D of the constraint that weighs most.
    """
    k, m, size = p.a.shape
    rows, at = np.empty((k, size), dtype=bool), np.empty((m, size))
    states, path = np.arange(size), _Path.of(p, soft, firm)
    for _ in range(_PIVOTS * (k + m)):
        going = path.advance()
        count = np.count_nonzero(going)
        if 4 * count <= 3 * len(states):
            done = states[~going]
            rows[:, done], at[:, done] = path.working(~going)
            if not count:
                return rows, at
            states, path = states[going], path.take(going)
            going = going[going]
        path.pivot(going)
    rows[:, states], at[:, states] = path.working(slice(None))
    return rows, at


class _Path:
    """Where the minimisers are on their ways; the last axis are the states.

    Attributes:
        table: how each dependent variable follows from the others, its value where the constraints
            are loosest, and its change until they are as they are, shape (m + k, m + k + 2, B).
        state: of each pair, between what the dependent one may be, at what the other one is, and
            whether the former is y or p, not r or s, shape (4, m + k, B).
        ends: input bounds, and 0 and infinity for constraints, shape (2, m + k, B).
        now: how far the constraints are tightened, from 0 to 1, shape (B,).
        inputs: m.
    """

    def __init__(self, parts: list[np.ndarray], inputs: int) -> None:
        self.table, self.state, self.ends, self.now = parts
        self.inputs = inputs
        self._place = np.zeros(self.now.shape, dtype=np.intp)

    @classmethod
    def of(cls, p: ArrayQP, soft: float, firm: float) -> _Path:
        """Return the beginning of the ways; see `propose`."""
        k, m, size = p.a.shape
        n = m + k
        start = np.minimum(np.maximum(p.v, p.low), p.high)
        offsets = (total(np.swapaxes(p.a * start, 0, 1)) + p.b) / p.lengths
        unit = -offsets.min(axis=0)
        unit[unit <= 0.0] = 1.0
        scale = p.roots / unit
        sizes = np.maximum(p.lengths / p.lengths.max(axis=0), _SMALLEST)
        weights = p.priority * sizes * sizes
        free = start == p.v
        table = np.zeros((n, n + 2, size))
        table[range(m), range(m)] = -1.0
        table[m:, :m] = np.where(free, -p.normals, p.normals)
        table[:m, m:n] = np.swapaxes(p.normals, 0, 1)
        loose = np.where(free, p.normals, 0.0)
        for i in range(k):
            for j in range(i + 1):
                table[m + i, m + j] = table[m + j, m + i] = total(p.normals[i] * loose[j])
        table[range(m, n), range(m, n)] += (
            np.maximum(soft * weights.min(axis=0), firm * weights.max(axis=0)) / weights
        )
        table[:m, n], table[m:, n] = (p.v - start) * scale, offsets / unit + 1.0
        table[m:, n + 1] = -1.0
        ends = np.zeros((2, n, size))
        ends[0, :m], ends[1, :m], ends[1, m:] = (
            (p.low - start) * scale,
            (p.high - start) * scale,
            np.inf,
        )
        state = np.zeros((4, n, size))
        state[:2], state[3, :m] = ends, free
        below = p.v < p.low
        state[0, :m] = np.where(free, ends[0, :m], np.where(below, -np.inf, 0.0))
        state[1, :m] = np.where(free, ends[1, :m], np.where(below, 0.0, np.inf))
        return cls([table, state, ends, np.zeros(size)], m)

    def take(self, states: np.ndarray) -> _Path:
        """Return the ways of some states."""
        parts = self.table, self.state, self.ends, self.now
        found = _Path([part.compress(states, axis=-1) for part in parts], self.inputs)
        found._place = self._place[states]
        return found

    def working(self, states: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the constraints that count in some states, and the bounds that hold the inputs."""
        m = self.inputs
        least, follows = self.state[0, :m, states], self.state[3, :, states] > 0.0
        if not isinstance(states, slice):
            least, follows = least.T, follows.T
        return follows[m:], np.where(follows[:m], 0.0, np.where(least < 0.0, -1.0, 1.0))

    def advance(self) -> np.ndarray:
        """Go to where the lines end; return whether that is before the end of the way (B,)."""
        n = len(self.table)
        rate = self.table[:, n + 1]
        reached = np.where(rate < 0.0, self.state[0], self.state[1])
        reached -= self.table[:, n]
        reached /= rate
        reached[np.abs(rate) <= _STILL] = np.inf
        first = reached.min(axis=0)
        if len(first) > _MANY:
            for i, end in enumerate(reached):
                self._place[end == first] = i
        else:
            self._place = reached.argmin(axis=0)
        self.now = np.minimum(np.maximum(first, self.now), 1.0)
        return self.now < 1.0

    def pivot(self, going: np.ndarray) -> None:
        """Exchange the variables whose lines have ended.

        Args:
            going: the states in which the way goes on, shape (B,).
        """
        table, n, size = self.table, len(self.table), len(going)
        states = going.nonzero()[0]
        place = self._place[states]
        # Numbers of entries in the flat table, which are faster than three indices.
        flat = table.reshape(-1)
        here = place * size + states
        of_column = here + np.arange(0, n * (n + 2) * size, (n + 2) * size)[:, None]
        of_row = here + place * ((n + 1) * size) + np.arange(0, (n + 2) * size, size)[:, None]
        column, row = flat.take(of_column), flat.take(of_row)
        of_state = here + np.arange(0, 4 * n * size, n * size)[:, None]
        state = self.state.reshape(-1)
        least, most, fixed, follows = state.take(of_state)
        low, high = self.ends.take(of_state[:2])
        down = row[n + 1] < 0.0
        target = np.where(down, least, most)
        each = np.arange(len(states))
        head = row[place, each]
        row[n] -= target
        row /= head
        if len(states) < size:
            every = np.zeros((n, size)), np.zeros((n + 2, size))
            every[0][:, states], every[1][:, states] = column, row
        else:
            every = column, row
        if size > _MANY:
            step = np.empty((n + 2, size))
            for entries, share in zip(table, every[0], strict=True):
                np.multiply(every[1], share, out=step)
                entries -= step
        else:
            table -= every[0][:, None] * every[1]
        flat[of_column] = column / head
        # What was fixed depends now, and the other way round.
        np.negative(row, out=row)
        row[n] += fixed
        row[place, each] = 1.0 / head
        flat[of_row] = row
        stops = (follows > 0.0) & (place < self.inputs)
        state[of_state] = (
            np.where(stops, np.where(down, -np.inf, 0.0), low),
            np.where(stops & down, 0.0, np.where(stops, np.inf, high)),
            target,
            1.0 - follows,
        )
