"""Balls of Arb that hold expressions, and polynomials with their derivatives.

It shares nothing with `checker`: f(x) is in f(x_0) + f'(box) (x - x_0), with derivatives that SymPy
forms and Arb encloses with 100 bits.

Let G be the states in the workspace with psi > 0 and all h_i > 0. Until a path leaves the workspace
it leaves G only where psi <= 0: psi is continuous, and <= 0 where an h_i is 0. On the way e^(a t)
psi + m (e^(a t) - 1)/a is a local submartingale by A psi >= -a psi - m; stopped when the path
leaves G, or after T, its mean is at least psi(x_0). At the end it is at most c e^(a T) + m (e^(a T)
- 1)/a for paths that are still in G, and at most m (e^(a T) - 1)/a for all others, for there psi <=
0. So P(in G until T, or until the workspace is left) >= [psi(x_0) e^(-a T) - m (1 - e^(-a T))/a]/c.
"""

from __future__ import annotations

import functools
import math
import operator
import time
from collections import deque
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.errors import ConfigurationError, install_extra
from safe_envs.filters.certificates.certificate import (
    BarrierCertificate,
    CheckResult,
    StatementCheck,
    combined,
)

_LARGEST_DEGREE = 4


class BallClaim(NamedTuple):
    """That the claim + sum of w u >= 0, for some u of each (w, low, high) in inputs, in a region.

    Attributes:
        name: of the statement.
        claim: expression of the states and of the symbols of psi and its derivatives.
        region: the expressions that are positive there.
        zero: another one that is 0 there, if any.
        inputs: the coefficients of the inputs, with their bounds.
        defined: what has to have a value there, in place of the claim.
        faces: in place of the workspace those of its faces where a state, by index, has a value.
    """

    name: str
    claim: Any
    region: tuple[Any, ...]
    zero: Any = None
    inputs: tuple[Any, ...] = ()
    defined: tuple[Any, ...] = ()
    faces: tuple[tuple[int, Any], ...] = ()


def statements_of(certificate: BarrierCertificate, psi: dict[Any, sp.Symbol]) -> list[BallClaim]:
    """Return all statements but the first one.

    Args:
        certificate: that makes them.
        psi: symbols of psi, by (), and of its derivatives, by the sorted indices of states.
    """
    plant, p, h = certificate.plant, psi[()], certificate.plant.barriers
    a, m, c = map(sp.Rational, (certificate.rate, certificate.shortfall, certificate.supremum))
    claim = a * p + m + sum(f * psi[i,] for i, f in enumerate(plant.drift))
    for i, k in combinations_with_replacement(range(len(plant.states)), 2):
        both = zip(plant.diffusion[i], plant.diffusion[k], strict=True)
        claim += sum(x * y for x, y in both) * psi[i, k] / (2 if i == k else 1)
    columns = zip(*plant.input_matrix, strict=True)
    effects = [sum(g * psi[i,] for i, g in enumerate(column)) for column in columns]
    inputs = tuple((w, *ends) for w, ends in zip(effects, plant.bounds, strict=True))
    if plant.policy:
        for u, (w, low, high) in zip(plant.policy, inputs, strict=True):
            claim += w * sp.Max(low, sp.Min(high, u))
        inputs = ()
    used = (*plant.drift, *h, *plant.policy, *sum((*plant.input_matrix, *plant.diffusion), ()))
    found = [
        BallClaim(
            "f, g, sigma, h and the policy are defined", sp.Integer(1), (p, *h), defined=used
        ),
        BallClaim("psi <= c", c - p, (p, *h)),
        BallClaim("A psi >= -a psi - m", claim, (p, *h), inputs=inputs),
    ]
    for i, e in enumerate(h):
        if not _is_same(e, certificate.psi):
            rest = (p, *h[:i], *h[i + 1 :])
            found.append(BallClaim(f"psi <= 0 where h_{i + 1} = 0", -p, rest, zero=e))
    for i, (x, (low, high)) in enumerate(zip(plant.states, plant.workspace, strict=True)):
        if plant.angles[i] and any(key[i] for key in certificate.psi.coefficients):
            name, faces = f"psi <= 0 at the ends of the turn of {x}", ((i, low), (i, high))
            found.append(BallClaim(name, -p, (p, *h), faces=faces))
    return found


def _is_same(e: sp.Expr, psi: Polynomial) -> bool:
    # Only sums of monomials are compared, for others may be huge.
    small = psi.degree <= _LARGEST_DEGREE and not e.atoms(sp.Add) - {e}
    return small and sp.expand(psi.expression - e) == 0


def first_statement(certificate: BarrierCertificate) -> StatementCheck:
    """Check what takes no search."""
    signs = certificate.rate >= 0 and certificate.shortfall >= 0 and certificate.supremum > 0
    ends = (*certificate.plant.workspace, *certificate.plant.bounds)
    sound = all(e.is_finite and f.is_finite and e < f for e, f in ends)
    word = "checked" if signs and certificate.horizon > 0 and sound else "refuted"
    return StatementCheck("finite box; a, m >= 0; c, T > 0", word)


def require_flint() -> Any:
    """Return the module of python-flint.

    Raises:
        ConfigurationError: it is not installed.
    """
    try:
        import flint  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigurationError(
            f"the check by ball arithmetic needs python-flint; {install_extra('proofs')}, or check"
            " without it"
        ) from error
    return flint


class Balls:
    """Expressions in ball arithmetic."""

    def __init__(self, flint: Any) -> None:
        self.flint, self.arb = flint, flint.arb

    def rational(self, value: Any) -> Any:
        """Return the ball of a fraction or a float."""
        p, q = (value.p, value.q) if isinstance(value, sp.Rational) else value.as_integer_ratio()
        return self.arb(self.flint.fmpq(int(p), int(q)))

    def _power(self, base: Any, exponent: sp.Rational, nonnegative: bool) -> Any:
        if exponent.q not in (1, 2):
            raise ConfigurationError(f"this check does not know the power {exponent}; use others")
        if exponent.q == 2:
            base = (base.nonnegative_part() if nonnegative else base).sqrt()
        found = self.arb(1)
        for _ in range(abs(int(exponent.p))):
            found = found * base
        return 1 / found if exponent < 0 else found

    def value(self, e: Any, known: dict[Any, Any]) -> Any:
        """Return the ball of an expression.

        Args:
            e: expression.
            known: balls of its symbols; all that is found is added to it.

        Raises:
            ConfigurationError: it has a function or a power that is not known here.
        """
        if e in known:
            return known[e]
        name = type(e).__name__
        if e.is_Rational:
            return self.rational(e)
        if e.is_NumberSymbol:
            return self.arb.pi() if e is sp.pi else self.arb.const_e()
        if e.is_Pow and e.exp.is_Rational:
            base = self.value(e.base, known)
            found = self._power(base, e.exp, bool(e.base.is_nonnegative))
        else:
            found = self._applied(name, [self.value(x, known) for x in e.args])
        known[e] = found
        return found

    def _applied(self, name: str, args: list[Any]) -> Any:
        first = args[0]
        if name in ("Add", "Mul"):
            return functools.reduce(operator.add if name == "Add" else operator.mul, args)
        if name in ("Max", "Min"):
            return functools.reduce(lambda x, y: getattr(x, name.lower())(y), args)
        if name == "Heaviside":
            return (first.sgn() + 1) / 2
        if name in ("sin", "cos", "exp", "log", "tanh", "atan"):
            return getattr(first, name)()
        if name in ("Abs", "sign"):
            return abs(first) if name == "Abs" else first.sgn()
        raise ConfigurationError(f"this check does not know the function {name}; use others")


class PolynomialBalls:
    """A polynomial and its derivatives as balls."""

    def __init__(self, psi: Polynomial, balls: Balls) -> None:
        self._balls, self._psi, self._shape = balls, psi, psi.tensor.shape
        self._entries = [balls.rational(v) for v in psi.tensor.ravel()]
        self._powers = list(np.ndindex(*self._shape))
        self._weights: dict[Any, Any] = {}

    def _shifted(self, z: list[Any]) -> Any:
        mat, entries = self._balls.flint.arb_mat, self._entries
        for d, middle in zip(self._shape, z, strict=True):
            powers = [self._balls.arb(1)]
            for _ in range(d - 1):
                powers.append(powers[-1] * middle)
            shift = [
                [powers[j - k] * math.comb(j, k) if j >= k else 0 for j in range(d)]
                for k in range(d)
            ]
            rest = len(entries) // d
            entries = (mat(shift) * mat(d, rest, entries)).transpose().entries()
        return mat(1, len(entries), entries)

    def _weights_of(self, r: tuple[Any, ...], orders: tuple[Any, ...]) -> Any:
        """Return the matrix from shifted coefficients to the derivatives on a box of radii r."""
        key = (r, orders)
        if key not in self._weights:
            balls, psi = self._balls, self._psi
            axes: list[Any] = []
            for radius, scale, d in zip(r, psi.scale, self._shape, strict=True):
                wide = balls.rational(radius) / balls.rational(scale)
                powers = [balls.arb(1), balls.arb(0, wide.upper())]
                for k in range(2, d + 1):
                    whole = (wide**k).upper() if wide > 0 else balls.arb(0)
                    powers.append(
                        balls.arb(whole / 2, whole / 2) if k % 2 == 0 else balls.arb(0, whole)
                    )
                axes.append(powers)
            lines = []
            for key_of in self._powers:
                line = []
                for order in orders:
                    taken = [order.count(i) for i in range(psi.n)]
                    weight = balls.arb(1)
                    for i, (k, a) in enumerate(zip(key_of, taken, strict=True)):
                        factor = self._balls.rational(1 / psi.scale[i] ** a) * math.perm(k, a)
                        weight = weight * (factor * axes[i][k - a] if k >= a else 0)
                    line.append(weight)
                lines.append(line)
            if len(self._weights) > 100:
                self._weights.clear()
            self._weights[key] = balls.flint.arb_mat(lines)
        return self._weights[key]

    def __call__(self, x: list[Any], r: tuple[Any, ...], orders: tuple[Any, ...]) -> list[Any]:
        """Return the derivatives of some orders on the states within radii r of x."""
        psi, balls = self._psi, self._balls
        z = [
            (m - balls.rational(c)) / balls.rational(s)
            for m, c, s in zip(x, psi.center, psi.scale, strict=True)
        ]
        return (self._shifted(z) * self._weights_of(r, orders)).entries()


class MeanValueForm:
    """f(x_0), and the gradient on a box of states."""

    def __init__(self, middle: Any, slopes: list[Any], r: tuple[float, ...], box: Any) -> None:
        self.middle, self.slopes, self.r, self.box = middle, slopes, r, box

    def plus(self, multiple: Any, other: MeanValueForm) -> MeanValueForm:
        """Return the sum with a multiple of another form.

        Args:
            multiple: ball or number.
            other: form on the same states.
        """
        slopes = [a + multiple * b for a, b in zip(self.slopes, other.slopes, strict=True)]
        box = self.box + multiple * other.box
        return MeanValueForm(self.middle + multiple * other.middle, slopes, self.r, box)

    @cached_property
    def _reach(self) -> Any:
        return sum(abs(s).upper() * r for s, r in zip(self.slopes, self.r, strict=True))

    @cached_property
    def low(self) -> Any:
        """A lower end."""
        return _better(self.middle - self._reach, self.box, "lower")

    @cached_property
    def high(self) -> Any:
        """An upper end."""
        return _better(self.middle + self._reach, self.box, "upper")


def _better(first: Any, other: Any, end: str) -> Any:
    """Return the narrower one of two ends; that of a ball without bounds is none."""
    ends = [getattr(ball, end)() for ball in (first, other) if ball.is_finite()]
    if not ends:
        return first
    return (max if end == "lower" else min)(ends)


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
        As `safe_envs.filters.certificates.checker.check`.

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
