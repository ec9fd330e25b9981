"""Statements about all states of a region, and their enclosures on boxes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.continuous_forms import ContinuousOperations
from safe_envs.dynamics.expression_program import ExpressionProgram
from safe_envs.dynamics.first_order_forms import Form, points, variables
from safe_envs.dynamics.form_functions import FormOperations
from safe_envs.dynamics.interval_arithmetic import Interval
from safe_envs.dynamics.intervals import IntervalOperations
from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.dynamics.polynomial_forms import ExpandedPolynomial, Order

Witness = Callable[[np.ndarray], np.ndarray]
"""From the middles of boxes, shape (B, n), to one number for each witness symbol, shape (B, w)."""


class PolynomialPart(NamedTuple):
    """A derivative of a polynomial.

    Attributes:
        polynomial: of the states.
        order: how often the derivative is taken in each state; zeros for the polynomial itself.
    """

    polynomial: Polynomial
    order: Order


@dataclass(frozen=True)
class Statement:
    """A claim: an expression is at least 0 at every state of a region.

    The region is where all of `positive` are above 0, all of `nonnegative` at least 0 and all of
    `zeros` are 0, within a box. Where `smooth` or `continuous` are given the statement says besides
    that these expressions are twice continuously differentiable there, or continuous.

    Attributes:
        name: in words.
        states: symbols.
        box: lower and upper end of each state, numbers or expressions without symbols; may be
            infinite.
        claim: that is to be at least 0.
        positive: above 0 in the region.
        nonnegative: at least 0 in the region.
        zeros: 0 in the region, or not continuous: there the sign may change without a zero.
        smooth: to be twice continuously differentiable.
        continuous: to be continuous, and so to have a value.
        polynomials: what symbols in the expressions stand for, of some or all of the states.
        witnesses: symbols that may be chosen on each box, such as an input that meets a claim.
        witness: which chooses them.
    """

    name: str
    states: tuple[sp.Symbol, ...]
    box: tuple[tuple[Any, Any], ...]
    claim: sp.Expr
    positive: tuple[sp.Expr, ...] = ()
    nonnegative: tuple[sp.Expr, ...] = ()
    zeros: tuple[sp.Expr, ...] = ()
    smooth: tuple[sp.Expr, ...] = ()
    continuous: tuple[sp.Expr, ...] = ()
    polynomials: Mapping[sp.Symbol, PolynomialPart] = field(default_factory=dict)
    witnesses: tuple[sp.Symbol, ...] = ()
    witness: Witness | None = None

    @cached_property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper ends of the box, rounded outwards, shape (n,) each."""
        enclosures = [[_enclosure(end) for end in ends] for ends in self.box]
        low = np.array([first.low for first, _ in enclosures], dtype=float)
        return low, np.array([last.high for _, last in enclosures], dtype=float)

    @cached_property
    def program(self) -> StatementProgram:
        """The statement, compiled.

        Raises:
            SystemDefinitionError: An expression has no interval form.
        """
        return StatementProgram(self)


class Enclosures(NamedTuple):
    """What is known of a statement on B boxes.

    Attributes:
        claim: its form.
        region: forms of the expressions that make the region.
        zeros: forms of those that are 0 in it, smooth where they are continuous.
        outside: whether the region has no state in the box, shape (B,).
        inside: whether the whole box lies in the region, shape (B,); where there are `zeros`, apart
            from these.
        smooth: whether all that has to be smooth or continuous is, shape (B,).
    """

    claim: Form
    region: tuple[Form, ...]
    zeros: tuple[Form, ...]
    outside: np.ndarray
    inside: np.ndarray
    smooth: np.ndarray


class StatementProgram:
    """The enclosures of a statement on many boxes.

    Args:
        statement: which is compiled.

    Raises:
        SystemDefinitionError: An expression has no interval form.
    """

    def __init__(self, statement: Statement) -> None:
        self._statement, self._n = statement, len(statement.states)
        self._parts = _by_polynomial(statement.polynomials)
        symbols = (*statement.states, *statement.polynomials, *statement.witnesses)
        s = statement
        expressions = (s.claim, *s.positive, *s.nonnegative, *s.smooth)
        self._program = ExpressionProgram(
            symbols, [sp.sympify(e) for e in expressions], FormOperations(self._n)
        )
        continuous = [sp.sympify(e) for e in (*s.zeros, *s.continuous)]
        self._continuous = ExpressionProgram(symbols, continuous, ContinuousOperations(self._n))

    def __call__(self, low: np.ndarray, high: np.ndarray) -> Enclosures:
        """Return what is known on boxes.

        Args:
            low: lower ends, shape (n, B).
            high: upper ends, shape (n, B).
        """
        s, boxes = self._statement, low.shape[1]
        with np.errstate(all="ignore"):
            found = dict(zip(s.states, variables(low, high), strict=True))
            for expanded, symbols, orders in self._parts:
                own = [s.states.index(state) for state in expanded.polynomial.states]
                forms = expanded.forms(low[own], high[own], orders)
                if own != list(range(self._n)):
                    forms = [_placed(form, own, self._n) for form in forms]
                found.update(zip(symbols, forms, strict=True))
            if s.witness is not None:
                middle = np.nan_to_num(0.5 * low + 0.5 * high).T
                chosen = np.asarray(s.witness(middle), dtype=float).T
                found.update(
                    (w, points(value, self._n))
                    for w, value in zip(s.witnesses, chosen, strict=True)
                )
            values = [found[symbol] for symbol in (*s.states, *s.polynomials, *s.witnesses)]
            forms = [_broadcast(form, self._n, boxes) for form in self._program(values)]
            others = [_broadcast(form, self._n, boxes) for form in self._continuous(values)]
        zeros, continuous = tuple(others[: len(s.zeros)]), others[len(s.zeros) :]
        rest = iter(forms[1:])
        positive, nonnegative, smooth = (
            tuple(itertools.islice(rest, len(part)))
            for part in (s.positive, s.nonnegative, s.smooth)
        )
        outside, inside = np.zeros(boxes, dtype=bool), np.ones(boxes, dtype=bool)
        for form in positive:
            outside |= form.range.high <= 0.0
            inside &= form.range.low > 0.0
        for form in nonnegative:
            outside |= form.range.high < 0.0
            inside &= form.range.low >= 0.0
        for form in zeros:
            outside |= form.smooth & ((form.range.high < 0.0) | (form.range.low > 0.0))
        regular = np.ones(boxes, dtype=bool)
        for form in (*smooth, *continuous):
            regular &= form.smooth
        region = (*positive, *nonnegative)
        return Enclosures(forms[0], region, zeros, outside, inside, regular)


def _by_polynomial(
    polynomials: Mapping[sp.Symbol, PolynomialPart],
) -> list[tuple[ExpandedPolynomial, list[sp.Symbol], list[Order]]]:
    """Group the symbols by the polynomial whose derivatives they stand for."""
    groups: dict[int, tuple[ExpandedPolynomial, list[sp.Symbol], list[Order]]] = {}
    for symbol, part in polynomials.items():
        key = id(part.polynomial)
        _, symbols, orders = groups.setdefault(key, (ExpandedPolynomial(part.polynomial), [], []))
        symbols.append(symbol)
        orders.append(part.order)
    return list(groups.values())


def _placed(form: Form, own: list[int], n: int) -> Form:
    """Return the form over n states of a function of some of them."""
    slopes = np.zeros((n, form.slopes.shape[1]))
    slopes[own] = form.slopes
    return form._replace(slopes=slopes)


def _broadcast(form: Form, n: int, boxes: int) -> Form:
    shape = (boxes,)
    return Form(
        np.broadcast_to(form.center, shape),
        np.broadcast_to(form.slopes, (n, boxes)),
        np.broadcast_to(form.radius, shape),
        Interval(np.broadcast_to(form.range.low, shape), np.broadcast_to(form.range.high, shape)),
        np.broadcast_to(form.smooth, shape),
    )


def _enclosure(end: Any) -> Interval:
    number = sp.sympify(end)
    if number in (sp.oo, -sp.oo):
        return Interval(float(number), float(number))
    return IntervalOperations().constant(number)
