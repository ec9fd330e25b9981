"""Certificates by another method, in another arithmetic: mean-value forms in balls of Arb.

f(x) is in f(x_0) + f'(box) (x - x_0), with derivatives that SymPy forms and Arb encloses with 100
bits. It shares nothing with the package but the numbers of a certificate, has one input at most,
and needs some room where an edge is concerned.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections import deque
from typing import Any

import flint
import numpy as np
import sympy as sp

ARB = flint.arb
BITS = 100


def ball(e: Any, known: dict[Any, Any]) -> Any:
    """Return what holds an expression, where `known` says what holds its symbols."""
    if e in known:
        return known[e]
    if e.is_Rational:
        return ARB(flint.fmpq(int(e.p), int(e.q)))
    if e.is_NumberSymbol:
        return ARB.pi() if e is sp.pi else ARB.const_e()
    args, name = [ball(part, known) for part in e.args], type(e).__name__
    if name in ("Add", "Mul"):
        found = functools.reduce(operator.add if name == "Add" else operator.mul, args)
    elif name in ("Max", "Min"):
        found = functools.reduce(lambda x, y: getattr(x, name.lower())(y), args)
    elif e.is_Pow:
        p, q = int(e.exp.p), int(e.exp.q)
        base = args[0].nonnegative_part() if q == 2 and e.base.is_nonnegative else args[0]
        found = functools.reduce(operator.mul, [base.sqrt() if q == 2 else base] * abs(p))
        found = 1 / found if p < 0 else found
    elif name == "Heaviside":
        found = (args[0].sgn() + 1) / 2
    else:
        found = abs(args[0]) if name == "Abs" else getattr(args[0], name.replace("sign", "sgn"))()
    known[e] = found
    return found


class Box:
    """The states x + r e, |e_i| <= 1."""

    def __init__(self, states: Any, x: np.ndarray, r: np.ndarray) -> None:
        self.states, self.x, self.r = states, x.tolist(), r.tolist()
        self.point = dict(zip(states, map(ARB, self.x), strict=True))
        self.whole = dict(zip(states, map(ARB, self.x, self.r), strict=True))

    def slopes(self, e: Any) -> list[Any]:
        return [ball(derivative(e, s), self.whole) for s in self.states]

    def low(self, e: Any) -> Any:
        """A number that an expression is not below on the box; NaN if it may have no value."""
        whole, reach = ball(e, self.whole), sum(map(operator.mul, map(abs, self.slopes(e)), self.r))
        form = ball(e, self.point) - reach
        return max([v.lower() for v in (whole, form) if v.is_finite()], default=ARB.nan())

    def values(self, e: Any, z: Any) -> Any:
        return ball(e, dict(zip(self.states, map(ARB, z), strict=True)))


@functools.cache
def derivative(e: Any, s: Any) -> Any:
    return sp.diff(e, s)


def claims_of(c: Any) -> list[tuple[Any, ...]]:
    """Return (claim, effect of the input, region, zero, face) of each statement."""
    plant, p, h = c.plant, c.psi.expression, c.plant.barriers
    states, (a, m, top) = plant.states, map(sp.Rational, (c.rate, c.shortfall, c.supremum))
    rise: Any = a * p + m + sum(f * sp.diff(p, s) for f, s in zip(plant.drift, states, strict=True))
    sigma: Any = sp.Matrix(plant.diffusion)
    curve = sp.hessian(p, states)
    rise += (sigma.T * curve * sigma).trace() / 2
    effect = sum(g[0] * sp.diff(p, s) for g, s in zip(plant.input_matrix, states, strict=True))
    (low, high), region = plant.bounds[0], (p, *h)
    if plant.policy:
        rise, effect = rise + effect * sp.Max(low, sp.Min(high, plant.policy[0])), sp.S.Zero
    found = [(top - p, sp.S.Zero, region, None, None), (rise, effect, region, None, None)]
    for i, e in enumerate(h):
        if sp.expand(p - e) != 0:
            found.append((-p, sp.S.Zero, (p, *h[:i], *h[i + 1 :]), e, None))
    for i, ends in enumerate(plant.workspace):
        if plant.angles[i]:
            found += [(-p, sp.S.Zero, region, None, (i, end)) for end in ends]
    return found


def verdict(c: Any, box: Box, claim: tuple[Any, ...], inside: bool) -> str:
    """Return what is known of a claim on a box: checked, refuted or open."""
    e, effect, region, zero, _ = claim
    plant, none = c.plant, [] if zero is None else [zero]
    if any(box.low(-q) > 0 for q in (*region, *none)) or any(box.low(q) > 0 for q in none):
        return "checked"
    used = (*plant.drift, *plant.policy, *itertools.chain(*plant.input_matrix, *plant.diffusion))
    defined = all(ball(q, box.whole).is_finite() for q in used)
    low, high = plant.bounds[0]
    tries = {low, high}
    if effect != 0:  # The input that best cancels a slope, or none.
        pairs = zip(box.slopes(e), box.slopes(effect), strict=True)
        mids = [(float(s.mid()), float(t.mid())) for s, t in pairs]
        ratios = [-s / t for s, t in mids if t and np.isfinite(s / t)]
        tries |= {min(max(sp.Rational(k), low), high) for k in (0.0, *ratios)}
    if defined and any(box.low(e + k * effect) >= 0 for k in tries):
        return "checked"
    if zero is not None:
        if not (box.low(-e) > 0 and all(box.low(q) > 0 for q in region)):
            return "open"
        turns = [1 if s.mid() > 0 else -1 for s in box.slopes(zero)]
        steps = [t * r for t, r in zip(turns, box.r, strict=True)]
        first, last = (
            box.values(zero, [v + k * s for v, s in zip(box.x, steps, strict=True)])
            for k in (-1, 1)
        )
        return "refuted" if first < 0 and last > 0 else "open"
    most = max(ball(e + k * effect, box.point).upper() for k in (low, high))
    positive = all(ball(q, box.point) > 0 for q in region)
    return "refuted" if inside and most < 0 and positive else "open"


def word(c: Any, boxes: int = 3000) -> str:
    """Return whether a certificate is checked, refuted or undecided, by `boxes` for each claim."""
    plant = c.plant
    finite = all(e.is_finite and f.is_finite and e < f for e, f in plant.workspace + plant.bounds)
    if not finite or min(c.rate, c.shortfall) < 0 or min(c.supremum, c.horizon) <= 0:
        return "refuted"
    with flint.ctx.workprec(BITS):
        words = {_searched(c, claim, boxes) for claim in claims_of(c)}
    return next((each for each in ("refuted", "undecided") if each in words), "checked")


def _searched(c: Any, claim: tuple[Any, ...], boxes: int) -> str:
    ends = np.array(c.plant.workspace, dtype=float)
    root = ends.copy()
    if claim[4] is not None:
        root[claim[4][0]] = float(claim[4][1])
    queue = deque([(root.mean(axis=1), np.ptp(root, axis=1) / 2)])
    for _ in range(boxes):
        if not queue:
            return "checked"
        x, r = queue.popleft()
        wide = r * (1 + 2.0**-20) + 2.0**-50 * np.abs(ends).max(axis=1)
        inside = bool(((ends[:, 0] <= x) & (x <= ends[:, 1])).all())
        found = verdict(c, Box(c.plant.states, x, wide), claim, inside)
        if found == "refuted":
            return found
        if found == "open":
            step = r * (np.arange(len(x)) == (r / np.ptp(ends, axis=1)).argmax()) / 2
            queue += [(x - step, r - step), (x + step, r - step)]
    return "undecided"
