"""A program of its own that checks what a barrier certificate states.

It bisects the workspace until each box is proved, or a state refutes the certificate. It shares no
code with the search for certificates and with the judge of other bounds.
"""

from __future__ import annotations

import time
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import sympy as sp

from safe_envs.wrappers.certificates.certificate import BarrierCertificate
from safe_envs.wrappers.certificates.check_result import CheckResult, StatementCheck, combined
from safe_envs.wrappers.certificates.claims import Statement, first_statement, statements_of
from safe_envs.wrappers.certificates.enclosures import (
    EPS,
    Form,
    PolynomialForms,
    constant,
    form,
    plus,
    times,
    value_of,
)
from safe_envs.wrappers.certificates.touching import proved_around

_STEEPEST, _TRIED, _NUMBERS = 1e6, 200, 2_000_000  # multipliers; points, numbers in a batch
_SMALLEST = 1e-9  # box for the workspace


def _best(total: Form, helpers: list[Any]) -> Form:
    """Add multiples of helpers, (form, least, largest), to total, for a large lower end."""
    n, multiples = len(total.b), [np.clip(0.0, low, high) + 0 * total.c for _, low, high in helpers]
    c, b = total.c + sum(k * q[0].c for k, q in zip(multiples, helpers, strict=True)), total.b
    b = b + sum(k * q[0].b for k, q in zip(multiples, helpers, strict=True))
    for k, (q, low, high) in 2 * list(enumerate(helpers)):
        c, b = c - multiples[k] * q.c, b - multiples[k] * q.b
        ends = [low + 0 * c, high + 0 * c, multiples[k]]
        tries = np.clip(np.nan_to_num([*(-b / q.b), *ends]), low, high)
        gains = c + tries * q.c - np.abs(b[:, None] + tries * q.b[:, None]).sum(0)
        gains = np.nan_to_num(gains - np.abs(tries) * q.rho, nan=-np.inf)
        multiples[k] = np.take_along_axis(tries, gains.argmax(0)[None], 0)[0]
        c, b = c + multiples[k] * q.c, b + multiples[k] * q.b
    for multiple, (q, _, _) in zip(multiples, helpers, strict=True):
        total = plus(total, times(constant(multiple, n), q))
    return total


class _Search:
    """Branch and bound over the workspace of one certificate."""

    def __init__(self, certificate: BarrierCertificate, boxes: int, seconds: float) -> None:
        self._plant, n = certificate.plant, len(certificate.plant.states)
        orders = [o for k in (0, 1, 2) for o in combinations_with_replacement(range(n), k)]
        self._symbols: dict[Any, sp.Symbol] = {o: sp.Dummy(real=True) for o in orders}
        self.statements = statements_of(certificate, self._symbols)
        self._psi, self._boxes = PolynomialForms(certificate.psi), boxes
        self._batch = int(np.clip(_NUMBERS // certificate.psi.tensor.size, 8, 4096))
        self._end = time.monotonic() + seconds
        proved = [
            proved_around(st, certificate, self._symbols, self._ends) for st in self.statements
        ]
        self._proved = dict(zip([st.name for st in self.statements], proved, strict=True))

    def _states(self, x: np.ndarray, r: np.ndarray) -> dict[Any, Form]:
        slopes = r * np.eye(len(x))[:, :, None]
        parts = zip(self._plant.states, x, slopes, r, strict=True)
        return {s: form(c, b, 0.0, c - d, c + d) for s, c, b, d in parts}

    def _ends(self, e: sp.Expr, x: np.ndarray, r: np.ndarray) -> tuple[float, float]:
        found = value_of(e, self._states(x[:, None], r[:, None]), len(x))
        return float(found.low[0]), float(found.high[0])

    def _forms(self, st: Statement, x: np.ndarray, r: np.ndarray) -> tuple[Any, ...]:
        """Return those of claim, region and zero, and the inputs with theirs."""
        n, effects = len(x), [w for w, _, _ in st.inputs]
        wanted = (st.claim, st.zero or sp.Integer(0), *st.region, *effects, *st.defined)
        free = set().union(*(e.free_symbols for e in wanted))
        known = self._states(x, r)
        orders = [order for order, symbol in self._symbols.items() if symbol in free]
        for order, found in zip(orders, self._psi(x, r, orders), strict=True):
            known[self._symbols[order]] = found
        zero = form(0 * x[0], 0 * x, 0.0, 0 * x[0], 0 * x[0])
        forms = [plus(value_of(e, known, n), zero) for e in wanted]
        k = 2 + len(st.region)
        if st.defined:
            lost = ~np.all([np.isfinite(q.high - q.low) for q in forms[k:]], axis=0)
            forms[0] = form(np.where(lost, -np.inf, 1.0), 0 * x, 0.0, -np.inf, np.inf)
        inputs = [(q, float(i[1]), float(i[2])) for q, i in zip(forms[k:], st.inputs, strict=False)]
        return forms[0], forms[2:k], forms[1], inputs

    def run(self, st: Statement) -> StatementCheck:
        """Check one statement."""
        began, seen, short = time.monotonic(), 0, 0.0
        ends = np.array([[float(e) for e in pair] for pair in self._plant.workspace])
        roots = np.array([ends] * max(len(st.faces), 1))
        for root, (i, face) in zip(roots, st.faces, strict=False):
            root[i] = float(face)
        x, r = roots.mean(2).T, (roots[:, :, 1] - roots[:, :, 0]).T / 2
        r, sizes = r * (1 + EPS) + EPS * np.abs(x), np.ptp(ends, axis=1)
        while x.shape[1]:
            left: list[Any] = []
            for start in range(0, x.shape[1], self._batch):
                y, s = x[:, start : start + self._batch], r[:, start : start + self._batch]
                late = self._boxes <= 0 or time.monotonic() > self._end
                if late or (seen and (s[:, 0] < _SMALLEST * sizes).all()):
                    count = x.shape[1] - start + sum(map(len, left))
                    why = f"is short by {short:.1e} or less" if np.isfinite(short) else "has a pole"
                    reason = (
                        f"{count} boxes are left; the claim {why} there" if seen else "too late"
                    )
                    took = time.monotonic() - began
                    return StatementCheck(st.name, "undecided", seen, took, y[:, 0], reason)
                low, keep = self._open(st, y, s)
                seen, self._boxes = seen + y.shape[1], self._boxes - y.shape[1]
                worst = keep[np.argsort(low[keep])[:_TRIED]]
                state = self._counterexample(st, y[:, worst], s[:, worst])
                if state is not None:
                    took = time.monotonic() - began
                    return StatementCheck(st.name, "refuted", seen, took, state, "it is false")
                left.append(start + keep)
                short = max(0.0 if start == 0 else short, -np.min(low[keep], initial=0.0))
            x, r = _halved(x[:, np.concatenate(left)], r[:, np.concatenate(left)], sizes)
        return StatementCheck(st.name, "checked", seen, time.monotonic() - began)

    def _open(self, st: Statement, x: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return lower ends of the claim, and the boxes where it is neither true nor void."""
        claim, region, zero, inputs = self._forms(st, x, r)
        helpers = [*inputs, *((q, -_STEEPEST, 0.0) for q in region)]
        helpers += [(zero, -_STEEPEST, _STEEPEST)] if st.zero is not None else []
        low = claim.low if st.defined else _best(claim, helpers).low
        void = np.any([q.high < 0 for q in region], axis=0) | (zero.low > 0) | (zero.high < 0)
        if box := self._proved[st.name]:
            void |= (np.abs(x - box[0][:, None]) + r <= box[1][:, None] * (1 - EPS)).all(0)
        return low, np.flatnonzero(~((low >= 0) | void))

    def _counterexample(self, st: Statement, x: np.ndarray, r: np.ndarray) -> Any:
        """Return a state that is sure to refute the statement, among the middles of boxes."""
        if st.defined or not x.shape[1]:
            return None
        claim, region, zero, inputs = self._forms(st, x, 0 * r if st.zero is None else r)
        for w, low, high in inputs:
            most = [times(constant(u, len(x)), w).high for u in (low, high)]
            claim = plus(claim, claim._replace(b=0 * x, c=0.0, rho=np.inf, high=np.maximum(*most)))
        wrong = (claim.high < 0) & np.all([q.low > 0 for q in region], axis=0)
        if st.zero is not None:  # it changes its sign in between
            step = r * np.sign(zero.b)
            low, high = (self._forms(st, x + k * step, 0 * r)[2] for k in (-1, 1))
            wrong &= (low.high < 0) & (high.low > 0)
        return x[:, wrong.argmax()] if wrong.any() else None


def _halved(x: np.ndarray, r: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bisect each box where it is widest for its workspace."""
    step = r / 2 * (np.arange(len(x))[:, None] == (r / sizes[:, None]).argmax(0))
    smaller = (r - step) * (1 + EPS) + EPS * np.abs(x) * (step > 0)
    return np.concatenate([x - step, x + step], 1), np.concatenate([smaller, smaller], 1)


def check(
    certificate: BarrierCertificate, boxes: int = 3_000_000, seconds: float = 120.0
) -> CheckResult:
    """Check all statements of a certificate.

    Args:
        certificate: to check.
        boxes: limit of boxes, of all statements together.
        seconds: limit of time.

    Returns:
        Checked only if all of them are proved; refuted only where a state is sure to be wrong.

    Raises:
        ConfigurationError: an expression has a function that the checker does not know.
    """
    parts = [first_statement(certificate)]
    if parts[0].word == "checked":
        with np.errstate(all="ignore"):
            search = _Search(certificate, boxes, seconds)
            parts += [search.run(statement) for statement in search.statements]
    return combined(parts)
