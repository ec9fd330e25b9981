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

As `safe_envs.engine.qp.working_set`, with arrays whose last axis is the batch. A working set is a
mask (k, B) of constraints, and -1 for inputs at the lower, 1 at the upper bound, else 0 (m, B).

    min 1/2 sum_j w_j (u_j - v_j)^2 + 1/(2 e) sum_i priority_i slack_i^2,   low <= u <= high

With all constraints loosened by as much as the furthest is missed, the clipped proposal is the
minimiser. They are tightened together; the minimiser moves along lines, and where one ends, a
constraint or bound begins to count or no longer does. That is a principal pivot of

    r = t - y + N' p,   s = c + N y + D p

with inputs y, pressures p, margins s and forces r on the inputs, of which each pair (y, r) and (p,
s) has one member that follows from the others; `table` holds how. D is small and positive, so that
every pivot is possible. All states take their pivots at the same time.

Source: R. W. Cottle, J.-S. Pang, R. E. Stone, The Linear Complementarity Problem, 1992, Sec. 4.5.

Its tolerances are absolute, so that the inputs are measured from the clipped proposal, in ways to
the furthest constraint, and constraints have unit length.

Vectors that depend on those before them, up to rounding, add nothing to the basis. Then a step
cannot have any products with all of them: it has those that fit best, in weighted squares.

Two steps. The least sum of squared slacks comes from bounded least squares; where it is zero, the
constraints can be met. The slacks are the same at all its minimisers, so that these are the actions
inside the input bounds which violate no constraint by more. Among them the nearest one to the
proposal is found by a primal active-set method, which begins at the one at hand and never leaves
them (Nocedal and Wright, Numerical Optimization, Sec. 16.5). Distances are those of y = sqrt(w) u,
where the objective is |y - y_v|^2 and constraints have unit length.

Rounding counts: with constraints or inputs whose sizes differ by more than about a million, the
action may be somewhat worse than the best. It stays within the input bounds, and is flagged where a
constraint is missed.
"""

from __future__ import annotations

import functools
import math
from array import array
from collections.abc import Iterator, Sequence
from operator import mul, sub, truediv
from typing import Any, NamedTuple

import daqp
import numpy as np

from safe_envs.engine.qp.bounded_least_squares import least_violating
from safe_envs.engine.qp.rounding import ROUNDING, Floats, PlainQP, margins, tolerances, total

_ENOUGH = 0.5
"""Part of a vector next to which the rounding of what the others take from it is none."""
_INDEPENDENT = 1e-8
"""Part of the entries of weighted vectors that surely is more than rounding."""


def orthonormal(
    vectors: Sequence[list[float]], least: float
) -> tuple[list[list[float]], list[list[float]]]:
    """Return an orthonormal basis, and the coordinates of each vector as far as they are not 0.

    Args:
        vectors: the vectors, of n entries.
        least: length of what is left of a vector that adds to the basis.
    """
    basis: list[list[float]] = []
    coordinates = []
    for vector in vectors:
        rest, shares = vector, []
        for e in basis:
            share = sum(map(mul, e, rest))
            rest = [x - share * y for x, y in zip(rest, e, strict=True)]
            shares.append(share)
        left = math.hypot(*rest)
        if basis and not left > _ENOUGH * math.hypot(*vector):
            for c, e in enumerate(basis):  # takes back the rounding of the first time
                share = sum(map(mul, e, rest))
                rest = [x - share * y for x, y in zip(rest, e, strict=True)]
                shares[c] += share
            left = math.hypot(*rest)
        if left > least:
            basis.append([x / left for x in rest])
            shares.append(left)
        coordinates.append(shares)
    return basis, coordinates


class LineSpan:
    """The span of one vector, or of numbers; as `RowSpan`.

    Args:
        vectors: one vector of n entries, or several of one.
        weights: roots of the weights of their squares.

    Attributes:
        dependent: whether there are several.
        inverse: what the products with the vectors count in the step, or in its entries.
    """

    def __init__(self, vectors: Sequence[list[float]], weights: Floats) -> None:
        self.dependent = len(vectors) > 1
        numbers = [vector[0] for vector in vectors] if self.dependent else vectors[0]
        pulls = numbers
        if self.dependent:
            largest = max(weights)
            pulls = [n * (w / largest) ** 2 for n, w in zip(numbers, weights, strict=True)]
        square = sum(map(mul, pulls, numbers))
        self.inverse = [pull / square for pull in pulls] if any(numbers) else numbers

    def step(self, products: Floats) -> list[float]:
        """Return the shortest step (n) that has given products with the vectors.

        Args:
            products: one for each vector.
        """
        if self.dependent:
            return [sum(map(mul, self.inverse, products))]
        (product,) = products
        return [product * part for part in self.inverse]

    def pressures(self, way: Floats) -> list[float]:
        """Return the least factors with which the vectors add up to the part of a way in the span.

        Args:
            way: n entries.
        """
        if self.dependent:
            (length,) = way
            return [length * part for part in self.inverse]
        return [sum(map(mul, self.inverse, way))]


class RowSpan:
    """The span of vectors.

    Args:
        vectors: the vectors, of n entries.
        weights: roots of the weights of their squares, where they depend on each other.

    Attributes:
        dependent: whether some depend on the others.
    """

    def __init__(self, vectors: Sequence[list[float]], weights: Floats) -> None:
        # More vectors than entries are fitted without a basis, if their entries are independent.
        self._basis: list[list[float]] = []
        self._direct = False
        self._size = len(vectors[0])
        self.dependent = self._size < len(vectors)
        if self.dependent:
            self._fit([*zip(*vectors, strict=True)], weights)
            self._direct = len(self._fits) == self._size
            if self._direct:
                return
        self._basis, self._coordinates = orthonormal(vectors, _DEPENDENT)
        rank = len(self._basis)
        self.dependent = rank < len(vectors)
        if self.dependent:
            columns = [
                [shares[c] if c < len(shares) else 0.0 for shares in self._coordinates]
                for c in range(rank)
            ]
            self._fit(columns, weights, -1.0)

    def _fit(
        self, columns: Sequence[Sequence[float]], weights: Floats, least: float = _INDEPENDENT
    ) -> None:
        largest = max(weights)
        self._weights = [weight / largest for weight in weights]
        weighted = [[*map(mul, self._weights, column)] for column in columns]
        self._fits, self._coordinates = orthonormal(weighted, least)

    def step(self, products: Floats) -> list[float]:
        """Return the shortest step (n) that has given products with the vectors.

        Args:
            products: one for each vector.
        """
        found: list[float] = []
        if self.dependent:
            scaled = [*map(mul, self._weights, products)]
            found = [sum(map(mul, e, scaled)) for e in self._fits]
            for c in range(len(found) - 1, -1, -1):
                shares = self._coordinates[c]
                found[c] /= shares[c]
                for d in range(c):
                    found[d] -= shares[d] * found[c]
            if self._direct:
                return found
        else:
            for shares, product in zip(self._coordinates, products, strict=True):
                found.append((product - sum(map(mul, found, shares))) / shares[-1])
        if not found:
            return [0.0] * self._size
        step = [found[0] * x for x in self._basis[0]]
        for c in range(1, len(found)):
            share = found[c]
            step = [x + share * y for x, y in zip(step, self._basis[c], strict=True)]
        return step

    def pressures(self, way: Floats) -> list[float]:
        """Return the least factors with which the vectors add up to the part of a way in the span.

        Args:
            way: n entries.
        """
        found = [*way] if self._direct else [sum(map(mul, e, way)) for e in self._basis]
        if not self.dependent:
            for i in range(len(found) - 1, -1, -1):
                shares = self._coordinates[i]
                found[i] /= shares[i]
                for c in range(i):
                    found[c] -= shares[c] * found[i]
            return found
        for c, shares in enumerate(self._coordinates):
            found[c] = (found[c] - sum(map(mul, found[:c], shares))) / shares[c]
        return [
            weight * sum([part * e[i] for part, e in zip(found, self._fits, strict=True)])
            for i, weight in enumerate(self._weights)
        ]


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


_DEPENDENT = 1e-14
"""Part of a unit normal that the rounding of others leaves of it."""


class ArrayQP(NamedTuple):
    """QPs over a batch of B states, with constraints that may say nothing of the input.

    Attributes:
        a: constraints, shape (k, m, B).
        b: offsets, shape (k, B).
        v: proposed inputs, shape (m, B).
        low: lower bounds, shape (m, B).
        high: upper bounds, shape (m, B).
        roots: of the weights, shape (m, B).
        priority: positive weights of the squared slacks, shape (k, 1).
        normals: constraints of unit length in inputs times roots, shape (k, m, B).
        lengths: of the constraints, 1 for those that say nothing, shape (k, B).
    """

    a: np.ndarray
    b: np.ndarray
    v: np.ndarray
    low: np.ndarray
    high: np.ndarray
    roots: np.ndarray
    priority: np.ndarray
    normals: np.ndarray
    lengths: np.ndarray

    @classmethod
    def of(
        cls,
        a: np.ndarray,
        b: np.ndarray,
        v: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        w: np.ndarray,
        priority: np.ndarray,
    ) -> ArrayQP:
        """Return the QPs.

        Args:
            a: constraints, shape (k, m, B).
            b: offsets, shape (k, B).
            v: proposed inputs, shape (m, B).
            low: lower bounds, shape (m, B).
            high: upper bounds, shape (m, B).
            w: positive weights of the inputs, shape (m, B).
            priority: positive weights of the squared slacks, shape (k, 1).
        """
        roots = np.sqrt(w)
        normals = a / roots
        sizes = np.abs(normals).max(axis=1)
        sizes[sizes == 0.0] = 1.0
        normals /= sizes[:, None]  # so that squares neither overflow nor vanish
        lengths = np.sqrt(total(np.swapaxes(normals * normals, 0, 1)))
        lengths[lengths == 0.0] = 1.0
        normals /= lengths[:, None]
        return cls(a, b, v, low, high, roots, priority, normals, lengths * sizes)

    def take(self, states: np.ndarray) -> ArrayQP:
        """Return the QPs of some states."""
        a, b, v, low, high, roots, _, normals, lengths = [
            part if part is self.priority else part[..., states] for part in self
        ]
        return ArrayQP(a, b, v, low, high, roots, self.priority, normals, lengths)

    def margins(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the margins (k, B) at inputs (m, B), and their rounding."""
        products = np.swapaxes(self.a * u, 0, 1)
        margin = total(products) + self.b
        np.abs(products, out=products)
        return margin, ROUNDING * (total(products) + np.abs(self.b))


class Points(NamedTuple):
    """Inputs (m, B), margins and their rounding (k, B), and which inputs are proved (B,)."""

    u: np.ndarray
    margin: np.ndarray
    allowed: np.ndarray
    proved: np.ndarray


def find_points(p: ArrayQP, rows: np.ndarray, at: np.ndarray) -> Points:
    """Return the points of working sets.

    Args:
        p: the QPs.
        rows: constraints that count, shape (k, B).
        at: bounds that hold the inputs, shape (m, B).
    """
    free = at == 0
    u = np.where(free, p.v, np.where(at < 0, p.low, p.high))
    fit = _Fit(np.where(rows[:, None] & free, p.normals, 0.0), rows, p)
    for _ in range(_CORRECTIONS):
        gaps = np.where(rows, (total(np.swapaxes(p.a * u, 0, 1)) + p.b) / p.lengths, 0.0)
        steps = fit.steps(gaps) / p.roots
        u = u - steps
        if (np.abs(steps) <= ROUNDING * np.abs(u)).all():
            break
    way = (u - p.v) * p.roots
    nothing = ROUNDING * np.abs(way).max(axis=0)
    u = np.where(free & (np.abs(u) * p.roots <= nothing), 0.0, u)
    inside = np.minimum(np.maximum(u, p.low), p.high)
    doubt = np.maximum(nothing / p.roots, ROUNDING * np.abs(inside))
    proved: Any = (np.abs(u - inside) <= doubt).all(axis=0)
    u = inside
    way = (u - p.v) * p.roots
    margin, allowed = p.margins(u)
    pressures = fit.pressures(np.where(free, way, 0.0))
    missed = margin < -SURELY * allowed
    proved &= np.where(
        rows, missed | ((pressures >= -nothing) & (margin <= allowed)), margin >= -allowed
    ).all(axis=0)
    proved &= missed.any(axis=0) | (margin >= -allowed).all(axis=0)
    # Over the steepest, so that small forces do not vanish.
    unit = np.where(missed, p.lengths, 0.0).max(axis=0)
    unit = np.where(unit > 0.0, unit, 1.0)
    parts = p.a * np.where(missed, p.priority * (-margin / unit), 0.0)[:, None]
    force, doubt = total(parts), _NOTHING * total(np.abs(parts))
    rest = way - total(p.normals * pressures[:, None])
    outwards = force * at
    presses = (outwards > doubt) | ((outwards >= -doubt) & (rest * at <= nothing))
    balanced: Any = np.where(free, np.abs(force) <= doubt, presses).all(axis=0)
    close = (proved & ~balanced).nonzero()[0]
    if close.size:  # then the rounding of the slacks counts, too
        errors = np.where(missed, p.priority * allowed, 0.0)[:, close] / unit[close]
        unsure = doubt[:, close] + total(np.abs(p.a[..., close]) * errors[:, None])
        balanced[close] = np.where(
            free[:, close], np.abs(force[:, close]) <= unsure, presses[:, close]
        ).all(axis=0)
    proved &= balanced
    return Points(u, margin, allowed, proved)


class _Fit:
    """Normals as sums of an orthonormal basis, and the least squares fit of their coordinates.

    Args:
        normals: of constraints that count along free inputs, else 0, shape (k, m, B).
        rows: constraints that count, shape (k, B).
        p: the QPs.
    """

    def __init__(self, normals: np.ndarray, rows: np.ndarray, p: ArrayQP) -> None:
        k, m, size = normals.shape
        basis, coordinates = np.zeros((m, m, size)), np.zeros((m, k, size))
        rank = np.zeros(size, dtype=np.intp)
        every = np.arange(size)
        for i in range(k):
            rest, most = normals[i], min(i, m)
            for _ in range(2):  # the second time takes back the rounding of the first
                for c in range(most):
                    share = total(basis[c] * rest)
                    rest = rest - share * basis[c]
                    coordinates[c, i] += share
            left = np.sqrt(total(rest * rest))
            new = (left > _DEPENDENT) & (rank < m)
            if i == 0:
                left = np.where(new, left, 1.0)
                basis[0], coordinates[0, 0] = (
                    np.where(new, rest / left, 0.0),
                    np.where(new, left, 0.0),
                )
            else:
                places, states = rank[new], every[new]
                basis[places, :, states] = (rest[:, new] / left[new]).T
                coordinates[places, i, states] = left[new]
            rank += new
        sizes = np.sqrt(p.priority) * p.lengths
        sizes = np.where(rows, sizes, 0.0)
        largest = sizes.max(axis=0)
        whole = rank == np.count_nonzero(rows, axis=0)
        self._weights = np.where(whole, 1.0, sizes / np.where(largest > 0.0, largest, 1.0))
        self._basis = basis
        self._most = most = min(k, m)
        self._fits = coordinates[:most] * self._weights
        self._triangle = np.zeros((most, most, size))
        for c in range(most):
            column = self._fits[c]
            for _ in range(2):
                for d in range(c):
                    share = total(self._fits[d] * column)
                    column = column - share * self._fits[d]
                    self._triangle[d, c] += share
            left = np.sqrt(total(column * column))
            left[left == 0.0] = 1.0
            self._fits[c] = column / left
            self._triangle[c, c] = left

    def steps(self, gaps: np.ndarray) -> np.ndarray:
        """Return the shortest steps (m, B) that fit gaps (k, B) best."""
        scaled = gaps * self._weights
        found = [total(self._fits[c] * scaled) for c in range(self._most)]
        for c in range(self._most - 1, -1, -1):
            found[c] = found[c] / self._triangle[c, c]
            for d in range(c):
                found[d] = found[d] - self._triangle[d, c] * found[c]
        step = found[0] * self._basis[0]
        for c in range(1, self._most):
            step += found[c] * self._basis[c]
        return step

    def pressures(self, way: np.ndarray) -> np.ndarray:
        """Return the least factors (k, B) with which normals make up ways (m, B) in their span."""
        found = [total(self._basis[c] * way) for c in range(self._most)]
        result = np.zeros_like(self._weights)
        for c in range(self._most):
            for d in range(c):
                found[c] = found[c] - self._triangle[d, c] * found[d]
            found[c] = found[c] / self._triangle[c, c]
            result += found[c] * self._fits[c]
        return result * self._weights


_STILL = 1e-13
"""Change of a variable that is rounding."""
_SMALLEST = 1e-50
"""Of the lengths of constraints, over the largest: the squares of smaller ones would vanish."""
_MANY = 200
"""States of which arrays with all their variables are too long for one operation."""
_PIVOTS = 5
"""Pivots for each constraint and input."""


def propose_parametric(p: ArrayQP, soft: float, firm: float) -> tuple[np.ndarray, np.ndarray]:
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


_INFINITY = 1e30
_SETTINGS = {"primal_tol": 1e-11, "dual_tol": 1e-12, "iter_limit": 500}
_SOFT = 1e-4
"""Root of the weight of the inputs against that of the constraint that weighs least."""
_FIRM = 1e-7
"""That against the constraint that weighs most: where it is less, rounding hides the slacks."""


def propose_daqp(qp: FloatQP) -> Iterator[WorkingSet]:
    """Yield working sets, the likeliest first.

    Args:
        qp: a QP whose constraints the clipped proposal misses.
    """
    k, m = len(qp.b), len(qp.v)
    gaps = [-value / length for value, length in zip(qp.margin, qp.lengths, strict=True)]
    unit = max(gaps)
    start, scales = qp.start, [root / unit for root in qp.roots]
    least = [*map(mul, map(sub, qp.low, start), scales)]
    lower = array("d", least + [gap / unit for gap in gaps])
    upper = array("d", [*map(mul, map(sub, qp.high, start), scales)] + [_INFINITY] * k)
    target = [*map(mul, map(sub, start, qp.v), scales)]
    sizes, nothing = qp.sizes, [0.0] * k
    smallest, largest = min(sizes), max(sizes)
    # Where constraints weigh very differently, soft ones give way though they could be met.
    soft = max(_SOFT * smallest, _FIRM * largest)
    for width in (k, 0) if soft < 100.0 * _SOFT * smallest else (0, k):
        if width:
            numbers = []
            for i, normal in enumerate(qp.normals):
                numbers += normal
                numbers += nothing
                numbers[i - k] = soft / sizes[i]
        else:
            numbers = [c for normal in qp.normals for c in normal]
        pressures = _pressures(m + width, k, target + nothing[:width], numbers, upper, lower)
        if pressures:
            yield WorkingSet(
                [i for i in range(k) if pressures[m + i] < 0.0],
                [-1 if q < 0.0 else 1 if q > 0.0 else 0 for q in pressures[:m]],
            )


def _pressures(
    n: int, k: int, target: list[float], numbers: list[float], upper: Any, lower: Any
) -> list[float]:
    """Return the pressures of bounds and constraints, with signs; none where there is no answer."""
    rows: Any = memoryview(array("d", numbers)).cast("B").cast("d", (k, n))
    identity, sense = _constants(n, len(upper))
    _, _, flag, info = daqp.solve(
        identity, array("d", target), rows, upper, lower, sense, **_SETTINGS
    )
    return info["lam"].tolist() if flag > 0 else []


@functools.cache
def _constants(n: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.eye(n), np.zeros(count, dtype=np.intc)


_STEPS = 20
"""Steps for each constraint and input: many times more than were ever seen."""

_PARALLEL = 1e-13
"""Part of a step along which a constraint changes by rounding only."""

_NO_STEP = 1e-13
"""Part of the way to the proposal that is rounding."""

_LOST = 4.0
"""How many tolerances of a constraint the way to the nearest action may cost."""

_SLACK_CORRECTIONS = 2
"""How often the constraints that hold the action are evaluated there: the first time takes back the
rounding of the way to it."""


def project(
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    priority: np.ndarray,
) -> np.ndarray:
    """Return the nearest action (m,) of those that violate the constraints least.

    It is NaN where the numbers are too large to say.

    Args:
        a: constraints, shape (k, m).
        b: offsets, shape (k,).
        v: proposed inputs, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        w: positive weights, shape (m,).
        priority: positive weights of the squared slacks, shape (k,).
    """
    u = np.clip(v, low, high)
    # An input on which no constraint depends keeps its proposal, and a constraint that depends on
    # no input has no say.
    rows, inputs = (a != 0.0).any(axis=1), (a != 0.0).any(axis=0)
    if not rows.any():
        return u
    try:
        u[inputs] = _project(
            a[np.ix_(rows, inputs)],
            b[rows],
            v[inputs],
            low[inputs],
            high[inputs],
            w[inputs],
            priority[rows],
        )
    except np.linalg.LinAlgError:
        u[inputs] = np.nan
    return u


def _project(
    a: np.ndarray,
    b: np.ndarray,
    v: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    w: np.ndarray,
    priority: np.ndarray,
) -> np.ndarray:
    start = least_violating(a, b, low, high, priority, np.clip(v, low, high))
    margin = a @ start + b
    slack = np.where(margin < -tolerances(a.T, b, start), -margin, 0.0)
    unit, roots = np.abs(a).max(axis=1), np.sqrt(w)
    normals = a / unit[:, None] / roots
    lengths = np.linalg.norm(normals, axis=1)
    normals, unit = normals / lengths[:, None], unit * lengths
    held = _nearest(
        normals,
        np.maximum(margin + slack, 0.0) / unit,
        (v - start) * roots,
        (low - start) * roots,
        (high - start) * roots,
    )
    u = np.where(held.low, low, np.where(held.high, high, start + held.step / roots))
    free, binding = ~(held.low | held.high), held.rows
    for _ in range(_SLACK_CORRECTIONS):
        excess = (a @ u + b + slack)[binding] / unit[binding]
        u[free] -= np.linalg.lstsq(normals[np.ix_(binding, free)], excess)[0] / roots[free]
    u = np.clip(u, low, high)
    # Where constraints or inputs differ by many orders of magnitude, rounding may lead astray: then
    # the least-violating action itself is safer.
    worse = np.maximum(-(a @ u + b), 0.0) - np.maximum(-margin, 0.0)
    return (
        u if (worse <= _LOST * (tolerances(a.T, b, u) + tolerances(a.T, b, start))).all() else start
    )


class _Held(NamedTuple):
    """End of a step (m,), with the constraints (k,) and bounds (m,) that hold it."""

    step: np.ndarray
    rows: np.ndarray
    low: np.ndarray
    high: np.ndarray


def _nearest(
    normals: np.ndarray, spare: np.ndarray, way: np.ndarray, low: np.ndarray, high: np.ndarray
) -> _Held:
    """Return the step nearest to the proposal that the constraints and bounds allow.

    It has normals . step + spare >= 0 and low <= step <= high; 0 is such a step.

    Where no step leads nearer, the rest of the way is a sum of the normals of what holds the step.
    What has the wrong sign in it is let go.
    """
    k, m = normals.shape
    step, rows, at = np.zeros(m), np.zeros(k, dtype=bool), np.zeros(m)
    for _ in range(_STEPS * (k + m)):
        free = at == 0.0
        rest = way - step
        working = normals[np.ix_(rows, free)].T
        pull = np.linalg.lstsq(working, rest[free])[0]
        move = np.zeros(m)
        move[free] = rest[free] - working @ pull
        move[free] -= working @ np.linalg.lstsq(working, move[free])[0]
        size = np.abs(move).max(initial=0.0)
        if size > _NO_STEP * np.abs(rest[free]).max(initial=0.0):
            ends = np.where(move > 0.0, high, low)
            to_ends = np.divide(ends - step, move, out=np.full(m, np.inf), where=move != 0.0)
            change, left = normals @ move, normals @ step + spare
            to_rows = np.divide(
                np.maximum(left, 0.0),
                -change,
                out=np.full(k, np.inf),
                where=~rows & (change < -_PARALLEL * size),
            )
            length = min(to_ends.min(), to_rows.min(initial=np.inf), 1.0)
            stops = to_ends <= length
            step = np.where(stops, ends, np.clip(step + length * move, low, high))
            if length < 1.0:
                # One at a time, so that the normals stay independent.
                if stops.any():
                    at = np.where(stops, np.sign(move), at)
                else:
                    rows[to_rows.argmin()] = True
                continue
        against = np.zeros(k)
        against[rows] = pull
        pressed = np.where(free, 0.0, -at * (way - step - normals[rows].T @ pull))
        if max(against.max(initial=0.0), pressed.max()) <= _NO_STEP * np.abs(way).max():
            break
        if against.max(initial=0.0) >= pressed.max():
            rows[against.argmax()] = False
        else:
            at[pressed.argmax()] = 0.0
    return _Held(step, rows, at < 0.0, at > 0.0)
