"""Constraints on a line of inputs, where all are known in closed form; see `period_search`.

A constraint has the coefficients of 1, of the m inputs u_j and, if it is quadratic, of u_j u_n, j
<= n.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from safe_envs.dynamics.codegen import Flavour
from safe_envs.wrappers.filter_qp.compiled import choose
from safe_envs.wrappers.qp.rounding import ROUNDING

FAR = 1e37
"""No point of a line is further away; it is a number in single precision as well."""
BETTER = 0.999999999
"""Share of the squared violations that is left by a step that helps, beyond rounding."""


class PeriodConstraints:
    """Constraints of one state, or of a batch.

    Args:
        coefficients: of each constraint, more of quadratic ones.
        forms: of those on one input with an uncertainty q_0, q_1, q_2, which ask for a u + b >=
            sqrt(q_0 + 2 q_1 u + q_2 u^2), by their number.
        priorities: weights of the squared violations.
        flavour: "floats" of one state, or "arrays" of a batch.
        m: number of inputs.
    """

    def __init__(
        self,
        coefficients: Sequence[Sequence[Any]],
        forms: Mapping[int, Sequence[Any]],
        priorities: Sequence[float],
        flavour: Flavour,
        m: int,
    ) -> None:
        self.coefficients, self.forms, self.priorities, self.m = coefficients, forms, priorities, m
        places = [(j, n) for j in range(m) for n in range(j, m)]
        self.bends = [
            [(c, j, n) for c, (j, n) in zip(constraint[1 + m :], places, strict=False)]
            for constraint in coefficients
        ]
        self.flavour: Flavour = flavour
        self.alone = flavour == "floats"
        self.choose: Any = choose if self.alone else np.where
        self.larger: Any = max if self.alone else np.maximum
        self.square_root: Any = math.sqrt if self.alone else np.sqrt

    def ratio(self, numerator: Any, denominator: Any, other: float = 0.0) -> Any:
        """Return a quotient.

        Args:
            numerator: of it.
            denominator: of it.
            other: what is returned where there is none.
        """
        some = denominator != 0.0
        return self.choose(some, numerator / self.choose(some, denominator, 1.0), other)

    def step(
        self, u: Sequence[Any], v: Sequence[Any], low: Sequence[Any], high: Sequence[Any]
    ) -> tuple[list[Any], Any]:
        """Move along a line to where constraints are violated least.

        Args:
            u: m inputs.
            v: m others, on the line.
            low: m lower bounds.
            high: m upper bounds.

        Returns:
            The inputs, and which share of the squared violations is left.
        """
        choose = self.choose
        d, proposed = [vj - uj for vj, uj in zip(v, u, strict=True)], 1.0
        if self.m == 1:  # there is one line, whatever is proposed
            d, proposed = [1.0], d[0]
        first, last = -FAR, FAR
        for dj, uj, lo, hi in zip(d, u, low, high, strict=True):
            unit = choose(dj == 0.0, 1.0, dj)
            ends = (lo - uj) / unit, (hi - uj) / unit
            near, far = choose(dj > 0.0, ends[0], ends[1]), choose(dj > 0.0, ends[1], ends[0])
            first = choose(dj == 0.0, first, self.larger(first, near))
            last = choose(dj == 0.0, last, -self.larger(-last, -far))
        lines = [self._line(i, u, d) for i in range(len(self.coefficients))]
        before = self._violation(lines, 0.0)
        best, least = 0.0, before
        for point in (*[t for line in lines for t in self._points(line)], proposed):
            t = choose(point < first, first, choose(point > last, last, point))
            missed = self._violation(lines, t, least)
            better = (missed < BETTER * least) | ((missed == least) & (abs(t) < abs(best)))
            best, least = choose(better, t, best), choose(better, missed, least)
        ends = zip(u, d, low, high, strict=True)
        moved = [(uj + best * dj, lo, hi) for uj, dj, lo, hi in ends]
        inside = [choose(z < lo, lo, choose(z > hi, hi, z)) for z, lo, hi in moved]
        return inside, self.ratio(least, before, 1.0)

    def _line(self, i: int, u: Sequence[Any], d: Sequence[Any]) -> _Line:
        constraint, bends = self.coefficients[i], self.bends[i]
        constant, rate, bend, size = constraint[0], 0.0, 0.0, abs(constraint[0])
        for j, (cj, uj, dj) in enumerate(zip(constraint[1:], u, d, strict=False)):
            constant, rate, size = constant + cj * uj, rate + cj * dj, size + abs(cj * uj)
            for c, first, n in bends:
                if first == j:
                    constant = constant + c * uj * u[n]
                    rate = rate + c * (uj * d[n] + dj * u[n])
                    bend = bend + c * dj * d[n]
                    size = size + abs(c * uj * u[n])
        form = None
        if i in self.forms:
            q0, q1, q2 = self.forms[i]
            at = q0 + 2.0 * q1 * u[0] + q2 * u[0] * u[0]
            form = at, 2.0 * (q1 + q2 * u[0]) * d[0], q2 * d[0] * d[0]
        return _Line(constant, rate, bend, size, form)

    def _violation(self, lines: Sequence[_Line], t: Any, least: Any = math.inf) -> Any:
        """Return the sum of the squared violations at a point of a line, or more than the least."""
        total = 0.0
        for line, priority in zip(lines, self.priorities, strict=True):
            linear, square = line.rate * t, line.bend * t * t
            value = line.constant + linear + square
            if line.form:
                inside = line.form[0] + line.form[1] * t + line.form[2] * t * t
                value = value - self.square_root(self.larger(inside, 0.0))
            if self.alone and value >= 0.0:
                continue
            met = value >= -ROUNDING * (line.size + abs(linear) + abs(square))
            total = self.choose(met, total, total + priority * value * value)
            if self.alone and total > least:
                break
        return total

    def _points(self, line: _Line) -> list[Any]:
        """Return where on a line a constraint may begin to hold, or is violated least.

        These are its roots, a little beyond, so that it holds, and the vertex between them.
        """
        constant, rate, bend = line.constant, line.rate, line.bend
        found = [self.ratio(-0.5 * rate, bend), *self._roots(constant, rate, bend)]
        if line.form:
            found += self._roots(
                constant * constant - line.form[0],
                2.0 * constant * rate - line.form[1],
                rate * rate - line.form[2],
            )
        return found

    def _roots(self, constant: Any, rate: Any, bend: Any) -> tuple[Any, Any]:
        square = rate * rate - 4.0 * bend * constant
        root = self.square_root(self.choose(square < 0.0, 0.0, square))
        half = -0.5 * (rate + self.choose(rate > 0.0, root, -root))
        found = self.ratio(half, bend), self.ratio(constant, half)
        return found[0] + ROUNDING * found[0], found[1] + ROUNDING * found[1]


class _Line(NamedTuple):
    """A constraint on a line: constant + rate t + bend t^2, and the size of its terms.

    Of an uncertain one, the form has the coefficients of 1, t and t^2.
    """

    constant: Any
    rate: Any
    bend: Any
    size: Any
    form: tuple[Any, Any, Any] | None
