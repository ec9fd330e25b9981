"""From calls and entries of tables in kernels to those in C."""

from __future__ import annotations

import ast
from collections.abc import Callable, Sequence

from safe_envs.wrappers.export.c_expressions import Operators, unknown
from safe_envs.wrappers.export.c_numbers import require_known
from safe_envs.wrappers.export.kinds import (
    FLOATS,
    NUMBERS,
    REAL,
    TABLE,
    UNARY,
    VECTOR,
    WHOLE,
    Kind,
    Text,
)


class Expressions(Operators):
    """Translates the expressions of one function."""

    def _Subscript(self, node: ast.Subscript) -> Text:  # noqa: N802
        whole = node.value
        if not (isinstance(whole, ast.Name) and self.kinds.get(whole.id) == FLOATS):
            return super()._Subscript(node)
        code = f"{self.text(whole).code}.at[{self.text(node.slice).code}]"
        return Text(f"({self._program.precision.type}){code}", REAL, UNARY)

    def _Call(self, node: ast.Call) -> Text:  # noqa: N802
        if not isinstance(node.func, ast.Name) or node.keywords:
            return unknown(node)
        name, arguments = node.func.id, node.args
        method: Callable[[Sequence[ast.expr]], Text] | None = getattr(self, f"_call_{name}", None)
        if method:
            return method(arguments)
        if name in self._program.definitions.functions and not self._program.is_library(name):
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
