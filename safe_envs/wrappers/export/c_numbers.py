"""Numbers and functions of C, in double or in single precision."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from safe_envs.errors import NotCompilableError

_COARSER = 2.0**29
"""How many times coarser single precision is."""
_LEAST, _TINY, _FAR, _HUGE = 1e-200, 1e-9, 1e100, 1e300
_FAR_SINGLE = 1e18
"""A number whose square is far off and does not overflow in single precision."""


@dataclass(frozen=True)
class Precision:
    """How numbers are written.

    Attributes:
        type: "double" or "float".
    """

    type: str

    @property
    def is_single(self) -> bool:
        """Whether it is single precision."""
        return self.type == "float"

    def number(self, value: float) -> str:
        """Return a number as a literal of C, which a compiler reads back exactly.

        Args:
            value: any number.
        """
        # The macros are of type float.
        cast = "" if self.is_single else "(double)"
        if math.isnan(value):
            return f"{cast}NAN"
        rounded = float(np.float32(value)) if self.is_single else value
        if math.isinf(rounded):
            return f"{cast}INFINITY" if rounded > 0 else f"-{cast}INFINITY"
        digits = str(np.float32(value)) if self.is_single else repr(float(value))
        digits = digits if any(c in digits for c in ".e") else f"{digits}.0"
        return f"{digits}f" if self.is_single else digits

    def tolerance(self, value: float) -> float:
        """Return a constant of a solver for this precision.

        Parts that rounding leaves are as many times coarser as the numbers are, the largest
        number stands for infinity, and the least one for nothing.

        Args:
            value: in double precision.
        """
        size = abs(value)
        if not self.is_single or value == 0.0:
            return value
        if size < _LEAST:
            return math.copysign(float(np.finfo(np.float32).tiny), value)
        if size < _TINY:
            return value * _COARSER
        if size > _HUGE:
            return math.copysign(float(np.finfo(np.float32).max), value)
        return math.copysign(_FAR_SINGLE, value) if size >= _FAR else value

    def function(self, name: str) -> str:
        """Return a function of <math.h>."""
        return f"{name}f" if self.is_single else name


DOUBLE, SINGLE = Precision("double"), Precision("float")

MATH = {
    **{name: name for name in ("acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh")},
    **{name: name for name in ("copysign", "cos", "cosh", "erf", "erfc", "exp", "expm1")},
    **{name: name for name in ("hypot", "log", "log10", "log1p", "log2", "pow", "sin", "sinh")},
    **{name: name for name in ("sqrt", "tan", "tanh", "fabs")},
    "floor": "floor",
    "ceil": "ceil",
    "fmod": "fmod",
    # The compiled engine has its own, which differ from these by rounding.
    "sine": "sin",
    "cosine": "cos",
    "arc_tangent": "atan2",
}
"""Functions of a filter that <math.h> has, and their names there."""

CONSTANTS = {"pi": math.pi, "e": math.e, "inf": math.inf, "nan": math.nan, "tau": math.tau}
"""Constants of Python's module `math`."""

HELPERS = {
    "larger": (
        "Return the larger one of two numbers; the first where they cannot be compared.",
        "static real larger(real a, real b)\n{\n    return b > a ? b : a;\n}",
    ),
    "smaller": (
        "Return the smaller one of two numbers; the first where they cannot be compared.",
        "static real smaller(real a, real b)\n{\n    return b < a ? b : a;\n}",
    ),
    "larger_count": (
        "Return the larger one of two counts.",
        "static int larger_count(int a, int b)\n{\n    return b > a ? b : a;\n}",
    ),
    "smaller_count": (
        "Return the smaller one of two counts.",
        "static int smaller_count(int a, int b)\n{\n    return b < a ? b : a;\n}",
    ),
    "remainder_of": (
        "Return a less the largest multiple of b below it; it has the sign of b.",
        (
            "static real remainder_of(real a, real b)\n{\n    const real rest = fmod(a, b);\n"
            "    return rest != 0 && (rest < 0) != (b < 0) ? rest + b : rest;\n}"
        ),
    ),
    "vector_view": (
        "Return entries of a scratch array.",
        (
            "static vector vector_view(vector whole, int first, int count)\n{\n"
            "    const vector view = {whole.at + first, count};\n    return view;\n}"
        ),
    ),
    "table_view": (
        "Return entries of a scratch array with two indices.",
        (
            "static table table_view(vector whole, int first, int height, int width)\n{\n"
            "    const table view = {whole.at + first, height, width};\n    return view;\n}"
        ),
    ),
}
"""Functions that C lacks: what they do, and their text."""


def require_known(name: str) -> str:
    """Return a function's name in <math.h>.

    Raises:
        NotCompilableError: There is none.
    """
    if name not in MATH:
        raise NotCompilableError(f"the function {name} has no form in C")
    return MATH[name]
