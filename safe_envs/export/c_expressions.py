"""From expressions of kernels to expressions of C, with the same operations in the same order."""

from __future__ import annotations

import ast
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from safe_envs.engine.formulas import Source
from safe_envs.engine.oldqp.rounding import ROUNDING
from safe_envs.engine.program import definitions
from safe_envs.engine.slots import Data
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


@dataclass(frozen=True)
class Kind:
    """The kind of a value.

    Attributes:
        type: its type in C; "" for a function that returns nothing.
        size: entries of a tuple of numbers.
    """

    type: str
    size: int = 0


REAL = Kind("real")
"""A number; `real` stands for double or float."""
WHOLE = Kind("int")
TRUTH = Kind("bool")
VECTOR = Kind("vector")
"""Entries of a scratch array, to be read and written."""
TABLE = Kind("table")
"""The same with two indices."""
NUMBERS = Kind("numbers")
"""Entries that are only read: a state, an input, constants."""
FLOATS = Kind("floats")
"""A table that is only read, in single precision whatever the precision of the numbers is."""
NOTHING = Kind("")

SCALARS = (REAL, WHOLE, TRUTH)


def tuple_of(size: int) -> Kind:
    """Return the kind of a tuple of numbers, a struct with one array."""
    return Kind(f"numbers_{size}", size)


@dataclass(frozen=True)
class Struct:
    """The kind of a function's result that has parts of several kinds, a struct.

    Attributes:
        type: its type in C.
        fields: their names and kinds.
    """

    type: str
    fields: tuple[tuple[str, Kind], ...]
    size: int = 0


Result = Kind | Struct


@dataclass(frozen=True)
class Text:
    """An expression of C.

    Attributes:
        code: its text.
        kind: of its value.
        level: how tightly its operator binds, as in `LEVELS`.
    """

    code: str
    kind: Result
    level: int = 16

    def inside(self, level: int) -> str:
        """Return the text, in parentheses where its operator binds less tightly than a level."""
        return self.code if self.level >= level else f"({self.code})"


ATOM, UNARY, PRODUCT, SUM, SHIFT, ORDER, EQUAL, BITS, BOTH, EITHER, CHOICE = (
    *(16, 14, 13, 12, 11, 10),
    *(9, 8, 4, 3, 2),
)


def common(first: Result, second: Result) -> Result | None:
    """Return the kind that holds values of two kinds; None if there is none.

    Args:
        first: a kind.
        second: another one.
    """
    if first == second:
        return first
    if first in SCALARS and second in SCALARS:
        return REAL if REAL in (first, second) else WHOLE
    return None


@dataclass(frozen=True)
class CFunction:
    """A function of C.

    Attributes:
        name: its name.
        kinds: of its parameters, as its source states them.
        used: which parameters it takes; the others have no effect.
        result: kind of what it returns.
        text: its definition.
    """

    name: str
    kinds: tuple[Result, ...]
    used: tuple[bool, ...]
    result: Result
    text: str


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
"""Words that no variable may have for a name."""

OWN = frozenset(
    [
        "real",
        "vector",
        "table",
        "numbers",
        "data",
        "work",
        "larger",
        "smaller",
        "part",
        "found",
        "input",
        "result",
    ]
)
"""Words that the generated code uses itself."""

_LONGEST = 40


def c_name(text: str) -> str:
    """Return a name of C that resembles a text."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")[:_LONGEST] or "unnamed"
    name = f"n{name}" if name[0].isdigit() else name
    return f"{name}_" if name in KEYWORDS else name


def c_names(texts: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return names of C, all different, in the order of texts.

    Args:
        texts: names that users have given, any texts.
        taken: names that are not free.
    """
    used, found = set(taken), []
    for text in texts:
        stem = name = c_name(text)
        number = 2
        while name in used:
            name, number = f"{stem}_{number}", number + 1
        used.add(name)
        found.append(name)
    return found


def comment(text: str) -> str:
    """Return a text on one line that neither ends a comment nor begins one."""
    plain = "".join(c if " " <= c <= "~" else "?" for c in " ".join(text.split()))
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("??/", "?? /").replace("\\", "/")


_GIVEN = re.compile(r"a[0-9]{3,}")
"""Names of symbols in generated formulas."""

_ARGUMENTS = {"x": "states", "u": "inputs"}
"""What arguments of generated formulas are called, so that states may be called x."""

_OF_TYPES = {"vector", "table", "numbers", "floats"}


class CContext(ABC):
    """Names, constants and types that the functions of a program share.

    Args:
        source: `decide`, and what it calls.
        data: numbers of the source.
        precision: of the numbers.
        symbols: by argument of the generated formulas, the names of C of its entries.

    Attributes:
        definitions: the functions in Python.
    """

    def __init__(
        self,
        source: Source,
        data: Data,
        precision: Precision,
        symbols: Mapping[str, Sequence[str]],
    ) -> None:
        self.definitions = definitions([], source)
        self.precision = precision
        self._data = data.array()
        self._symbols = symbols
        self._tuples: dict[int, Kind] = {}
        self._records: dict[str, Struct] = {}
        self._helpers: list[str] = []
        self._constants: dict[str, str] = {}
        self._of_constants: dict[str, Kind] = {}

    @abstractmethod
    def function(self, name: str, kinds: Sequence[Result]) -> CFunction:
        """Return a function for arguments of given kinds, translated once.

        Args:
            name: of the function.
            kinds: of its arguments.

        Raises:
            NotCompilableError: It has no form in C, or is called with arguments of other kinds.
        """

    def function_name(self, node: ast.FunctionDef) -> str:
        """Return the name of a function in C."""
        return node.name

    def local_name(self, name: str) -> str:
        """Return the name of a variable in C."""
        taken = name in KEYWORDS or name in HELPERS or name in _OF_TYPES
        return f"{name}_" if taken or name in self.definitions.functions else name

    def names_in(self, node: ast.FunctionDef) -> dict[str, str]:
        """Return what the symbols of a generated formula are called."""
        found: dict[str, str] = {}
        for each in node.body:
            match each:
                case ast.Assign(
                    targets=[ast.Name(id=name)],
                    value=ast.Subscript(
                        value=ast.Name(id=argument), slice=ast.Constant(value=int(i))
                    ),
                ) if _GIVEN.fullmatch(name) and argument in self._symbols:
                    found[name] = self._symbols[argument][i]
        if not found:
            return {}
        arguments = {a.arg: _ARGUMENTS.get(a.arg, a.arg) for a in node.args.args}
        own = {e.id for e in ast.walk(node) if isinstance(e, ast.Name)} - set(found)
        own = (own - set(arguments)) | set(arguments.values())
        taken = own | KEYWORDS | OWN | set(HELPERS) | set(MATH)
        return dict(zip(found, c_names(found.values(), taken), strict=True)) | arguments

    def names_of_results(self, name: str) -> dict[int, str]:
        """Return what callers of a function call the parts of its result, by their place."""
        found: dict[int, str] = {}
        for function in self.definitions.functions.values():
            for each in ast.walk(function):
                match each:
                    case ast.Assign(
                        targets=[ast.Tuple(elts=targets)],
                        value=ast.Call(func=ast.Name(id=called)),
                    ) if called == name:
                        for i, target in enumerate(targets):
                            if isinstance(target, ast.Name) and target.id != "_":
                                found.setdefault(i, target.id)
        return found

    def constant(self, name: str) -> Text:
        """Return a constant of a kernel module.

        Raises:
            NotCompilableError: There is none of that name.
        """
        node = self.definitions.constants.get(name)
        if not isinstance(node, ast.Assign):
            raise NotCompilableError(f"the name {name} has no form in C")
        if name not in self._constants:
            value = _evaluated(node.value)
            kind = WHOLE if isinstance(value, int) else REAL
            digits = (
                str(value)
                if kind == WHOLE
                else self.precision.number(self.precision.tolerance(value))
            )
            type_of = "int" if kind == WHOLE else self.precision.type
            self._constants[name] = f"static const {type_of} {name} = {digits};"
            self._of_constants[name] = kind
        return Text(name, self._of_constants[name])

    def data_entry(self, node: ast.Subscript) -> str | None:
        """Return the digits of a number of the program; None for anything else."""
        match node:
            case ast.Subscript(value=ast.Name(id="data"), slice=ast.Constant(value=int(i))):
                return self.precision.number(self.single_tolerance(float(self._data[i])))
        return None

    def single_tolerance(self, value: float) -> float:
        """Return a number of the program; in formulas rounding is that of the precision."""
        return self.precision.tolerance(value) if value == ROUNDING else value

    def helper(self, name: str) -> str:
        """Return the name of a function that C lacks, which is defined then."""
        if name not in self._helpers:
            self._helpers.append(name)
        return name

    def need_tuple(self, kind: Kind) -> None:
        """Define the struct of a tuple."""
        self._tuples[kind.size] = kind

    def need_record(self, record: Struct) -> None:
        """Define the struct of a result."""
        self._records[record.type.removesuffix("_result")] = record


def _evaluated(node: ast.expr) -> float | int:
    """Return the value of a constant's expression, of literals, products and powers."""
    match node:
        case ast.Constant(value=int() | float() as value):
            return value
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            return _evaluated(left) ** _evaluated(right)
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return _evaluated(left) * _evaluated(right)
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _evaluated(left) + _evaluated(right)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_evaluated(operand)
    raise NotCompilableError(f"the constant {ast.unparse(node)} has no form in C")


_ARITHMETIC: dict[type[ast.operator], tuple[str, int]] = {
    ast.Add: ("+", SUM),
    ast.Sub: ("-", SUM),
    ast.Mult: ("*", PRODUCT),
    ast.Div: ("/", PRODUCT),
}
_WHOLE_ARITHMETIC: dict[type[ast.operator], tuple[str, int]] = {
    ast.LShift: ("<<", SHIFT),
    ast.RShift: (">>", SHIFT),
    ast.BitAnd: ("&", BITS),
    ast.Mod: ("%", PRODUCT),
}
_COMPARISONS: dict[type[ast.cmpop], tuple[str, int]] = {
    ast.Lt: ("<", ORDER),
    ast.LtE: ("<=", ORDER),
    ast.Gt: (">", ORDER),
    ast.GtE: (">=", ORDER),
    ast.Eq: ("==", EQUAL),
    ast.NotEq: ("!=", EQUAL),
}


def unknown(node: ast.AST) -> NoReturn:
    """Raise NotCompilableError for something that has no form in C."""
    raise NotCompilableError(f"{ast.unparse(node)[:80]!r} has no form in C")


class Expressions:
    """Translates the expressions of one function.

    Args:
        program: that the function belongs to.
        kinds: of its variables, which the statements extend.

    Attributes:
        before: statements that have to come before the expression at hand.
        read: names of variables that were read.
    """

    def __init__(self, program: CContext, kinds: dict[str, Result]) -> None:
        self._program, self.kinds = program, kinds
        self.before: list[str] = []
        self.read: set[str] = set()
        self.columns: dict[str, int] = {}
        self.names: dict[str, str] = {}
        self._parts = 0

    def name_of(self, name: str) -> str:
        """Return the name of a variable in C."""
        return self.names.get(name) or self._program.local_name(name)

    def text(self, node: ast.expr) -> Text:
        """Translate an expression.

        Raises:
            NotCompilableError: It has no form in C.
        """
        method: Callable[[Any], Text] | None = getattr(self, f"_{type(node).__name__}", None)
        return method(node) if method else unknown(node)

    def real(self, node: ast.expr, level: int = 0) -> str:
        """Translate an expression to a number.

        Args:
            node: the expression.
            level: how tightly it has to bind.

        Returns:
            Its text.
        """
        return self.as_real(self.text(node)).inside(level)

    def as_real(self, found: Text) -> Text:
        """Turn a whole number or a truth value into a number.

        Raises:
            NotCompilableError: It is none.
        """
        if found.kind == REAL:
            return found
        if found.kind not in SCALARS:
            raise NotCompilableError(f"{found.code} is no number in C")
        if found.kind == WHOLE and found.code.lstrip("-").isdigit():
            return Text(self._program.precision.number(float(found.code)), REAL, found.level)
        return Text(f"({self._program.precision.type}){found.inside(UNARY)}", REAL, UNARY)

    def converted(self, found: Text, kind: Result) -> Text:
        """Turn a value into one of a kind.

        Args:
            found: the value.
            kind: what it is to be.

        Returns:
            Its text.
        """
        if kind == REAL:
            return self.as_real(found)
        if kind == TRUTH and found.kind == WHOLE:
            return Text(f"{found.inside(EQUAL + 1)} != 0", TRUTH, EQUAL)
        return found

    def condition(self, node: ast.expr) -> Text:
        """Translate an expression to a truth value."""
        found = self.text(node)
        if found.kind == REAL:
            return Text(f"{found.inside(EQUAL + 1)} != 0", TRUTH, EQUAL)
        return self.converted(found, TRUTH)

    def argument(self, found: Text) -> Text:
        """Return a tuple as numbers that a function reads."""
        if isinstance(found.kind, Kind) and found.kind.size:
            if not found.code.isidentifier():
                found = Text(self.part(found), found.kind)
            return Text(f"(numbers){{{found.code}.at, {found.kind.size}}}", NUMBERS)
        return found

    def part(self, found: Text) -> str:
        """Evaluate a tuple before the statement at hand, and return the name of the result."""
        name = self._fresh()
        self.before.append(f"const {found.kind.type} {name} = {found.code};")
        return name

    def _fresh(self) -> str:
        self._parts += 1
        return f"part_{self._parts}"

    def entries(self, node: ast.expr) -> list[Text] | None:
        """Return the entries of a tuple that is written out, or of a sum of tuples."""
        if isinstance(node, ast.Tuple):
            return [self.text(e) for e in node.elts]
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            parts = [self._entries_of_part(side) for side in (node.left, node.right)]
            if parts[0] is not None and parts[1] is not None:
                return [*parts[0], *parts[1]]
        return None

    def _entries_of_part(self, node: ast.expr) -> list[Text] | None:
        written = self.entries(node)
        if written is not None:
            return written
        if not isinstance(node, ast.Call):
            return None
        found = self.text(node)
        if not (isinstance(found.kind, Kind) and found.kind.size):
            return None
        name = self.part(found)
        return [Text(f"{name}.at[{i}]", REAL) for i in range(found.kind.size)]

    def _Constant(self, node: ast.Constant) -> Text:  # noqa: N802  (named like the node)
        value = node.value
        if isinstance(value, bool | int):
            return Text(str(value).lower(), TRUTH if isinstance(value, bool) else WHOLE)
        if isinstance(value, float):
            return Text(self._program.precision.number(value), REAL)
        return unknown(node)

    def _Name(self, node: ast.Name) -> Text:  # noqa: N802
        name = node.id
        if name in self.kinds:
            self.read.add(name)
            return Text(self.name_of(name), self.kinds[name])
        if name in CONSTANTS:
            return Text(self._program.precision.number(CONSTANTS[name]), REAL)
        return self._program.constant(name)

    def _UnaryOp(self, node: ast.UnaryOp) -> Text:  # noqa: N802
        if isinstance(node.op, ast.Not):
            return Text(f"!{self.condition(node.operand).inside(UNARY)}", TRUTH, UNARY)
        if not isinstance(node.op, ast.USub):
            return unknown(node)
        found = self.text(node.operand)
        inner = found.inside(UNARY)
        inner = f"({inner})" if inner.startswith("-") else inner
        return Text(f"-{inner}", found.kind, UNARY)

    def _BinOp(self, node: ast.BinOp) -> Text:  # noqa: N802
        left, right = self.text(node.left), self.text(node.right)
        if isinstance(node.op, ast.Pow):
            power = self._program.precision.function("pow")
            return Text(f"{power}({self.as_real(left).code}, {self.as_real(right).code})", REAL)
        whole = left.kind == right.kind == WHOLE
        if type(node.op) in _WHOLE_ARITHMETIC and whole:
            sign, level = _WHOLE_ARITHMETIC[type(node.op)]
            # Compilers ask for parentheses around sums in shifts and shifts in masks.
            left, right = (
                Text(t.code, WHOLE, t.level if t.level >= UNARY else 0) for t in (left, right)
            )
            return Text(f"{left.inside(level)} {sign} {right.inside(level + 1)}", WHOLE, level)
        if isinstance(node.op, ast.Mod):
            of = self._program.helper("remainder_of")
            return Text(f"{of}({self.as_real(left).code}, {self.as_real(right).code})", REAL)
        if type(node.op) not in _ARITHMETIC:
            return unknown(node)
        sign, level = _ARITHMETIC[type(node.op)]
        if not whole or sign == "/":
            left, right, whole = self.as_real(left), self.as_real(right), False
        code = f"{left.inside(level)} {sign} {right.inside(level + 1)}"
        return Text(code, WHOLE if whole else REAL, level)

    def _BoolOp(self, node: ast.BoolOp) -> Text:  # noqa: N802
        sign, level = ("&&", BOTH) if isinstance(node.op, ast.And) else ("||", EITHER)
        # Compilers ask for parentheses around one of them in the other.
        parts = [self.condition(value).inside(EQUAL) for value in node.values]
        return Text(f" {sign} ".join(parts), TRUTH, level)

    def _Compare(self, node: ast.Compare) -> Text:  # noqa: N802
        values = [self.text(each) for each in (node.left, *node.comparators)]
        if any(v.kind == REAL for v in values):
            values = [self.as_real(v) for v in values]
        parts: list[str] = []
        for k, op in enumerate(node.ops):
            sign, _ = _COMPARISONS[type(op)]
            # Compilers ask for parentheses around a comparison in another one.
            parts.append(f"{values[k].inside(SHIFT)} {sign} {values[k + 1].inside(SHIFT)}")
        if len(parts) == 1:
            return Text(parts[0], TRUTH, _COMPARISONS[type(node.ops[0])][1])
        return Text(" && ".join(parts), TRUTH, BOTH)

    def _IfExp(self, node: ast.IfExp) -> Text:  # noqa: N802
        test, body, other = self.condition(node.test), self.text(node.body), self.text(node.orelse)
        kind = common(body.kind, other.kind)
        if kind is None:
            return unknown(node)
        body, other = self.converted(body, kind), self.converted(other, kind)
        code = f"{test.inside(CHOICE + 1)} ? {body.inside(CHOICE + 1)} : {other.inside(CHOICE)}"
        return Text(code, kind, CHOICE)

    def _Subscript(self, node: ast.Subscript) -> Text:  # noqa: N802
        floats = node.value
        if isinstance(floats, ast.Name) and self.kinds.get(floats.id) == FLOATS:
            code = f"{self.text(floats).code}.at[{self.text(node.slice).code}]"
            return Text(f"({self._program.precision.type}){code}", REAL, UNARY)
        constant = self._program.data_entry(node)
        if constant is not None:
            return Text(constant, REAL, UNARY if constant.startswith("-") else 16)
        if isinstance(node.value, ast.Attribute) and node.value.attr == "shape":
            return self._extent(node)
        whole = self.text(node.value)
        if whole.kind == TABLE and isinstance(node.slice, ast.Tuple):
            return Text(f"{whole.code}.at[{self._place(whole.code, node.slice.elts)}]", REAL)
        index = self.text(node.slice)
        indexed = whole.kind in (VECTOR, NUMBERS) or whole.kind.size > 0
        if index.kind != WHOLE or not indexed:
            return unknown(node)
        return Text(f"{whole.code}.at[{index.code}]", REAL)

    def _place(self, name: str, indices: Sequence[ast.expr]) -> str:
        """Return the place of an entry of a table."""
        row, column = (self.text(each) for each in indices)
        if row.code.isdigit() and column.code.isdigit() and name in self.columns:
            return str(int(row.code) * self.columns[name] + int(column.code))
        if row.code == "0":
            return column.code
        if column.code == "0":
            return f"{row.inside(PRODUCT)} * {name}.width"
        return f"{row.inside(PRODUCT)} * {name}.width + {column.inside(SUM + 1)}"

    def _extent(self, node: ast.Subscript) -> Text:
        assert isinstance(node.value, ast.Attribute)
        whole = self.text(node.value.value)
        axis = ("height", "width")[ast.literal_eval(node.slice)]
        return Text(f"{whole.code}.{axis}", WHOLE) if whole.kind == TABLE else unknown(node)

    def _Tuple(self, node: ast.Tuple) -> Text:  # noqa: N802
        inner = ", ".join(self.real(each) for each in node.elts)
        name = self._fresh()
        self.before.append(f"const {self._program.precision.type} {name}[] = {{{inner}}};")
        return Text(f"(numbers){{{name}, {len(node.elts)}}}", NUMBERS)

    def _Call(self, node: ast.Call) -> Text:  # noqa: N802
        if not isinstance(node.func, ast.Name) or node.keywords:
            return unknown(node)
        name, arguments = node.func.id, node.args
        method: Callable[[Sequence[ast.expr]], Text] | None = getattr(self, f"_call_{name}", None)
        if method:
            return method(arguments)
        if name in self._program.definitions.functions and name not in MATH:
            return self._call_function(name, arguments)
        function = self._program.precision.function(require_known(name))
        return Text(f"{function}({', '.join(self.real(each) for each in arguments)})", REAL)

    def _call_function(self, name: str, arguments: Sequence[ast.expr]) -> Text:
        given: list[Text] = []
        read: list[set[str]] = []
        before, self.read = self.read, set()
        for each in arguments:
            given.append(self.argument(self.text(each)))
            read.append(self.read)
            self.read = set()
        function = self._program.function(name, [each.kind for each in given])
        # What has no effect is not handed over.
        self.read = before.union(*(r for r, used in zip(read, function.used, strict=True) if used))
        texts = [
            self.converted(text, kind).code
            for text, kind, used in zip(given, function.kinds, function.used, strict=True)
            if used
        ]
        return Text(f"{function.name}({', '.join(texts)})", function.result)

    def _call_float(self, arguments: Sequence[ast.expr]) -> Text:
        return self.as_real(self.text(arguments[0]))

    def _call_int(self, arguments: Sequence[ast.expr]) -> Text:
        return Text(f"(int){self.text(arguments[0]).inside(UNARY)}", WHOLE, UNARY)

    def _call_abs(self, arguments: Sequence[ast.expr]) -> Text:
        return Text(f"{self._program.precision.function('fabs')}({self.real(arguments[0])})", REAL)

    def _call_isfinite(self, arguments: Sequence[ast.expr]) -> Text:
        return Text(f"isfinite({self.real(arguments[0])})", WHOLE)

    def _call_len(self, arguments: Sequence[ast.expr]) -> Text:
        whole = self.text(arguments[0])
        if whole.kind == TABLE:
            return Text(f"{whole.code}.height", WHOLE)
        return (
            Text(f"{whole.code}.size", WHOLE)
            if whole.kind in (VECTOR, NUMBERS)
            else unknown(arguments[0])
        )

    def _call_max(self, arguments: Sequence[ast.expr]) -> Text:
        return self._nested("larger", arguments)

    def _call_min(self, arguments: Sequence[ast.expr]) -> Text:
        return self._nested("smaller", arguments)

    def _nested(self, helper: str, arguments: Sequence[ast.expr]) -> Text:
        texts = [self.text(each) for each in arguments]
        if all(t.kind == WHOLE for t in texts):
            helper, kind = f"{helper}_count", WHOLE
        else:
            texts, kind = [self.as_real(t) for t in texts], REAL
        found, name = texts[0], self._program.helper(helper)
        for text in texts[1:]:
            found = Text(f"{name}({found.code}, {text.code})", kind)
        return found

    def _call_vector_view(self, arguments: Sequence[ast.expr]) -> Text:
        return self._view("vector_view", arguments, VECTOR)

    def _call_table_view(self, arguments: Sequence[ast.expr]) -> Text:
        return self._view("table_view", arguments, TABLE)

    def _view(self, helper: str, arguments: Sequence[ast.expr], kind: Kind) -> Text:
        inner = ", ".join(self.text(each).code for each in arguments)
        return Text(f"{self._program.helper(helper)}({inner})", kind)
