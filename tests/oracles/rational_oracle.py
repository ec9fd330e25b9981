"""The nearest least-violating action in rational arithmetic, proved by its optimality conditions,
for any number of inputs."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np


def eliminated(matrix, right):
    """A solution of a consistent linear system, with zeros for what it leaves open; None if there
    is none. Rational Gauss-Jordan."""
    table = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    count = len(matrix[0]) if matrix else 0
    pivots = []
    for column in range(count):
        place = len(pivots)
        at = next((i for i in range(place, len(table)) if table[i][column]), None)
        if at is None:
            continue
        table[place], table[at] = table[at], table[place]
        head = table[place]
        table[place] = head = [entry / head[column] for entry in head]
        for i, row in enumerate(table):
            if i != place and row[column]:
                factor = row[column]
                table[i] = [entry - factor * other for entry, other in zip(row, head, strict=True)]
        pivots.append(column)
    if any(row[-1] for row in table[len(pivots) :]):
        return None
    solution = [Fraction(0)] * count
    for row, column in zip(table, pivots, strict=False):
        solution[column] = row[-1]
    return solution


def dot(a, u):
    return sum((x * y for x, y in zip(a, u, strict=True)), Fraction(0))


def nearest_of_least_violating(a, b, v, low, high, w, priority, near):
    """The exact answer (m Fractions) and whether the rows can be met; None where the search from
    `near` does not end.

    `near` is an approximate answer, from which the sets of missed and binding rows and of held
    inputs are guessed. The guess is changed until every condition of optimality holds exactly, so
    that it has no part in what is returned. Input bounds may be infinite.
    """
    a = [[Fraction(x) for x in row] for row in a]
    b, v, low, high, w, priority = [
        [Fraction(x) if math.isfinite(x) else x for x in map(float, part)]
        for part in (b, v, low, high, w, priority)
    ]
    m, k = len(v), len(b)
    margin = np.array([float(dot(a[i], map(Fraction, map(float, near))) + b[i]) for i in range(k)])
    terms = np.array(
        [
            float(
                sum(abs(x) * abs(Fraction(float(y))) for x, y in zip(a[i], near, strict=True))
                + abs(b[i])
            )
            for i in range(k)
        ]
    )
    for doubt in (1e-9, 1e-12, 1e-6, 1e-14):
        missed = {i for i in range(k) if margin[i] < -doubt * terms[i]}
        binding = {i for i in range(k) if abs(margin[i]) <= doubt * terms[i] and any(a[i])}
        width = [float(h - lo) for lo, h in zip(low, high, strict=True)]
        held = {}
        for j in range(m):
            close = doubt * min(width[j], abs(near[j]) + abs(near[j] - float(v[j])))
            if near[j] - float(low[j]) <= close:
                held[j] = -1
            elif float(high[j]) - near[j] <= close:
                held[j] = 1
        # Where more than enough binds, the search may find no way out of all of it.
        for bound, at in ((binding, held), (set(), held), (binding, {}), (set(), {})):
            found = _proved(a, b, v, low, high, w, priority, set(missed), set(bound), dict(at))
            if found is not None:
                return found
    return None


def _proved(a, b, v, low, high, w, priority, missed, binding, held):
    m, k = len(v), len(b)
    seen = set()
    while (
        state := (frozenset(missed), frozenset(binding), frozenset(held.items()))
    ) not in seen and len(seen) < 60:
        seen.add(state)
        free = [j for j in range(m) if j not in held]
        rows, walls = sorted(missed), sorted(binding)
        fixed = {j: low[j] if side < 0 else high[j] for j, side in held.items()}
        # Least squares over the missed rows, with the binding ones as equations: a point that has
        # the right slacks.
        offset = [b[i] + sum((a[i][j] * fixed[j] for j in held), Fraction(0)) for i in range(k)]
        normal = [
            [sum((priority[i] * a[i][p] * a[i][q] for i in rows), Fraction(0)) for q in free]
            + [a[i][p] for i in walls]
            for p in free
        ]
        normal += [[a[i][q] for q in free] + [Fraction(0)] * len(walls) for i in walls]
        right = [
            -sum((priority[i] * a[i][p] * offset[i] for i in rows), Fraction(0)) for p in free
        ] + [-offset[i] for i in walls]
        point = eliminated(normal, right) if normal else []
        if point is None:
            binding.discard(walls[0])
            continue
        at = dict(zip(free, point, strict=False)) | fixed
        slack = {i: -(dot(a[i], [at[j] for j in range(m)]) + b[i]) for i in rows}
        # The nearest point with these slacks.
        equations = rows + walls
        kkt = [
            [w[p] if p == q else Fraction(0) for q in free] + [-a[i][p] for i in equations]
            for p in free
        ]
        kkt += [[a[i][q] for q in free] + [Fraction(0)] * len(equations) for i in equations]
        right = [w[p] * v[p] for p in free] + [
            -offset[i] - slack.get(i, Fraction(0)) for i in equations
        ]
        solution = eliminated(kkt, right) if kkt else []
        if solution is None:
            return None
        at = dict(zip(free, solution, strict=False)) | fixed
        u = [at[j] for j in range(m)]
        pull = dict(zip(equations, solution[len(free) :], strict=True))
        margin = [dot(a[i], u) + b[i] for i in range(k)]
        change = _wrong(a, v, low, high, w, priority, u, margin, slack, pull, missed, binding, held)
        if change is None:
            return u, not slack
        where, what = change
        if where == "held":
            (
                held.pop(what)
                if what in held
                else held.update({what: -1 if u[what] < low[what] else 1})
            )
        else:
            {"missed": missed, "binding": binding}[where].symmetric_difference_update({what})
            if where == "missed":
                binding.discard(what)
    return None


def _wrong(a, v, low, high, w, priority, u, margin, slack, pull, missed, binding, held):
    """The first condition of optimality that does not hold, as the set to change and its member;
    None if all do."""
    for j, uj in enumerate(u):
        if not low[j] <= uj <= high[j]:
            return "held", j
    for i, value in enumerate(margin):
        if i in missed and slack[i] <= 0:
            return "missed", i
        if i not in missed and value < 0:
            return ("binding", i) if any(a[i]) else ("missed", i)
    for j in range(len(u)):
        force = sum((priority[i] * slack[i] * a[i][j] for i in missed), Fraction(0))
        if j not in held and force:
            return ("binding", next(iter(binding))) if binding else ("held", j)
        if j in held and force * held[j] < 0:
            return "held", j
    for j, side in held.items():
        rest = w[j] * (u[j] - v[j]) - sum((pull[i] * a[i][j] for i in pull), Fraction(0))
        if rest * side > 0:
            force = sum((priority[i] * slack[i] * a[i][j] for i in missed), Fraction(0))
            if not force:
                return "held", j
    for i in binding:
        if pull[i] < 0:
            return "binding", i
    return None
