"""From expressions of kernels to expressions of C, with the same operations in the same order."""

from __future__ import annotations

import ast
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from safe_envs.errors import NotCompilableError
from safe_envs.wrappers.export.c_context import CContext
from safe_envs.wrappers.export.c_numbers import CONSTANTS
from safe_envs.wrappers.export.kinds import (
    BITS,
    BOTH,
    CHOICE,
    EITHER,
    EQUAL,
    NUMBERS,
    ORDER,
    PRODUCT,
    REAL,
    SCALARS,
    SHIFT,
    SUM,
    TABLE,
    TRUTH,
    UNARY,
    VECTOR,
    WHOLE,
    Kind,
    Result,
    Text,
    common,
)

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


class Operators:
    """Translates the expressions of one function, but for calls.

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
