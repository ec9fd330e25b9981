"""A check of barrier certificates in one file, which shares no code with what finds them.

It bisects boxes of states until a claim of `BarrierCertificate` is proved on all, or false on one.
A quantity on x_0 + r e, |e_i| <= 1, is in c + b e + [-rho, rho]; rho also has all roundings.
"""

from __future__ import annotations

import math
import time
from functools import reduce
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.errors import ConfigurationError
from safe_envs.filters.certificates.certificate import (
    BarrierCertificate,
    CheckResult,
    StatementCheck,
    combined,
)

EPS, SMALLEST, BATCH = 2.0**-48, 1e-11, 10**6  # above roundings of floats; box; numbers at once
FUNCTIONS: dict[str, tuple[Any, ...]] = {  # y, y', a bound of |y''| by min |x| and max x, range
    "sin": (np.sin, np.cos, lambda *_: 1.0, lambda *_: (-1.0, 1.0)),
    "cos": (np.cos, lambda x: -np.sin(x), lambda *_: 1.0, lambda *_: (-1.0, 1.0)),
    "exp": (np.exp, np.exp, lambda _, high: np.exp(high)),
    "log": (np.log, lambda x: 1 / x, lambda least, _: least**-2.0),
    "tanh": (np.tanh, lambda x: 1 - np.tanh(x) ** 2, lambda *_: 0.77),
    "atan": (np.arctan, lambda x: 1 / (1 + x * x), lambda *_: 0.65),
    "sqrt": (np.sqrt, lambda x: 0.5 / np.sqrt(x), lambda least, _: least**-1.5 / 4),
    "1/x": (np.reciprocal, lambda x: -(x**-2.0), lambda m, _: 2 * m**-3.0, lambda *_: (0, np.inf)),
    "Abs": (np.abs, np.sign, lambda m, _: 1 / (m > 0) - 1, lambda a, b, m: (m, np.fmax(-a, b))),
}


class Band:
    """A quantity on B boxes; b has the shape (n, B), and all others (B,)."""

    def __init__(self, c: Any, b: Any, rho: Any) -> None:
        rho = rho + EPS * (np.abs(c) + np.abs(b).sum(0) + rho) + 1e-290
        lost = ~(np.abs(c) + np.abs(b).sum(0) + rho < np.inf)  # then it is the whole line
        self.c, self.b = np.where(lost, 0.0, c), np.where(lost, 0.0, b)
        self.rho = np.where(lost, np.inf, rho)
        self.size = (np.abs(self.b).sum(0) + self.rho) * (1 + EPS) + EPS * np.abs(self.c)
        self.low, self.high = self.c - self.size, self.c + self.size

    def __add__(self, q: Band) -> Band:
        return Band(self.c + q.c, self.b + q.b, self.rho + q.rho)

    def __mul__(self, q: Band) -> Band:
        squares = self.b * q.b / 2  # of e_i^2, which is in [0, 1]
        rest = self.size * q.size * (1 + EPS) - np.abs(squares).sum(0)
        rho = np.abs(self.c) * q.rho + np.abs(q.c) * self.rho + rest
        return Band(self.c * q.c + squares.sum(0), self.c * q.b + q.c * self.b, rho)

    def image(self, y: Any, slope: Any, bend: Any, ends: Any = None) -> Band:
        """Apply a function, see `FUNCTIONS`, by Taylor's theorem or by its range."""
        least = np.maximum(np.maximum(self.low, -self.high), 0.0)  # of the absolute value
        low, high = ends(self.low, self.high, least) if ends else (y(self.low), y(self.high))
        half, steep = np.abs(high / 2 - low / 2), slope(self.c)
        rho = np.abs(steep) * self.rho + bend(least, self.high) * self.size**2 / 2
        flat = half < rho
        c = np.where(flat, low / 2 + high / 2, y(self.c))
        rho = np.where(flat, half, rho) + EPS * (1 + self.size)  # sin(1/x) has no value at 0
        return Band(c, np.where(flat, 0.0, steep * self.b), rho)


class Bands(dict[Any, Band]):
    """Bands of expressions on boxes x + r e of states; psi has its derivatives by symbols."""

    def __init__(self, states: Any, psi: dict[Any, Any], x: np.ndarray, r: np.ndarray) -> None:
        slopes = r * np.eye(len(x))[:, :, None]
        super().__init__(zip(states, map(Band, x, slopes, 0 * x), strict=True))
        self.psi, self.x, self.r = psi, x, r

    def __missing__(self, e: Any) -> Band:
        self[e] = self._polynomial(self.psi[e]) if e in self.psi else self._combined(e)
        return self[e]

    def _combined(self, e: Any) -> Band:
        name, args = type(e).__name__, e.args
        if e.is_Number or e.is_NumberSymbol:
            return Band(float(e) + 0 * self.x[0], 0 * self.x, 0.0)
        if e.is_Add or e.is_Mul:
            return reduce(Band.__add__ if e.is_Add else Band.__mul__, [self[x] for x in args])
        if name in ("Max", "Min"):
            rest, sign = e.func(*args[1:]), 1 if name == "Max" else -1
            return self[(args[0] + rest + sign * sp.Abs(args[0] - rest)) / 2]
        if e.is_Pow and args[1].is_Rational and args[1].q <= 2:
            q, k = self[args[0]], abs(args[1].p)
            q.low = np.fmax(q.low, 0.0) if args[0].is_nonnegative else q.low
            q = q.image(*FUNCTIONS["sqrt"]) if args[1].q == 2 else q
            q = reduce(Band.__mul__, [q * q] * (k // 2) + [q] * (k % 2))
            return q.image(*FUNCTIONS["1/x"]) if args[1] < 0 else q
        if name in FUNCTIONS:
            return self[args[0]].image(*FUNCTIONS[name])
        raise ConfigurationError(f"{e} has a function that the checker does not know; use others")

    def _polynomial(self, psi: Any) -> Band:  # from its Taylor coefficients at x
        tensor = np.pad(psi.tensor.astype(float), [(0, int(d < 2)) for d in psi.tensor.shape])
        center, scale = (np.array(v, float)[:, None] for v in (psi.center, psi.scale))
        z, slack = (self.x - center) / scale, EPS * (np.abs(self.x) + np.abs(center)) / scale
        wide, shape, moved = self.r / scale * (1 + EPS) + slack, tensor.shape, tensor[None]
        for d, middle in zip(shape, z, strict=True):
            k = np.arange(d)
            matrix = np.vander(middle, d, True)[:, np.maximum(k - k[:, None], 0)]
            matrix *= [[math.comb(j, i) for j in k] for i in k]
            moved = (matrix @ moved.reshape(len(moved), d, -1)).swapaxes(1, 2)
        powers, moved = np.indices(shape).reshape(psi.n, -1), moved.reshape(-1, tensor.size)
        far = np.maximum(np.abs(z) + wide, 2.0**-10)  # not small, so that errors hold underflow
        axes = [zip(v, shape, powers, strict=True) for v in (wide, far)]
        size, most = (math.prod(np.vander(w, d, True)[:, k] for w, d, k in v) for v in axes)
        errors = most @ np.abs(tensor.ravel()) * (8 * sum(shape) + 40 + 4 * tensor.size) * 2.0**-52
        b = moved[:, np.flatnonzero(powers.sum(0) == 1)[::-1]].T
        rho = np.abs(moved * size) @ (powers.sum(0) > 1) + (np.abs(b) * slack).sum(0) + errors
        return Band(moved[:, 0], b * self.r / scale, rho)


def _claims_of(certificate: BarrierCertificate, d: dict[Any, Any]) -> list[tuple[Any, ...]]:
    """Return (name, e, region, zero, used): e >= 0 where region > 0 = zero; used has values."""
    plant, psi, p, h = certificate.plant, certificate.psi, d[()], certificate.plant.barriers
    a, m, c = map(sp.Rational, (certificate.rate, certificate.shortfall, certificate.supremum))
    rise = a * p + m + sum(f * d[i,] for i, f in enumerate(plant.drift))
    for (i, k), e in np.ndenumerate((s := np.array(plant.diffusion, object)) @ s.T):
        rise += e * d[min(i, k), max(i, k)] / 2
    for j, (low, high) in enumerate(plant.bounds):
        w = sum(g[j] * d[i,] for i, g in enumerate(plant.input_matrix))
        law = [sp.Max(low, sp.Min(high, u)) for u in plant.policy[j : j + 1]]
        rise += sp.Max(*(w * u for u in law or (low, high)))
    used = (*plant.drift, *plant.policy, *sum(plant.input_matrix + plant.diffusion, ()))
    found = [("psi <= c", c - p, (p, *h), sp.S.Zero, ())]
    found += [("A psi >= -a psi - m", rise, (p, *h), sp.S.Zero, used)]
    for i, e in enumerate(h):  # others than sums of monomials may be huge
        if e.atoms(sp.Add) - {e} or psi.degree > 4 or sp.expand(psi.expression - e) != 0:
            found += [(f"psi <= 0 where h_{i + 1} = 0", -p, (p, *h[:i], *h[i + 1 :]), e, ())]
    for i, x in enumerate(plant.states):
        for end in plant.workspace[i] if plant.angles[i] and psi.tensor.shape[i] > 1 else ():
            found += [(f"psi <= 0 where {x} = {end}", -p, (p, *h), x - end, ())]
    return found


@np.errstate(all="ignore")
def _search(claim: Any, certificate: BarrierCertificate, d: Any, boxes: int, end: float) -> Any:
    """Check one claim by branch and bound."""
    (name, e, region, zero, used), began, seen = claim, time.monotonic(), 0
    low, high = np.array(certificate.plant.workspace, float).T[:, :, None]
    queue = [((low + high) / 2, (high - low) / 2 + 16 * EPS * (np.abs(low) + np.abs(high)))]
    while queue:
        x, r = queue.pop(0)
        form = Bands(certificate.plant.states, d, x, r)
        q, z, inside = form[e], form[zero], [form[v] for v in region]
        slope = np.nan_to_num(-(q.b * z.b).sum(0) / (z.b**2).sum(0))
        q = q + z * Band(slope, 0 * x, 0.0)  # the same where zero is 0
        known = np.all([v.size < np.inf for v in (*inside, *(form[u] for u in used))], axis=0)
        void = np.any([v.high < 0 for v in inside], axis=0) | (z.low > 0) | (z.high < 0)
        signs = (zero == 0) | (np.abs(z.c) + z.rho < np.abs(z.b).sum(0))  # zero has both
        false = (q.high < 0) & np.all([v.low > 0 for v in inside], axis=0) & signs
        seen, took = seen + len(void), time.monotonic() - began
        if false.any():
            return StatementCheck(name, "refuted", seen, took, x[:, false.argmax()], "it is false")
        left = np.flatnonzero(~(void | (q.low >= 0) & known))
        x, r = x[:, left], r[:, left]
        late = seen >= boxes or began + took > end or (r < SMALLEST * (high - low)).all()
        if left.size and late:
            rest, short = left.size + sum(v.shape[1] for v, _ in queue), -q.low[left].min()
            reason = f"{rest} boxes are left; the claim is short by {short:.1e} there"
            return StatementCheck(name, "undecided", seen, took, x[:, 0], reason)
        step = r / 2 * (np.arange(len(x))[:, None] == (r / (high - low)).argmax(0))
        r = np.tile((r - step) * (1 + EPS) + EPS * np.abs(x) * (step > 0), 2)
        x = np.concatenate([x - step, x + step], 1)
        k = max(1, x.shape[1] * d[region[0]].tensor.size // BATCH)  # parts of it
        queue += [(x[:, i::k], r[:, i::k]) for i in range(min(k, x.shape[1]))]
    return StatementCheck(name, "checked", seen, time.monotonic() - began)


def check(certificate: BarrierCertificate, boxes: int = 2**22, seconds: float = 120) -> CheckResult:
    """Check all claims of a certificate.

    Args:
        certificate: to check.
        boxes: limit of boxes, of all claims together.
        seconds: limit of time.

    Returns:
        Checked only if all of them are proved; refuted only where a state is sure to be wrong.

    Raises:
        ConfigurationError: an expression has a function that the checker does not know.
    """
    end, c, plant, psi = time.monotonic() + seconds, certificate, certificate.plant, certificate.psi
    sound = min(c.rate, c.shortfall) >= 0 < min(c.supremum, c.horizon)
    sound &= all(e.is_finite and f.is_finite and e < f for e, f in plant.workspace + plant.bounds)
    parts = [StatementCheck("finite box; a, m >= 0; c, T > 0", "checked" if sound else "refuted")]
    derived = {(): psi, **{(i,): psi.derivative(i) for i in range(psi.n)}}
    derived |= {(i, k): derived[i,].derivative(k) for k in range(psi.n) for i in range(k + 1)}
    d = {order: sp.Dummy(real=True) for order in derived}
    for claim in _claims_of(c, d) if sound else ():
        left = boxes - sum(part.boxes for part in parts)
        parts.append(_search(claim, c, {d[o]: q for o, q in derived.items()}, left, end))
    return combined(parts)
