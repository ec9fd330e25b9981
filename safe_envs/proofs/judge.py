"""The judge of statements: branch and bound, rounded outwards.

A box is settled where the region has no state in it, or where the enclosure of the claim is at
least 0 and all that has to be smooth is. What is left is bisected, across the axis along which the
enclosures vary most. A statement is proved when no box is left. It is refuted by a state which is
certainly in the region and where the claim certainly fails.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import sympy as sp

from safe_envs.dynamics.polynomial import Polynomial
from safe_envs.enclosures.expression_program import ExpressionProgram
from safe_envs.enclosures.forms import ContinuousOperations, Form, FormOperations, points, variables
from safe_envs.enclosures.intervals import Interval, IntervalArithmetic
from safe_envs.enclosures.polynomial_forms import ExpandedPolynomial, Order
from safe_envs.errors import SystemDefinitionError


def axis_of(
    low: np.ndarray,
    high: np.ndarray,
    width: np.ndarray,
    forms: Sequence[Form],
    chosen: np.ndarray,
) -> np.ndarray:
    """Return the axis along which forms vary most on each box, shape (B,).

    Args:
        low: lower ends of the boxes, shape (n, B).
        high: upper ends, shape (n, B).
        width: of the whole box, by which widths are compared, shape (n,).
        forms: on these boxes and others.
        chosen: which of those the boxes are, C flags of which B are true.
    """
    with np.errstate(all="ignore"):
        share = (high - low) / np.where(np.isfinite(width), width, 1.0)[:, None]
        share = np.where(np.isfinite(share), share, 1e30)
        share = share / share.sum(axis=0)
        score = 1e-3 * share
        for form in forms:
            score = score + _variation(form, chosen, share)
    return np.where(np.isfinite(score), score, 0.0).argmax(axis=0)


def _variation(form: Form, open_: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the part of a range that each axis makes, shape (n, B)."""
    slopes, radius = np.abs(form.slopes[:, open_]), form.radius[open_]
    total = slopes.sum(axis=0) + radius
    part = (slopes + share * radius) / total
    return np.where(np.isfinite(part) & (total > 0.0), part, share)


def middle_of(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return midpoints; where an end is infinite, numbers that are far beyond the other one.

    Args:
        low: lower ends.
        high: upper ends.
    """
    with np.errstate(invalid="ignore"):
        middle = 0.5 * low + 0.5 * high
    middle = np.where(np.isneginf(low) & np.isposinf(high), 0.0, middle)
    middle = np.where(
        np.isfinite(low) & np.isposinf(high), np.maximum(2.0 * low, low + 1.0), middle
    )
    return np.where(
        np.isneginf(low) & np.isfinite(high), np.minimum(2.0 * high, high - 1.0), middle
    )


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
    return IntervalArithmetic().constant(number)


_BATCH = 4096
_TRIED = 128
_NARROW = 1e-6
_FAR = 1e12


@dataclass(frozen=True)
class Budget:
    """What a judgement may cost.

    Attributes:
        boxes: most boxes that are looked at.
        seconds: most processor time.
    """

    boxes: int = 2_000_000
    seconds: float = 20.0


class BranchAndBound:
    """Boxes that are left, with upper bounds of what is to be at most a target.

    Attributes:
        best: largest value that was certainly met in the region.
        best_state: where that is.
        guide: largest value that was met next to the region, where no state is certainly in it.
        boxes: number of boxes that were looked at.
        margin: by how much the largest value may be missed, where there is no target.
    """

    def __init__(self, statement: Statement, budget: Budget, target: float | None = None) -> None:
        self._statement, self._budget, self._target = statement, budget, target
        self._program = statement.program
        low, high = statement.ends
        self._low, self._high = low[:, None], high[:, None]
        self._upper = np.array([math.inf])
        self._width = high - low
        self._settled = -math.inf
        self._stuck: np.ndarray | None = None
        self._begun = time.process_time()
        self.best, self.best_state, self.boxes = -math.inf, None, 0
        self.guide = -math.inf
        self.margin = 0.0

    @property
    def open_boxes(self) -> int:
        """Number of boxes that are left."""
        return self._low.shape[1]

    @property
    def widest_open(self) -> np.ndarray:
        """The box that bisection does not help, or whose bound is worst, shape (2, n)."""
        worst = int(self._upper.argmax())
        open_ = np.array([self._low[:, worst], self._high[:, worst]])
        return open_ if self._stuck is None else self._stuck

    @property
    def upper(self) -> float:
        """Bound over all boxes, settled and left."""
        return max(self._settled, self.best, float(self._upper.max(initial=-math.inf)))

    @property
    def exhausted(self) -> str:
        """Why the search has to end, in words; empty where it need not."""
        if self.boxes >= self._budget.boxes:
            return f"{self._left} after {self.boxes} boxes; allow more, or a larger margin"
        if time.process_time() - self._begun > self._budget.seconds:
            return f"{self._left} after {self._budget.seconds:g} s; allow more, or a larger margin"
        return ""

    @property
    def _left(self) -> str:
        return f"{self._statement.name}: {self.open_boxes} boxes are left"

    @property
    def _enough(self) -> float:
        """Bound at which a box is settled."""
        return (
            self._target if self._target is not None else self.margin + max(self.best, self.guide)
        )

    def tried(self, x: np.ndarray) -> bool:
        """Look at states in the box, shape (n, B), and return whether one refutes the statement."""
        low, high = (end[:, None] for end in self._statement.ends)
        x = x[:, ((low <= x) & (x <= high)).all(axis=0)]
        if not x.size:
            return False
        found = self._program(x, x)
        value = -found.claim.range.high
        value = np.where(found.inside & np.isfinite(value), value, -np.inf)
        if found.zeros:
            value = np.full_like(value, -np.inf)  # No number is certainly 0.
        first = int(value.argmax())
        if value[first] > self.best:
            self.best, self.best_state = float(value[first]), x[:, first].copy()
        return self._target is not None and self.best > 0.0

    def settle_some(self) -> str:
        """Look at a batch of boxes, and bisect what is left of them.

        Returns:
            Why no further bisection helps, in words; empty where it may.
        """
        low, high = self._taken()
        found = self._program(low, high)
        self.boxes += low.shape[1]
        upper = -found.claim.range.low
        open_ = ~found.outside & ~((upper <= self._enough) & found.smooth)
        self._note_settled(upper[~found.outside & ~open_])
        if not open_.any():
            return ""
        # Centers of forms tell which middles are probably in the region.
        likely = open_.copy()
        for form in found.region:
            likely &= form.center > 0.0
        value = np.where(likely, -found.claim.center, -np.inf)
        chosen = np.argsort(-value)[:_TRIED]
        chosen = chosen[open_[chosen]]
        middle = middle_of(low[:, chosen], high[:, chosen])
        if self.tried(middle):
            return ""
        if found.zeros:
            if self._target is None:
                self._look_near_zeros(middle, low, high, found, chosen)
            elif self._crosses(low, high, found, chosen):
                return ""
        return self._bisect(low, high, upper, found, open_)

    def _taken(self) -> tuple[np.ndarray, np.ndarray]:
        """Take boxes: the last ones, which are the smallest; the worst ones without a target."""
        count = min(_BATCH, self.open_boxes)
        if self._target is None and self.open_boxes > count:
            order = np.argsort(self._upper, kind="stable")
            self._low, self._high = self._low[:, order], self._high[:, order]
            self._upper = self._upper[order]
        low, high = self._low[:, -count:], self._high[:, -count:]
        self._low, self._high = self._low[:, :-count], self._high[:, :-count]
        self._upper = self._upper[:-count]
        if self._target is None:
            done = self._upper <= self._enough
            self._note_settled(self._upper[done])
            self._low, self._high = self._low[:, ~done], self._high[:, ~done]
            self._upper = self._upper[~done]
        return low, high

    def _note_settled(self, upper: np.ndarray) -> None:
        self._settled = max(self._settled, float(upper.max(initial=-math.inf)))

    def _look_near_zeros(
        self,
        middle: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        found: Enclosures,
        chosen: np.ndarray,
    ) -> None:
        """Move states towards the zeros by a step of Newton's method, for a guide only."""
        x = middle
        for zero in found.zeros:
            slopes = zero.slopes[:, chosen]
            with np.errstate(all="ignore"):
                step = zero.center[chosen] / (slopes * slopes).sum(axis=0)
                x = x - np.nan_to_num(slopes * step, posinf=0.0, neginf=0.0) * 0.5 * (
                    high[:, chosen] - low[:, chosen]
                )
        x = np.clip(x, low[:, chosen], high[:, chosen])
        near = self._program(x, x)
        small = (high[:, chosen] - low[:, chosen] <= 0.05 * self._width[:, None]).all(axis=0)
        size = [
            np.abs(z.center) <= 1e-2 * np.abs(w.slopes[:, chosen]).sum(axis=0)
            for z, w in zip(near.zeros, found.zeros, strict=True)
        ]
        usable = near.inside & small & np.logical_and.reduce(size)
        values = np.where(usable, -near.claim.center, -np.inf)
        self.guide = max(self.guide, float(values.max(initial=-math.inf)))

    def _crosses(
        self, low: np.ndarray, high: np.ndarray, found: Enclosures, chosen: np.ndarray
    ) -> bool:
        """Return whether the claim fails on a whole box across which a zero is crossed."""
        # One of the expressions that are 0 in the region is continuous, and takes both signs there.
        if len(found.zeros) != 1:
            return False
        fails = found.inside & (found.claim.range.high < 0.0) & np.isfinite(found.claim.range.low)
        fails &= found.zeros[0].smooth
        for i in chosen[fails[chosen]].tolist():
            upward = found.zeros[0].slopes[:, i] >= 0.0
            ends = np.stack(
                [
                    np.where(upward, high[:, i], low[:, i]),
                    np.where(upward, low[:, i], high[:, i]),
                ],
                axis=1,
            )
            (zero,) = self._program(ends, ends).zeros
            if zero.range.low[0] > 0.0 and zero.range.high[1] < 0.0:
                self.best = float(-found.claim.range.high[i])
                self.best_state = middle_of(low[:, [i]], high[:, [i]])[:, 0]
                return True
        return False

    def _bisect(
        self,
        low: np.ndarray,
        high: np.ndarray,
        upper: np.ndarray,
        found: Enclosures,
        open_: np.ndarray,
    ) -> str:
        """Put the halves of boxes back; return why that is of no use, in words."""
        low, high, upper = low[:, open_], high[:, open_], upper[open_]
        forms = (found.claim, *found.region, *found.zeros)
        axis = axis_of(low, high, self._width, forms, open_)
        at = np.arange(len(axis))
        middle = middle_of(low, high)[axis, at]
        stuck = (middle <= low[axis, at]) | (middle >= high[axis, at]) | (np.abs(middle) > _FAR)
        with np.errstate(invalid="ignore"):
            narrow = ((high - low) <= _NARROW * np.minimum(self._width, 1.0)[:, None]).all(axis=0)
        rough = narrow & ~found.smooth[open_] & found.inside[open_]
        for form in found.zeros:
            rough |= narrow & ~form.smooth[open_]
        below, above = high.copy(), low.copy()
        below[axis, at], above[axis, at] = middle, middle
        if (stuck | rough).any():
            i = int((stuck | rough).argmax())
            self._stuck = np.array([low[:, i], high[:, i]])
            self._leave(low, high, upper)  # All: a bound is over all that are left.
            return self._why_stuck(bool(rough[i]), bool(found.smooth[open_][i]))
        self._leave(low, below, upper)
        self._leave(above, high, upper)
        return ""

    def _leave(self, low: np.ndarray, high: np.ndarray, upper: np.ndarray) -> None:
        """Add boxes to those that are left."""
        self._low = np.concatenate([self._low, low], axis=1)
        self._high = np.concatenate([self._high, high], axis=1)
        self._upper = np.concatenate([self._upper, upper])

    def _why_stuck(self, rough: bool, smooth: bool) -> str:
        name, (low, high) = self._statement.name, self.widest_open
        near = ", ".join(
            f"{s} = {a:.6g}" if np.isfinite(b - a) else f"{s} from {a:.3g} to {b:.3g}"
            for s, a, b in zip(self._statement.states, low, high, strict=True)
        )
        if rough or not smooth:
            return (
                f"{name}: not {self._asked} near {near}, where evaluation meets a kink, a jump, a"
                " pole, or the edge of a domain"
            )
        if not np.isfinite(high - low).all() or max(abs(low).max(), abs(high).max()) > _FAR:
            return f"{name}: the region has no end, {near}"
        return f"{name}: equal to rounding near {near}; a larger margin would tell"

    @property
    def _asked(self) -> str:
        return "twice continuously differentiable" if self._statement.smooth else "continuous"


Word = Literal["proved", "refuted", "undecided"]


class JudgeResult(NamedTuple):
    """What is known of a statement.

    Attributes:
        word: "proved", "refuted" or "undecided".
        boxes: number of boxes that were looked at.
        state: where it fails, shape (n,); None unless it is refuted.
        box: where it is open, lower and upper ends, shape (2, n); None unless it is undecided.
        reason: why it is not proved, in words; empty where it is.
    """

    word: Word
    boxes: int
    state: np.ndarray | None = None
    box: np.ndarray | None = None
    reason: str = ""


class Supremum(NamedTuple):
    """Bounds of the supremum of an expression over a region.

    Attributes:
        upper: proved upper bound; infinite where none was found, -inf where the region is empty.
        lower: largest value that was certainly met; -inf where no state was.
        state: where that is, shape (n,); None where no state was met.
        boxes: number of boxes that were looked at.
        reason: why the bounds are not near each other, in words; empty where they are.
    """

    upper: float
    lower: float
    state: np.ndarray | None
    boxes: int
    reason: str = ""


def judge(
    statement: Statement, budget: Budget | None = None, hints: np.ndarray | None = None
) -> JudgeResult:
    """Decide a statement.

    Args:
        statement: to be decided.
        budget: what it may cost.
        hints: states where it may fail, shape (B, n).

    Returns:
        The verdict, which is never "proved" for a false statement.
    """
    budget = budget or Budget()
    try:
        search = BranchAndBound(statement, budget, target=0.0)
    except SystemDefinitionError as error:
        return JudgeResult("undecided", 0, reason=str(error))
    if hints is not None and search.tried(np.asarray(hints, dtype=float).T):
        return _refuted(statement, search)
    while search.open_boxes:
        reason = search.exhausted or search.settle_some()
        if search.best > 0.0:
            return _refuted(statement, search)
        if reason:
            return JudgeResult("undecided", search.boxes, box=search.widest_open, reason=reason)
    return JudgeResult("proved", search.boxes)


def supremum(
    statement: Statement,
    expression: Any,
    tolerance: float,
    budget: Budget | None = None,
    hints: np.ndarray | None = None,
) -> Supremum:
    """Bound the supremum of an expression over the region of a statement.

    Args:
        statement: whose region is taken; its claim does not matter.
        expression: of its symbols.
        tolerance: largest difference between the bounds that is wanted.
        budget: what it may cost; the upper bound is one also where it does not suffice.
        hints: states where it may be large, shape (B, n).

    Returns:
        The bounds.
    """
    budget = budget or Budget()
    try:
        search = BranchAndBound(replace(statement, claim=-sp.sympify(expression)), budget)
    except SystemDefinitionError as error:
        return Supremum(math.inf, -math.inf, None, 0, str(error))
    search.margin = tolerance
    if hints is not None:
        search.tried(np.asarray(hints, dtype=float).T)
    reason = ""
    while search.open_boxes and not reason:
        reason = search.exhausted or search.settle_some()
    return Supremum(search.upper, search.best, search.best_state, search.boxes, reason)


def _refuted(statement: Statement, search: BranchAndBound) -> JudgeResult:
    state = search.best_state if search.best_state is not None else np.zeros(0)
    values = zip(statement.states, state.tolist(), strict=True)
    at = ", ".join(f"{s} = {value:.6g}" for s, value in values)
    reason = f"{statement.name} fails at {at}, by {search.best:.3g}"
    return JudgeResult("refuted", search.boxes, state=state, reason=reason)


def largest_input_term(coefficients: Sequence[Any], bounds: Sequence[tuple[Any, Any]]) -> Any:
    """Return the largest a u for inputs within bounds.

    Args:
        coefficients: a, an expression for each input.
        bounds: lower and upper bound of each.
    """
    # max(low a, high a), as an expression whose enclosure is not below 0 where a changes its sign.
    return sum(
        (low + high) / 2 * a + (high - low) / 2 * sp.Abs(a)
        for a, (low, high) in zip(coefficients, bounds, strict=True)
        if a != 0
    )


def exact_number(value: float) -> Any:
    """Return the decimal that a float is written as, exactly; infinities stay what they are."""
    return sp.Rational(repr(float(value))) if math.isfinite(value) else sp.Float(value)


def not_polynomial(expressions: Sequence[Any], states: Sequence[sp.Symbol]) -> tuple[Any, ...]:
    """Return those of several expressions that may fail to be continuous, for a form alone.

    Args:
        expressions: of the states.
        states: symbols.
    """
    found = (sp.sympify(e) for e in expressions)
    return tuple(dict.fromkeys(e for e in found if not e.is_polynomial(*states)))
