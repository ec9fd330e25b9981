"""SymPy's printers of Python code, corrected: floats and arrays give the same values."""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy as sp
from sympy.printing.numpy import NumPyPrinter
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.pycode import PythonCodePrinter

SUPPORTED = (
    *(
        sp.sin,
        sp.cos,
        sp.tan,
        sp.cot,
        sp.sec,
        sp.csc,
        sp.asin,
        sp.acos,
        sp.atan,
        sp.atan2,
        sp.acot,
        sp.asec,
        sp.acsc,
        sp.sinc,
    ),
    *(
        sp.sinh,
        sp.cosh,
        sp.tanh,
        sp.coth,
        sp.sech,
        sp.csch,
        sp.asinh,
        sp.acosh,
        sp.atanh,
        sp.exp,
        sp.log,
        sp.erf,
        sp.erfc,
    ),
    *(sp.Abs, sp.sign, sp.Heaviside, sp.Piecewise, sp.floor, sp.ceiling, sp.frac, sp.Mod),
)
"""Functions that have the same values as floats and as arrays, in addition to sums, products,
powers, Max and Min."""

_BASE = sp.Symbol("_base_of_a_power_")

_SETTINGS = {
    "fully_qualified_modules": False,
    "inline": True,
    "allow_unknown_functions": False,
    "strict": True,
}


class FloatPrinter(PythonCodePrinter):
    """Prints code that raises or gives NaN where Python gives a complex number or None."""

    def __init__(self) -> None:
        super().__init__(_SETTINGS)

    def _print_Pow(self, expr: Any, rational: bool = False) -> str:  # noqa: N802  (sympy's dispatch by name)
        if expr.exp.is_integer or abs(expr.exp) == sp.S.Half:
            return super()._print_Pow(expr, rational)
        return f"pow({self._print(expr.base)}, {self._print(expr.exp)})"

    def _print_Piecewise(self, expr: Any) -> Any:  # noqa: N802
        return super()._print_Piecewise(
            expr if expr.args[-1].cond == sp.true else sp.Piecewise(*expr.args, (sp.nan, True))
        )

    def _print_Mod(self, expr: Any) -> str:  # noqa: N802
        return f"({super()._print_Mod(expr)})"


class ArrayPrinter(NumPyPrinter):
    """Prints Min and Max as nested binary ufuncs, and names the constants.

    Attributes:
        constants: arrays without axes by name: see `constants`.
    """

    def __init__(self) -> None:
        super().__init__(_SETTINGS)
        self.constants: dict[str, np.ndarray] = {}

    def _named_constant(self, expr: Any) -> str:
        name = f"_c{len(self.constants)}"
        self.constants[name] = np.array(float(expr))
        return name

    def _as_ordered_terms(self, expr: Any, order: str | None = None) -> list[Any]:
        # A sum that begins with a negative term would cost a negation of its own.
        return sorted(
            super()._as_ordered_terms(expr, order), key=lambda term: term.could_extract_minus_sign()
        )

    _print_Float = _print_Integer = _print_Rational = _print_Pi = _named_constant  # noqa: N815

    def _print_Pow(self, expr: Any, rational: bool = False) -> str:  # noqa: N802  (sympy's dispatch by name)
        if not expr.exp.is_number:
            return super()._print_Pow(expr, rational)
        # NumPy's power has short cuts for exponents that are literal. The base is printed here: in
        # it Max and Min may stand.
        code = NumPyPrinter(_SETTINGS)._print_Pow(sp.Pow(_BASE, expr.exp, evaluate=False), rational)
        return code.replace(_BASE.name, self.parenthesize(expr.base, PRECEDENCE["Pow"]))

    def _nested(self, function: str, expression: Any) -> str:
        first, *others = expression.args
        code = self._print(first)
        for argument in others:
            code = f"{self._module_format('numpy.' + function)}({code}, {self._print(argument)})"
        return code

    def _print_Max(self, expr: Any) -> str:  # noqa: N802
        return self._nested("maximum", expr)

    def _print_Min(self, expr: Any) -> str:  # noqa: N802
        return self._nested("minimum", expr)
