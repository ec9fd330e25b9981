"""Generated code of where a step takes states: the kernel `state_images` of a problem."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import sympy as sp

from safe_envs.compiled.formulas import Source
from safe_envs.compiled.program import Program, is_available
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers.value import image_kernel as kernels

_LONGEST = 8
"""Exponents of powers that are products."""

_UNARY: dict[Any, Callable[..., Any]] = {
    sp.sin: kernels.ends_sine,
    sp.cos: kernels.ends_cosine,
    sp.exp: kernels.ends_exponential,
    sp.Abs: kernels.ends_magnitude,
}
_FOLDED: dict[Any, Callable[..., Any]] = {
    sp.Add: kernels.ends_sum,
    sp.Mul: kernels.ends_product,
    sp.Max: kernels.ends_larger,
    sp.Min: kernels.ends_smaller,
}

_LEVELS = 4
"""Of the loops: a state, its scenarios, their inputs, the boxes of noise."""


class ImageWriter:
    """Writes the operations of some expressions into the loop in which their values change.

    Args:
        arguments: for each symbol the number of the loop, and code for both its ends.
    """

    def __init__(self, arguments: Mapping[sp.Symbol, tuple[int, str]]) -> None:
        self.uses: list[Callable[..., Any]] = []
        self.lines: list[list[str]] = [[] for _ in range(_LEVELS)]
        self._known: dict[Any, tuple[int, str]] = {}
        for symbol, (level, code) in arguments.items():
            self._known[symbol] = level, self._named(level, code)

    def value(self, expression: Any) -> tuple[int, str]:
        """Return the loop in which an expression is at hand, and the name of its interval.

        Raises:
            NotCompilableError: There is no kernel for one of its operations.
        """
        if expression not in self._known:
            self._known[expression] = self._written(expression)
        return self._known[expression]

    def _written(self, expression: Any) -> tuple[int, str]:
        kind, parts = expression.func, expression.args
        if expression.is_number:
            low, high = _enclosure(expression)
            return 0, self._named(0, f"({low!r}, {high!r})")
        if kind in _FOLDED:
            powers = Counter(parts) if kind is sp.Mul else dict.fromkeys(parts, 1)
            operands = [p if n == 1 else sp.Pow(p, n) for p, n in powers.items()]
            # Those that change seldom come first, so that they are put together seldom.
            first, *others = sorted((self.value(p) for p in operands), key=lambda v: v[0])
            for other in others:
                first = self._call(_FOLDED[kind], first, other)
            return first
        if kind is sp.Pow:
            return self._power(*parts)
        if kind in _UNARY:
            return self._call(_UNARY[kind], self.value(parts[0]))
        if kind is sp.atan2:
            return self._call(kernels.ends_angle, *map(self.value, parts))
        raise NotCompilableError(f"there is no kernel for intervals of {kind}")

    def _power(self, base: Any, exponent: Any) -> tuple[int, str]:
        if exponent.is_number and exponent < 0:
            return self._call(kernels.ends_reciprocal, self.value(sp.Pow(base, -exponent)))
        if exponent == sp.Rational(1, 2):
            return self._call(kernels.ends_root, self.value(base))
        if not exponent.is_Integer or exponent > _LONGEST:
            raise NotCompilableError(f"there is no kernel for the power {exponent}")
        if exponent % 2:
            rest = self.value(base) if exponent == 1 else self.value(sp.Pow(base, exponent - 1))
            return (
                rest if exponent == 1 else self._call(kernels.ends_product, rest, self.value(base))
            )
        half = self.value(base if exponent == 2 else sp.Pow(base, exponent / 2))
        return self._call(kernels.ends_square, half)

    def _call(self, kernel: Callable[..., Any], *operands: tuple[int, str]) -> tuple[int, str]:
        if kernel not in self.uses:
            self.uses.append(kernel)
        level = max(operand[0] for operand in operands)
        names = ", ".join(operand[1] for operand in operands)
        return level, self._named(level, f"{kernel.__name__}({names})")

    def _named(self, level: int, code: str) -> str:
        name = f"v{sum(map(len, self.lines))}"
        self.lines[level].append(f"{name} = {code}")
        return name


def image_source(
    symbols: Mapping[str, Sequence[sp.Symbol]],
    rest: Sequence[sp.Expr],
    effect: Sequence[Sequence[sp.Expr]],
) -> Source:
    """Return the kernel `state_images` of a step.

    Args:
        symbols: of "points", "known", "worlds", "noise" and "inputs".
        rest: of each coordinate; see `Step`.
        effect: of each coordinate and input, with neither noise nor inputs.

    Raises:
        NotCompilableError: There is no kernel for one of the operations.
    """
    used = set().union(*(e.free_symbols for e in (*rest, *(e for row in effect for e in row))))
    codes = {
        "points": (0, "(points[{0}, a], points[{0}, a])"),
        "known": (0, "(known[{0}], known[{0}])"),
        "worlds": (1, "(worlds[r, {0}, 0], worlds[r, {0}, 1])"),
        "inputs": (2, "(inputs[b, v, {0}, 0], inputs[b, v, {0}, 1])"),
        "noise": (3, "(low[{0}, w], high[{0}, w])"),
    }
    arguments = {
        symbol: (codes[kind][0], codes[kind][1].format(i))
        for kind, given in symbols.items()
        for i, symbol in enumerate(given)
        if symbol in used
    }
    writer = ImageWriter(arguments)
    moved = [writer.value(e)[1] for e in rest]
    effects = [
        (i, j, writer.value(e)[1]) for i, row in enumerate(effect) for j, e in enumerate(row)
    ]
    lines = writer.lines
    for i, j, name in effects:
        # An infinite effect of an input that is 0 would be no number.
        lines[1].append(f"effects[a, r, {i}, {j}, 0] = max({name}[0], -1e200)")
        lines[1].append(f"effects[a, r, {i}, {j}, 1] = min({name}[1], 1e200)")
    for i, name in enumerate(moved):
        lines[3].append(f"images[a, v, r, w, {i}, 0] = {name}[0]")
        lines[3].append(f"images[a, v, r, w, {i}, 1] = {name}[1]")
    loops = (
        "b = a if inputs.shape[0] > 1 else 0",
        "for r in range(images.shape[2]):",
        "for v in range(images.shape[1]):",
        "for w in range(images.shape[3]):",
    )
    code = ["def state_images(a, points, known, worlds, low, high, inputs, images, effects):"]
    for level, (loop, own) in enumerate(zip(loops, lines, strict=True)):
        code.append("    " * max(level, 1) + loop)
        code += ["    " * (level + 1) + line for line in own]
    return Source("\n".join(code) + "\n", tuple(writer.uses))


def image_function(
    symbols: Mapping[str, Sequence[sp.Symbol]],
    rest: Sequence[sp.Expr],
    effect: Sequence[Sequence[sp.Expr]],
) -> Callable[..., None] | None:
    """Return `point_images` of a step; None without Numba, or without a kernel for an operation.

    Args:
        symbols: see `image_source`, as for all others.
        rest: see there.
        effect: see there.
    """
    if not is_available():
        return None
    try:
        program = Program(
            "steps of states", (kernels.point_images,), image_source(symbols, rest, effect)
        )
        return program.compiled()["point_images"]
    except NotCompilableError:
        return None


def _enclosure(number: Any) -> tuple[float, float]:
    """Return floats around a real number."""
    exact = number.is_Rational or number.is_Float
    value = float(number if exact else sp.N(number, 40))
    if not math.isfinite(value):
        raise NotCompilableError(f"{number} is no finite number")
    if exact and sp.Rational(number) == sp.Rational(value):
        return value, value
    return math.nextafter(value, -math.inf), math.nextafter(value, math.inf)
