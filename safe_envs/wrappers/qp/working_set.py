"""The point that a working set holds, and the proof that it is the answer, for one state.

A working set says which constraints count (those that are missed or bind) and which inputs are at a
bound. Its point is the limit, for vanishing e, of the minimiser of

    1/2 sum_j w_j (u_j - v_j)^2 + 1/(2 e) sum_i priority_i (a_i . u + b_i)^2,   i in the working set

over the inputs that are free: the nearest of the points with the least sum of squares. It is the
nearest of the least-violating actions if it is optimal on both levels: the forces of the slacks
vanish along free inputs and press held ones outwards, and where they leave an input alone, the way
from the proposal does. Where the constraints can be met, there are no slacks, and it is the
minimiser.

What contradicts that says how the working set has to change; one after the other is a block
pivoting method for the limit of the problem with soft constraints (Judice and Pires, Computers and
Operations Research 21, 1994).
"""

from __future__ import annotations

import math
from operator import mul, truediv
from typing import NamedTuple

from safe_envs.wrappers.qp.plain_qp import PlainQP, margins
from safe_envs.wrappers.qp.rounding import ROUNDING, Floats
from safe_envs.wrappers.qp.row_span import LineSpan, RowSpan

_NOTHING = 1e-12
"""Part of the forces on an input that is rounding."""
SURELY = 1e3
"""A constraint violated by so many times its rounding surely has a slack: one that binds next to
others with slacks may be violated by some."""
_CORRECTIONS = 3
"""How often a point is found: from the second time on, this takes back the rounding of a long
way."""


class WorkingSet(NamedTuple):
    """Constraints that count, and -1 for inputs at the lower, 1 at the upper bound, else 0 (m)."""

    rows: list[int]
    at: list[int]


class Point(NamedTuple):
    """Inputs (m) with the margins there and their rounding (k), and the working set that follows.

    The latter is None where the point is proved to be the answer.
    """

    u: list[float]
    margin: list[float]
    allowed: list[float]
    change: WorkingSet | None


class FloatQP(PlainQP):
    """A QP whose constraints all depend on the input, for working sets.

    Attributes:
        roots: of the weights.
        normals: of unit length, in inputs times the roots.
        lengths: of the constraints, likewise.
        sizes: these, times the roots of the priorities.
    """

    roots: list[float]
    normals: list[list[float]]
    lengths: list[float]
    sizes: list[float]

    def scaled(self) -> FloatQP:
        """Return this with the roots, normals, lengths and sizes that working sets need."""
        self.roots = [math.sqrt(wj) for wj in self.w]
        self._rows = [(*row, offset) for row, offset in zip(self.a, self.b, strict=True)]
        self.normals, self.lengths = [], []
        for row in self.a:
            scaled = [*map(truediv, row, self.roots)]
            length = math.hypot(*scaled)
            self.normals.append([s / length for s in scaled])
            self.lengths.append(length)
        self.sizes = [
            math.sqrt(q) * length for q, length in zip(self.priority, self.lengths, strict=True)
        ]
        return self

    def first(self) -> WorkingSet:
        """Return the working set of the clipped proposal."""
        at = [
            -1 if vj < lo else 1 if vj > hi else 0
            for vj, lo, hi in zip(self.v, self.low, self.high, strict=True)
        ]
        return WorkingSet([i for i, value in enumerate(self.margin) if value < 0.0], at)

    def point(self, working: WorkingSet) -> Point:
        """Return the point of a working set, and what contradicts that it is the answer.

        Args:
            working: constraints and bounds.
        """
        rows, at = working
        u, margin, allowed, span, outside = self._settle(rows, at)
        way = self._way(u)
        nothing = ROUNDING * max(max(way), -min(way))
        more, slacks = [], []
        for i, value in enumerate(margin):
            if i in rows:
                if not value >= -SURELY * allowed[i]:
                    slacks.append(i)
            elif not value >= -allowed[i]:
                more.append(i)
        kept, presses = rows, None
        if len(slacks) < len(rows):
            presses = self._presses(working, span, way)
            kept = [
                i
                for i, (pressure, _) in zip(rows, presses, strict=True)
                if i in slacks or (pressure >= -nothing and margin[i] <= allowed[i])
            ]
        # Over the steepest, so that small forces do not vanish.
        unit = max([self.lengths[i] for i in slacks]) if slacks else 1.0
        pulls = [
            (self.priority[i] * (-margin[i] / unit), self.a[i], allowed[i] / -margin[i])
            for i in slacks
        ]
        changed, settled = outside, True
        for j, side in enumerate(at):
            force, doubt, unsure = 0.0, 0.0, 0.0
            for pull, row, error in pulls:
                part = pull * row[j]
                force += part
                doubt += abs(part)
                unsure += error * abs(part)
            doubt *= _NOTHING
            if not side:
                settled = settled and abs(force) <= doubt + unsure
            elif not force * side > doubt:
                # The slacks do not press it against its bound; the way from the proposal may.
                if presses is None:
                    presses = self._presses(working, span, way)
                rest = way[j]
                for pressure, normal in presses:
                    rest -= pressure * normal[j]
                if force * side < -doubt or not rest * side <= nothing:
                    changed[j] = 0
        # Where all can be met, what binds is to be met as exactly as the rest.
        met = bool(slacks) or not [i for i in rows if not margin[i] >= -allowed[i]]
        if settled and met and not (changed or more) and len(kept) == len(rows):
            return Point(u, margin, allowed, None)
        return Point(
            u,
            margin,
            allowed,
            WorkingSet([*kept, *more], [changed.get(j, side) for j, side in enumerate(at)]),
        )

    def _presses(
        self, working: WorkingSet, span: LineSpan | RowSpan | None, way: list[float]
    ) -> list[tuple[float, list[float]]]:
        """Return the pressures of the constraints that add up to a way, and their normals."""
        rows, at = working
        pressures = [0.0] * len(rows)
        if span:
            pressures = span.pressures([c for c, side in zip(way, at, strict=True) if not side])
        return [(pressure, self.normals[i]) for pressure, i in zip(pressures, rows, strict=True)]

    def _settle(
        self, rows: list[int], at: list[int]
    ) -> tuple[list[float], list[float], list[float], LineSpan | RowSpan | None, dict[int, int]]:
        """Return the inputs, margins, their rounding, and on which side inputs leave the bounds."""
        u = [
            vj if not side else lo if side < 0 else hi
            for side, vj, lo, hi in zip(at, self.v, self.low, self.high, strict=True)
        ]
        free = [j for j, side in enumerate(at) if not side]
        if not free:
            return u, *margins(self.a, self.b, u), None, {}
        span, known = None, None
        if rows:
            if len(free) == 1:
                return self._settle_single(u, free[0], rows)
            normals = [self.normals[i] for i in rows]
            if len(free) < len(u):
                normals = [[n[j] for j in free] for n in normals]
            span = (LineSpan if len(rows) == 1 else RowSpan)(normals, [self.sizes[i] for i in rows])
            known = self._move(u, free, rows, span)
        outside, moved = self._clip(u, free)
        if moved or not known:
            known = margins(self.a, self.b, u)
        return u, *known, span, outside

    def _settle_single(
        self, u: list[float], j: int, rows: list[int]
    ) -> tuple[list[float], list[float], list[float], LineSpan, dict[int, int]]:
        """Return what `_settle` does where one input is free."""
        span = LineSpan([[self.normals[i][j]] for i in rows], [self.sizes[i] for i in rows])
        root, uj = self.roots[j], u[j]
        u[j] = 0.0
        parts = [
            (
                (sum(map(mul, self.a[i], u)) + self.b[i]) / self.lengths[i],
                self.a[i][j] / self.lengths[i],
                share,
            )
            for i, share in zip(rows, span.inverse, strict=True)
        ]
        for _ in range(_CORRECTIONS):
            step = 0.0
            for rest, slope, share in parts:
                step += share * (rest + slope * uj)
            step /= root
            uj -= step
            if abs(step) <= ROUNDING * abs(uj):
                break
        u[j] = uj
        outside, _ = self._clip(u, [j])
        return u, *margins(self.a, self.b, u), span, outside

    def _move(
        self, u: list[float], free: list[int], rows: list[int], span: LineSpan | RowSpan
    ) -> tuple[list[float], list[float]] | None:
        """Move free inputs to where rows fit best; return the margins there, if known."""
        lengths, roots = self.lengths, self.roots
        of_rows = [self._rows[i] for i in rows]
        margin = [sum(map(mul, row, [*u, 1.0])) for row in of_rows]
        for _ in range(_CORRECTIONS):
            steps = span.step([value / lengths[i] for i, value in zip(rows, margin, strict=True)])
            far = False
            for j, step in zip(free, steps, strict=True):
                step /= roots[j]
                new = u[j] - step
                far = far or abs(step) > ROUNDING * abs(new)
                u[j] = new
            if not far:
                break
            if not span.dependent:
                known = every, allowed = margins(self.a, self.b, u)
                margin = [every[i] for i in rows]
                met = [abs(every[i]) <= allowed[i] for i in rows]
                if all(met):
                    return known
            else:
                ends = [*u, 1.0]
                margin = [sum(map(mul, row, ends)) for row in of_rows]
        return None

    def _way(self, u: Floats) -> list[float]:
        return [(uj - vj) * root for uj, vj, root in zip(u, self.v, self.roots, strict=True)]

    def _clip(self, u: list[float], free: list[int]) -> tuple[dict[int, int], bool]:
        """Clip inputs; return on which side those were that left their bounds, and if any moved."""
        outside, moved = {}, False
        way = self._way(u)
        nothing = ROUNDING * max(max(way), -min(way))
        for j in free:
            uj, lo, hi = u[j], self.low[j], self.high[j]
            doubt = nothing / self.roots[j]
            if -doubt <= uj <= doubt and uj != 0.0:
                u[j] = uj = 0.0  # nothing but rounding of the way
                moved = True
            if not lo <= uj <= hi:
                u[j] = end = lo if uj < lo else hi
                moved = True
                if not abs(uj - end) <= max(doubt, ROUNDING * abs(end)):
                    outside[j] = -1 if uj < lo else 1
        return outside, moved
