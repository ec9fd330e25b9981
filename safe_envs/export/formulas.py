"""Formulas as functions of C, and names and numbers of C."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp
from sympy.codegen.ast import float32, real
from sympy.printing.c import C99CodePrinter
from sympy.printing.codeprinter import PrintMethodNotImplementedError

from safe_envs.dynamics.codegen import excerpt, prepared
from safe_envs.errors import NotCompilableError

_WORDS = (
    "auto break case char const continue default do double else enum extern float for goto if"
    " inline int long register restrict return short signed sizeof static struct switch typedef"
    " union unsigned void volatile while _Bool _Complex _Imaginary bool true false complex"
    " alignas alignof atomic_bool constexpr noreturn nullptr static_assert thread_local typeof"
    # Of C++, so that its programs can read the header.
    " and and_eq asm bitand bitor catch class compl concept const_cast delete dynamic_cast"
    " explicit export friend module mutable namespace new not not_eq operator or or_eq private"
    " protected public reinterpret_cast requires static_cast template this throw try typeid"
    " typename using virtual wchar_t xor xor_eq"
    # Of the headers that are included, and of compilers' own.
    " acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh erf erfc exp exp2 expm1"
    " fabs fdim floor fma fmax fmin fmod frexp hypot ilogb ldexp lgamma log log10 log1p log2 logb"
    " modf nan nearbyint nextafter pow remainder remquo rint round scalbn signbit sin sinh sqrt"
    " tan tanh tgamma trunc isfinite isinf isnan j0 j1 jn y0 y1 yn gamma signgam linux unix near"
    " far main NAN INFINITY NULL"
)
KEYWORDS = frozenset(_WORDS.split())
"""Words that no name of C may be."""
_LONGEST_NAME = 40
_WIDTH = 100
_LARGE = 2**31


def c_name(text: str) -> str:
    """Return a name of C that resembles a text."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")[:_LONGEST_NAME] or "unnamed"
    name = f"n{name}" if name[0].isdigit() else name
    return f"{name}_" if name in KEYWORDS else name


def c_names(texts: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return names of C, all different, in the order of texts.

    Args:
        texts: names that users have given, any texts.
        taken: names that are not free.
    """
    used, names = set(taken), []
    for text in texts:
        stem = name = c_name(text)
        number = 2
        while name in used:
            name, number = f"{stem}_{number}", number + 1
        used.add(name)
        names.append(name)
    return names


def c_comment(text: str) -> str:
    """Return a text on one line that neither ends a comment nor begins one."""
    plain = "".join(c if " " <= c <= "~" else "?" for c in " ".join(text.split()))
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("??/", "?? /").replace("\\", "/")


def c_number(value: float, single: bool) -> str:
    """Return a number as a literal of C, which a compiler reads back exactly.

    Args:
        value: any number.
        single: whether it is of single precision.
    """
    with np.errstate(over="ignore"):
        value = float(np.float32(value)) if single else float(value)
    if math.isnan(value):
        return "(real)NAN"
    if math.isinf(value):
        return "(real)INFINITY" if value > 0 else "-(real)INFINITY"
    return f"{np.float32(value)!s}F" if single else repr(value)


def wrapped(text: str) -> str:
    """Return C with lines of at most 100 characters, as far as they have spaces.

    A compiler need not read lines of more than 4095.
    """
    lines = []
    for line in text.split("\n"):
        indent = " " * (len(line) - len(line.lstrip()) + 4)
        lines += textwrap.wrap(
            line,
            _WIDTH,
            subsequent_indent=indent,
            break_long_words=False,
            break_on_hyphens=False,
        ) or [""]
    return "\n".join(lines)


def formula_function(
    name: str,
    symbols: Sequence[sp.Symbol],
    names: Sequence[str],
    expressions: Sequence[Any],
    single: bool,
) -> str:
    """Return a function `name(given, out)` that writes the values of expressions to `out`.

    Args:
        name: of the function.
        symbols: of the entries of `given`.
        names: of the same in C, all different.
        expressions: real formulas of the symbols.
        single: whether it computes in single precision.

    Raises:
        SystemDefinitionError: An expression has no numerical form; see `compile_function`.
        NotCompilableError: It has none in C.
    """
    formulas = tuple(sp.sympify(e) for e in expressions)
    plain, _, _, (shared, results) = prepared(tuple(symbols), formulas)
    used = {s.name for e in (*results, *(e for _, e in shared)) for s in e.free_symbols}
    temporaries = c_names((f"t{i}" for i in range(len(shared))), names)
    of_c = dict(zip((s.name for s in plain), names, strict=True))
    of_c |= dict(zip((s.name for s, _ in shared), temporaries, strict=True))
    printer = _Printer(of_c, single)
    lines = [
        f"const real {of_c[s.name]} = given[{i}];" for i, s in enumerate(plain) if s.name in used
    ]
    try:
        lines += [f"const real {of_c[s.name]} = {printer.doprint(e)};" for s, e in shared]
        lines += [f"out[{i}] = {printer.doprint(e)};" for i, e in enumerate(results)]
    except PrintMethodNotImplementedError as error:
        raise NotCompilableError(
            f"{excerpt(formulas)} has no form in C: {str(error).splitlines()[0]}"
        ) from error
    lines += ["(void)given;"] * (not any(s.name in used for s in plain))
    body = "\n".join(f"    {line}" for line in lines)
    return wrapped(f"static void {name}(const real *given, real *out)\n{{\n{body}\n}}\n")


class _Printer(C99CodePrinter):
    """Prints kinks as helpers of the core, and roots and powers as Python computes them."""

    def __init__(self, names: Mapping[str, str], single: bool) -> None:
        aliases = {real: float32} if single else {}
        # The macros of <math.h> for constants are no part of C99.
        super().__init__({"type_aliases": aliases, "math_macros": {}, "strict": True})
        self._names, self._single = names, single

    def _print_Symbol(self, expr: Any) -> str:  # noqa: N802  (sympy's dispatch by name)
        return self._names[expr.name]

    def _print_Float(self, flt: Any) -> str:  # noqa: N802
        return c_number(float(flt), self._single)

    def _print_Integer(self, expr: Any) -> str:  # noqa: N802
        return str(expr) if abs(expr) < _LARGE else self._print_Float(expr)

    def _print_Rational(self, expr: Any) -> str:  # noqa: N802
        return f"{c_number(expr.p, self._single)}/{c_number(expr.q, self._single)}"

    _constant: Any = _print_Float
    _print_Pi = _print_Exp1 = _print_NumberSymbol = _constant  # noqa: N815
    _print_NaN = _print_Infinity = _print_NegativeInfinity = _constant  # noqa: N815

    def _print_Pow(self, expr: Any) -> str:  # noqa: N802
        suffix = "f" if self._single else ""
        if expr.exp == sp.Rational(1, 3):  # of a negative number it is none in Python
            return f"pow{suffix}({self._print(expr.base)}, {self._print_Rational(expr.exp)})"
        if expr.exp == -sp.S.Half:
            return f"(1/sqrt{suffix}({self._print(expr.base)}))"
        return super()._print_Pow(expr)

    def _print_And(self, expr: Any) -> str:  # noqa: N802
        return f"({super()._print_And(expr)})"  # compilers ask for these in an Or

    def _print_Piecewise(self, expr: Any) -> str:  # noqa: N802
        last = expr.args[-1].cond == sp.true
        return super()._print_Piecewise(expr if last else sp.Piecewise(*expr.args, (sp.nan, True)))

    def _nested(self, name: str, expr: Any) -> str:
        code, *others = (self._print(argument) for argument in expr.args)
        for other in others:
            code = f"{name}({code}, {other})"
        return code

    def _print_Max(self, expr: Any) -> str:  # noqa: N802
        return self._nested("maximum", expr)

    def _print_Min(self, expr: Any) -> str:  # noqa: N802
        return self._nested("minimum", expr)

    def _print_Mod(self, expr: Any) -> str:  # noqa: N802
        return self._nested("modulo", expr)

    def _print_sign(self, func: Any) -> str:
        return f"sign({self._print(func.args[0])})"
