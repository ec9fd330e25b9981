"""Constraints that hold along the period for which their input is held.

A constraint a u + b >= 0 with a margin of first order changes at a rate that is quadratic in the
held input. To first order its value at the end of the period dt is

    q(u) = a u + b + dt (c_0 + c u + u' C u),

so that it holds all along the period where a u + b >= 0 and q(u) >= 0: two rows, of which one is
quadratic. Where the input that the constraints allow at its beginning violates a row, each round
takes one step of Newton's method: the rows are linearised there, and the QP proposes another input.
On the line through both, all rows are known in closed form, and the step ends at the nearest input
at which all of them hold. Where there is none on the line, it ends where their squared violations
are least among the roots and vertices of rows and what the QP proposed; where that helps little,
lines along each input are tried. So for one input one step finds the nearest one, whatever the
curvatures; several inputs end at one that has been checked, which need not be the nearest.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Flavour
from safe_envs.wrappers.filter_qp.compiled import choose
from safe_envs.wrappers.qp.rounding import ROUNDING

ROUNDS = 12
"""Of Newton's method; it stops where all rows hold, or where a step does not help."""
BETTER = 1.0 - 1e-9
"""Share of the squared violations that is left by a step that helps, beyond rounding."""
ENOUGH = 0.99
"""Share of them that is left by a round after which another one is tried."""
SLOW = 0.25
"""Share of them that is left by a step after which lines along each input are tried."""
INWARDS = 1e-8
"""Share of its terms without input by which a row of the end of the period has to exceed 0. A
filter that rides the edge would else be carried beyond it by the errors of integrators."""


class _Held(NamedTuple):
    """Rows at an input.

    Attributes:
        slopes: coefficients of the rows, linearised there.
        offsets: of these.
        value: of each row.
        met: whether each row holds.
    """

    slopes: list[list[Any]]
    offsets: list[Any]
    value: list[Any]
    met: list[Any]


class _OnLine(NamedTuple):
    """A row on a line: constant + rate t + bend t^2, and the size of its terms.

    Of an uncertain one, the form has the coefficients of 1, t and t^2.
    """

    constant: Any
    rate: Any
    bend: Any
    size: Any
    form: tuple[Any, Any, Any] | None


class HeldRows:
    """The rows of k constraints at the beginning of a period, and of some at its end.

    A row has the coefficients of 1, of the m inputs u_j and, if it is quadratic, of u_j u_n, j <=
    n.

    Args:
        a: m coefficients of each constraint, of one state or of a batch.
        b: k offsets.
        falls: by the number of the constraint, the row of its change within the period.
        forms: of constraints on one input with an uncertainty q_0, q_1, q_2, which ask for a u + b
            >= sqrt(q_0 + 2 q_1 u + q_2 u^2), by their number.
        priorities: k weights of the squared violations.
        flavour: "floats" of one state, or "arrays" of a batch.
    """

    def __init__(
        self,
        a: Sequence[Sequence[Any]],
        b: Sequence[Any],
        falls: Mapping[int, Sequence[Any]],
        forms: Mapping[int, Sequence[Any]],
        priorities: Sequence[float],
        flavour: Flavour,
    ) -> None:
        self._owners = [*range(len(b)), *falls]
        self._rows = [[bi, *ai] for ai, bi in zip(a, b, strict=True)]
        self._rows += [_end_of_period(self._rows[i], fall) for i, fall in falls.items()]
        self._forms, self._priorities = forms, [priorities[i] for i in self._owners]
        arrays = flavour == "arrays"
        self._choose: Any = np.where if arrays else choose
        self._larger: Any = np.maximum if arrays else max
        self._square_root: Any = np.sqrt if arrays else math.sqrt

    def hold(
        self,
        u: Sequence[Any],
        active: Sequence[Any],
        project: Callable[..., Any],
        bounds: tuple[Sequence[Any], Sequence[Any]],
        w: Sequence[float],
    ) -> tuple[Sequence[Any], list[Any], list[Any], Any]:
        """Move an input to where the rows hold.

        Args:
            u: m components of the input.
            active: which constraints have changed it so far.
            project: projects inputs; see `safe_envs.wrappers.qp.dispatch`.
            bounds: m lower and m upper bounds.
            w: m weights of the inputs.

        Returns:
            The input, the lesser value of each constraint, which have changed the input, and
            whether all rows hold.
        """
        active = list(active)
        for remaining in reversed(range(ROUNDS + 1)):
            found = self._at(u)
            for i, met in zip(self._owners, found.met, strict=True):
                active[i] = self._choose(met, active[i], True)
            all_met = functools.reduce(operator.and_, found.met)
            if not remaining or np.all(all_met):
                break
            v = project(found.slopes, found.offsets, u, *bounds, w, self._priorities)[0]
            u, left = self._step(u, v, *bounds)
            slow = left > SLOW
            for j in range(len(u) if len(u) > 1 and np.any(slow) else 0):
                axis = [uj + self._choose(slow, 1.0, 0.0) * (n == j) for n, uj in enumerate(u)]
                u, more = self._step(u, axis, *bounds)
                left = left * more
            if not np.any(left < ENOUGH):
                break
        margin = found.value[: len(active)]
        for i, value in zip(self._owners, found.value, strict=True):
            margin[i] = self._choose(value < margin[i], value, margin[i])
        return u, margin, active, all_met

    def _at(self, u: Sequence[Any]) -> _Held:
        """Return the rows at an input."""
        found = _Held([], [], [], [])
        for i, row in enumerate(self._rows):
            value, size, offset = row[0], abs(row[0]), row[0]
            slopes = list(row[1 : 1 + len(u)])
            for cj, uj in zip(slopes, u, strict=True):
                value, size = value + cj * uj, size + abs(cj * uj)
            for c, j, n in _bends(row, len(u)):
                term = c * u[j] * u[n]
                value, size, offset = value + term, size + abs(term), offset - term
                slopes[j] = slopes[j] + c * u[n]
                slopes[n] = slopes[n] + c * u[j]
            allowed = ROUNDING * size
            if i in self._forms:
                root, steepness, blur = self._root(self._forms[i], u[0])
                value, allowed = value - root, allowed + blur
                slopes, offset = [slopes[0] - steepness], offset + (steepness * u[0] - root)
            for part, entry in zip(found, (slopes, offset, value, value >= -allowed), strict=True):
                part.append(entry)
        return found

    def _root(self, form: Sequence[Any], u: Any) -> tuple[Any, Any, Any]:
        """Return the root of an uncertainty, its slope, and the error of its rounding."""
        linear, square = 2.0 * form[1] * u, form[2] * u * u
        inside = self._larger(form[0] + linear + square, 0.0)
        root, blur = self._square_root(inside), ROUNDING * (abs(form[0]) + abs(linear) + square)
        allowed = self._choose(inside > 0.0, self._square_root(inside + blur) - root, 0.0)
        return root, self._ratio(form[1] + form[2] * u, root), allowed

    def _step(
        self, u: Sequence[Any], v: Sequence[Any], low: Sequence[Any], high: Sequence[Any]
    ) -> tuple[list[Any], Any]:
        """Move along the line from u through v.

        Returns:
            The input, and which share of the squared violations is left.
        """
        choose = self._choose
        d, proposed = [vj - uj for vj, uj in zip(v, u, strict=True)], 1.0
        if len(d) == 1:  # there is one line, whatever the QP proposes
            d, proposed = [1.0], d[0]
        first, last = -1e300, 1e300
        for dj, uj, lo, hi in zip(d, u, low, high, strict=True):
            unit = choose(dj == 0.0, 1.0, dj)
            ends = (lo - uj) / unit, (hi - uj) / unit
            near, far = choose(dj > 0.0, ends[0], ends[1]), choose(dj > 0.0, ends[1], ends[0])
            first = choose(dj == 0.0, first, self._larger(first, near))
            last = choose(dj == 0.0, last, -self._larger(-last, -far))
        lines = [self._on_line(i, u, d) for i in range(len(self._rows))]
        before = self._violation(lines, 0.0)
        best, least = 0.0, before
        for point in (*[t for line in lines for t in self._points(line)], proposed):
            t = choose(point < first, first, choose(point > last, last, point))
            missed = self._violation(lines, t)
            better = (missed < BETTER * least) | ((missed == least) & (abs(t) < abs(best)))
            best, least = choose(better, t, best), choose(better, missed, least)
        ends = zip(u, d, low, high, strict=True)
        moved = [(uj + best * dj, lo, hi) for uj, dj, lo, hi in ends]
        inside = [choose(z < lo, lo, choose(z > hi, hi, z)) for z, lo, hi in moved]
        return inside, self._ratio(least, before, 1.0)

    def _on_line(self, i: int, u: Sequence[Any], d: Sequence[Any]) -> _OnLine:
        row = self._rows[i]
        constant, rate, bend, size = row[0], 0.0, 0.0, abs(row[0])
        bends = _bends(row, len(u))
        for j, (cj, uj, dj) in enumerate(zip(row[1:], u, d, strict=False)):
            constant, rate, size = constant + cj * uj, rate + cj * dj, size + abs(cj * uj)
            for c, first, n in bends:
                if first == j:
                    constant = constant + c * uj * u[n]
                    rate = rate + c * (uj * d[n] + dj * u[n])
                    bend = bend + c * dj * d[n]
                    size = size + abs(c * uj * u[n])
        form = None
        if i in self._forms:
            q0, q1, q2 = self._forms[i]
            at = q0 + 2.0 * q1 * u[0] + q2 * u[0] * u[0]
            form = at, 2.0 * (q1 + q2 * u[0]) * d[0], q2 * d[0] * d[0]
        return _OnLine(constant, rate, bend, size, form)

    def _violation(self, lines: Sequence[_OnLine], t: Any) -> Any:
        """Return the sum of the squared violations at a point of a line."""
        total = 0.0
        for line, priority in zip(lines, self._priorities, strict=True):
            linear, square = line.rate * t, line.bend * t * t
            value = line.constant + linear + square
            if line.form:
                inside = line.form[0] + line.form[1] * t + line.form[2] * t * t
                value = value - self._square_root(self._larger(inside, 0.0))
            met = value >= -ROUNDING * (line.size + abs(linear) + abs(square))
            total = self._choose(met, total, total + priority * value * value)
        return total

    def _points(self, line: _OnLine) -> list[Any]:
        """Return where on a line a row may begin to hold, or is violated least.

        These are its roots, a little beyond, so that it holds, and the vertex between them.
        """
        constant, rate, bend = line.constant, line.rate, line.bend
        found = [self._ratio(-0.5 * rate, bend), *self._roots(constant, rate, bend)]
        if line.form:
            found += self._roots(
                constant * constant - line.form[0],
                2.0 * constant * rate - line.form[1],
                rate * rate - line.form[2],
            )
        return found

    def _roots(self, constant: Any, rate: Any, bend: Any) -> tuple[Any, Any]:
        square = rate * rate - 4.0 * bend * constant
        root = self._square_root(self._choose(square < 0.0, 0.0, square))
        half = -0.5 * (rate + self._choose(rate > 0.0, root, -root))
        found = self._ratio(half, bend), self._ratio(constant, half)
        return found[0] + ROUNDING * found[0], found[1] + ROUNDING * found[1]

    def _ratio(self, numerator: Any, denominator: Any, other: float = 0.0) -> Any:
        """Return a quotient, or another number where it is none."""
        some = denominator != 0.0
        return self._choose(some, numerator / self._choose(some, denominator, 1.0), other)


def _bends(row: Sequence[Any], m: int) -> list[tuple[Any, int, int]]:
    """Return the coefficients of u_j u_n with j and n; none of linear rows."""
    places = ((j, n) for j in range(m) for n in range(j, m))
    return [(c, j, n) for c, (j, n) in zip(row[1 + m :], places, strict=False)]


def _end_of_period(row: Sequence[Any], fall: Sequence[Any]) -> list[Any]:
    """Return the row of a constraint at the end of the period."""
    offset = row[0] + fall[0] - INWARDS * (abs(row[0]) + abs(fall[0]))
    return [
        offset,
        *[aj + cj for aj, cj in zip(row[1:], fall[1:], strict=False)],
        *fall[len(row) :],
    ]
