"""Random expressions and boxes, with values of 60 digits in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mpmath
import numpy as np
import sympy as sp

from safe_envs.enclosures.expression_program import ExpressionProgram
from safe_envs.enclosures.forms import Form, FormOperations, variables

DIGITS = 60
X, Y = sp.symbols("x y", real=True)

# What becomes 0 where a function is not twice continuously differentiable.
_SMOOTH = (sp.exp, sp.sin, sp.cos, sp.atan, sp.sinh, sp.cosh, sp.tanh, sp.asinh)
_PARTIAL = (sp.log, sp.sqrt, sp.asin, sp.acos, sp.acosh, sp.atanh)
_PARTIAL += (sp.tan, sp.sec, sp.csc, sp.cot, sp.sech, sp.csch, sp.coth)
_ROUGH = (sp.Abs, sp.sign, sp.floor, sp.ceiling)
_POWERS = (2, 3, 4, 5, 8, 17, -1, -2, -3, 1.5, 2.5, -0.5, sp.Rational(1, 3), sp.sqrt(2))
_NUMBERS = (0.1, -3, 1e-9, -1e6, sp.Rational(1, 3), sp.pi, 2, 0.5)
_ENDS = (0.0, -0.0, 1.0, -1.0, 0.5, 2.0, 1.5707963267948966, 3.141592653589793, 1e-160, 1e-300)


def functions() -> list[Callable[..., Any]]:
    """Return each operation that programs know, as functions of one or two expressions."""
    one = [*_SMOOTH, *_PARTIAL, *_ROUGH, *[lambda e, p=p: e**p for p in _POWERS]]
    two = [
        lambda a, b: a + b,
        lambda a, b: a * b,
        lambda a, b: a / b,
        sp.Max,
        sp.Min,
        sp.atan2,
        lambda a, b: sp.Abs(a) ** b,
    ]
    return [*[lambda a, b, f=f: f(a) for f in one], *two]


def random_expression(random: np.random.Generator, depth: int) -> Any:
    """Return a composition of known operations that holds a symbol, or a leaf."""
    if depth == 0:
        if random.random() < 0.3:
            return sp.sympify(_NUMBERS[random.integers(len(_NUMBERS))])
        return (X, Y)[random.integers(2)]
    kinds = functions()
    kind = kinds[random.integers(len(kinds))]
    if random.random() < 0.4:
        kind = kinds[-7 + random.integers(3)]
    # An operand of 0 or of another simple number may be outside of a domain everywhere.
    found = kind(random_expression(random, depth - 1), random_expression(random, depth - 1))
    usable = found.free_symbols and found.is_extended_real is not False
    return X if not usable or found.has(sp.zoo, sp.nan, sp.I, sp.oo) else found


def random_boxes(random: np.random.Generator, count: int) -> np.ndarray:
    """Return boxes of all sizes, points among them, shape (2, 2, count): ends, states, boxes."""
    center = random.choice([-1, 1], (2, count)) * 10.0 ** random.uniform(-6, 2, (2, count))
    width = 10.0 ** random.uniform(-12, 3, (2, count)) * (random.random((2, count)) < 0.9)
    low, high = center - width, center + width
    for end in (low, high):
        special = random.random((2, count)) < 0.15
        end[special] = random.choice(_ENDS, int(special.sum()))
    tiny = random.random(count) < 0.05
    low[:, tiny] *= 1e-150
    high[:, tiny] *= 1e-150
    return np.array([np.minimum(low, high), np.maximum(low, high)])


def forms_of(
    expressions: Sequence[Any], boxes: np.ndarray, symbols: Sequence[Any] = (X, Y)
) -> list[Form]:
    """Return the forms of expressions on boxes, broadcast to them."""
    n, count = boxes.shape[1:]
    with np.errstate(all="ignore"):
        values = variables(*boxes)
        found = ExpressionProgram(symbols, expressions, FormOperations(n))(values)
    zeros = np.zeros(count)
    return [
        form._replace(
            center=form.center + zeros,
            slopes=form.slopes + zeros,
            radius=form.radius + zeros,
            range=type(form.range)(form.range.low + zeros, form.range.high + zeros),
            smooth=form.smooth | np.zeros(count, dtype=bool),
        )
        for form in found
    ]


def points_in(box: np.ndarray, random: np.random.Generator, count: int) -> list[list[float]]:
    """Return states of a box, shape (2, n): its two corners, and others."""
    low, high = box
    share = random.random((count, len(low)))
    share = np.where(random.random(share.shape) < 0.2, np.round(share), share)
    inner = np.clip(low + share * (high - low), low, high)
    return [low.tolist(), high.tolist(), *inner.tolist()]


def exact_function(expression: Any, symbols: Sequence[Any] = (X, Y)) -> Callable[..., Any]:
    """Return a function of floats with 60 digits.

    It is None where a part has no real value, and NaN where one is too large to be computed.
    """
    program: list[tuple[Any, tuple[int, ...]]] = []
    places: dict[Any, int] = {symbol: i for i, symbol in enumerate(symbols)}

    def place(part: Any) -> int:
        if part not in places:
            inputs = () if part.is_number else tuple(place(a) for a in part.args)
            with mpmath.workdps(DIGITS):
                kind = mpmath.mpmathify(sp.N(part, DIGITS)) if part.is_number else part.func
            program.append((kind, inputs))
            places[part] = len(symbols) + len(program) - 1
        return places[part]

    last = place(expression)

    def value(state: Sequence[float]) -> Any:
        with mpmath.workdps(DIGITS):
            memory = [mpmath.mpf(v) for v in state]
            for kind, inputs in program:
                try:
                    found = _EXACT[kind](*[memory[i] for i in inputs]) if inputs else kind
                except (ArithmeticError, ValueError):
                    return None
                if not isinstance(found, mpmath.mpf) or not mpmath.isfinite(found):
                    return None
                if found and not 1e-300 < abs(found) < 1e300:
                    return mpmath.nan
                memory.append(found)
            return memory[last]

    return value


_SHARED = (
    "exp",
    "log",
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "atan2",
    "sign",
    "floor",
    "sinh",
    "cosh",
    "tanh",
    "asinh",
    "acosh",
    "atanh",
)
_EXACT: dict[Any, Callable[..., Any]] = {
    sp.Add: lambda *a: mpmath.fsum(a),
    sp.Mul: lambda *a: mpmath.fprod(a),
    sp.Pow: lambda a, b: a**b,
    sp.Abs: lambda a: abs(a),
    sp.Max: lambda *a: max(a),
    sp.Min: lambda *a: min(a),
    sp.sec: lambda a: 1 / mpmath.cos(a),
    sp.csc: lambda a: 1 / mpmath.sin(a),
    sp.cot: lambda a: 1 / mpmath.tan(a),
    sp.sech: lambda a: 1 / mpmath.cosh(a),
    sp.csch: lambda a: 1 / mpmath.sinh(a),
    sp.coth: lambda a: 1 / mpmath.tanh(a),
    sp.ceiling: lambda a: mpmath.ceil(a),
    **{getattr(sp, name): getattr(mpmath, name) for name in _SHARED},
}
"""Of the SymPy classes that an expression may hold."""


def errors_of(form: Form, box: np.ndarray, i: int, state: Sequence[float], exact: Any) -> str:
    """Say what is wrong with a form on box i at a state where the exact value is known."""
    with mpmath.workdps(DIGITS):
        low, high = form.range.low[i], form.range.high[i]
        if np.isnan([low, high, form.center[i], form.radius[i]]).any():
            return "NaN"
        if not mpmath.mpf(low) <= exact <= mpmath.mpf(high):
            return f"{exact} is not in [{low}, {high}]"
        if not np.isfinite(form.radius[i]):
            return ""
        about = mpmath.mpf(form.center[i])
        for j, x in enumerate(state):
            ends = [mpmath.mpf(end) for end in box[:, j]]
            radius = (ends[1] - ends[0]) / 2
            t = (mpmath.mpf(x) - (ends[0] + ends[1]) / 2) / radius if radius else 0
            about += mpmath.mpf(form.slopes[j, i]) * t
        gap = abs(exact - about)
        return "" if gap <= form.radius[i] else f"{gap} > {form.radius[i]} away"
