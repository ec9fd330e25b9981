"""A second opinion on certificates: mean-value forms in the ball arithmetic of Arb.

It shares nothing with `checker`: f(x) is in f(x_0) + f'(box) (x - x_0), with derivatives that SymPy
forms and Arb encloses with 100 bits.
"""

from __future__ import annotations

import math
import time
from collections import deque
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.wrappers.certificates.ball_claims import BallClaim, first_statement, statements_of
from safe_envs.wrappers.certificates.balls import (
    Balls,
    MeanValueForm,
    PolynomialBalls,
    require_flint,
)
from safe_envs.wrappers.certificates.certificate import BarrierCertificate
from safe_envs.wrappers.certificates.check_result import CheckResult, StatementCheck, combined

_BITS = 100
_STEEPEST = 1e6
_SMALLEST = 1e-9


def check_with_balls(
    certificate: BarrierCertificate, boxes: int = 200_000, seconds: float = 600.0
) -> CheckResult:
    """Check all statements of a certificate by ball arithmetic, some 50 times slower.

    Args:
        certificate: to check.
        boxes: limit of boxes, of all statements together.
        seconds: limit of time.

    Returns:
        As `safe_envs.wrappers.certificates.checker.check`.

    Raises:
        ConfigurationError: python-flint is not installed, or an expression has a function that this
            check does not know.
    """
    flint = require_flint()
    parts = [first_statement(certificate)]
    before, flint.ctx.prec = flint.ctx.prec, _BITS
    try:
        if parts[0].word == "checked":
            search = _Search(certificate, flint, boxes, time.monotonic() + seconds)
            parts += [search.run(statement) for statement in search.statements]
    finally:
        flint.ctx.prec = before
    return combined(parts)


class _Search:
    """Branch and bound with balls."""

    def __init__(self, certificate: BarrierCertificate, flint: Any, boxes: int, end: float) -> None:
        self._states, self._end, self._boxes = certificate.plant.states, end, boxes
        self._workspace = certificate.plant.workspace
        n = len(self._states)
        orders = [o for k in range(4) for o in combinations_with_replacement(range(n), k)]
        self._symbols: dict[Any, sp.Symbol] = {o: sp.Dummy(real=True) for o in orders}
        self._orders = {symbol: order for order, symbol in self._symbols.items()}
        self.statements = statements_of(certificate, self._symbols)
        self._balls = Balls(flint)
        self._psi = PolynomialBalls(certificate.psi, self._balls)
        self._slopes: dict[Any, tuple[Any, ...]] = {}

    def _gradient(self, e: Any) -> tuple[Any, ...]:
        """Return the derivatives of an expression of the states and of psi's derivatives."""
        if e not in self._slopes:
            inner = [s for s in e.free_symbols if s in self._orders]
            self._slopes[e] = tuple(
                sp.diff(e, x)
                + sum(
                    sp.diff(e, s) * self._symbols[tuple(sorted((*self._orders[s], i)))]
                    for s in inner
                )
                for i, x in enumerate(self._states)
            )
        return self._slopes[e]

    def _known(self, x: list[float], r: tuple[float, ...], symbols: Any) -> dict[Any, Any]:
        arb, n = self._balls.arb, len(x)
        known = {s: arb(x[i], r[i]) for i, s in enumerate(self._states)}
        orders = tuple(sorted((self._orders[s] for s in symbols if s in self._orders), key=str))
        if orders:
            values = self._psi([arb(x[i]) for i in range(n)], r, orders)
            known |= {self._symbols[o]: v for o, v in zip(orders, values, strict=True)}
        return known

    def _forms(
        self, expressions: list[Any], x: list[float], r: tuple[float, ...]
    ) -> list[MeanValueForm]:
        value = self._balls.value
        gradients = [self._gradient(e) for e in expressions]
        points = set().union(*(e.free_symbols for e in expressions))
        both = points.union(*(d.free_symbols for g in gradients for d in g))
        at_point = self._known(x, (0.0,) * len(x), points)
        on_box = self._known(x, r, both)
        return [
            MeanValueForm(value(e, at_point), [value(d, on_box) for d in g], r, value(e, on_box))
            for e, g in zip(expressions, gradients, strict=True)
        ]

    def run(self, st: BallClaim) -> StatementCheck:
        """Check one statement."""
        began, seen = time.monotonic(), 0
        ends = np.array([[float(e) for e in pair] for pair in self._workspace])
        sizes, queue = np.ptp(ends, axis=1), deque[Any]()
        for face in st.faces or (None,):
            root = ends.copy()
            if face is not None:
                root[face[0]] = float(face[1])
            queue.append((root.mean(1), np.ptp(root, axis=1) / 2))
        while queue:
            x, r = queue.popleft()
            took = time.monotonic() - began
            small = seen > len(st.faces) and (r < _SMALLEST * sizes).all()
            if small or self._boxes <= 0 or time.monotonic() > self._end:
                reason = f"{len(queue) + 1} boxes are left, of radius {r.max():.1e}"
                return StatementCheck(st.name, "undecided", seen, took, x, reason)
            seen, self._boxes = seen + 1, self._boxes - 1
            # So that halves cover the whole of a box, although their centers are rounded.
            wider = r * (1 + 2.0**-20) + 2.0**-50 * np.abs(ends).max(1)
            word = self._word(st, [float(v) for v in x], tuple(map(float, wider)))
            inside = ((ends[:, 0] <= x) & (x <= ends[:, 1])).all()
            if word == "refuted" and inside:
                return StatementCheck(st.name, "refuted", seen, took, x, "it is false")
            if word != "checked":
                i = int((r / sizes).argmax())
                step = r * (np.arange(len(x)) == i) / 2
                queue += [(x - step, r - step), (x + step, r - step)]
        return StatementCheck(st.name, "checked", seen, time.monotonic() - began)

    def _word(self, st: BallClaim, x: list[float], r: tuple[float, ...]) -> str:
        if st.defined:
            region = self._forms(list(st.region), x, r)
            if any(q.high < 0 for q in region):
                return "checked"
            known = self._known(x, r, ())
            finite = all(self._balls.value(e, known).is_finite() for e in st.defined)
            return "checked" if finite else "open"
        effects = [w for w, _, _ in st.inputs]
        zeros = [] if st.zero is None else [st.zero]
        claim, *rest = self._forms([st.claim, *st.region, *zeros, *effects], x, r)
        count = len(st.region)
        region, zero, inputs = (
            rest[:count],
            rest[count : count + len(zeros)],
            rest[count + len(zeros) :],
        )
        if any(q.high < 0 for q in (*region, *zero)) or any(q.low > 0 for q in zero):
            return "checked"
        ranges = [(w, float(i[1]), float(i[2]), i) for w, i in zip(inputs, st.inputs, strict=True)]
        ranges += [(q, -_STEEPEST, 0.0, None) for q in region]
        ranges += [(q, -_STEEPEST, _STEEPEST, None) for q in zero]
        if self._raised(claim, ranges).low >= 0:
            return "checked"
        return "refuted" if self._is_false(st, (claim, region, zero, inputs), x, r) else "open"

    def _raised(self, claim: MeanValueForm, ranges: list[Any]) -> MeanValueForm:
        """Add multiples, for a large lower end; they are chosen in floating point."""
        arb, total = self._balls.arb, claim
        for q, low, high, bounds in ranges:
            tries = {low, high, min(max(0.0, low), high)}
            for s, t in zip(total.slopes, q.slopes, strict=True):
                ratio = -float(s.mid()) / float(t.mid()) if t.mid() != 0 else 0.0
                if math.isfinite(ratio):
                    tries.add(min(max(ratio, low), high))
            best = max(tries, key=lambda k: (self._score(total, q, k), -abs(k)))
            if best == 0.0:
                continue
            exact = arb(best)
            if bounds is not None and best in (low, high):
                exact = self._balls.value(bounds[1] if best == low else bounds[2], {})
            total = total.plus(exact, q)
        return total

    @staticmethod
    def _score(total: MeanValueForm, q: MeanValueForm, k: float) -> float:
        value = float(total.middle.mid()) + k * float(q.middle.mid())
        for s, t, r in zip(total.slopes, q.slopes, total.r, strict=True):
            value -= r * abs(float(s.mid()) + k * float(t.mid()))
            value -= r * (float(s.rad()) + abs(k) * float(t.rad()))
        return value if math.isfinite(value) else -math.inf

    def _is_false(self, st: BallClaim, forms: Any, x: list[float], r: tuple[float, ...]) -> bool:
        claim, region, zero, inputs = forms
        if zero:
            if not (claim.high < 0 and all(q.low > 0 for q in region)):
                return False
            signs = []
            for k in (-1, 1):
                ends = [
                    v + k * s * math.copysign(1.0, float(d.mid()))
                    for v, s, d in zip(x, r, zero[0].slopes, strict=True)
                ]
                known = {s: self._balls.arb(v) for s, v in zip(self._states, ends, strict=True)}
                signs.append(self._balls.value(st.zero, known))
            return bool(signs[0] < 0 and signs[1] > 0)
        most = claim.middle
        for w, (_, low, high) in zip(inputs, st.inputs, strict=True):
            first, last = (w.middle * self._balls.value(u, {}) for u in (low, high))
            most = most + first.max(last)
        return bool(most < 0 and all(q.middle > 0 for q in region))
