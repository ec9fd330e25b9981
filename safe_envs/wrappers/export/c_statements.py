"""From the functions of kernels to functions of C."""

from __future__ import annotations

import ast
from collections.abc import Sequence

from safe_envs.wrappers.export.c_assignments import INDENT, Assignments
from safe_envs.wrappers.export.c_calls import Expressions
from safe_envs.wrappers.export.c_expressions import unknown
from safe_envs.wrappers.export.kinds import (
    NOTHING,
    NUMBERS,
    REAL,
    SUM,
    TRUTH,
    WHOLE,
    CFunction,
    Kind,
    Text,
)

_ZERO = {REAL: "0", WHOLE: "0", TRUTH: "false"}
_IN_PLACE = {ast.Add: "+=", ast.Sub: "-=", ast.Mult: "*=", ast.Div: "/="}


class FunctionTranslator(Assignments):
    """Translates one function, for parameters of given kinds.

    Args:
        program: that it belongs to.
        node: the function.
        kinds: of its parameters.
    """

    def translated(self) -> CFunction:
        """Return the function in C.

        Raises:
            NotCompilableError: Something in it has no form in C.
        """
        known: object = None
        while True:
            # What is learned of the variables at the end of a loop counts at its beginning.
            self._expressions = Expressions(self._program, self._kinds)
            self._expressions.names = self._program.names_in(self._node)
            self._found = 0
            lines = self._block(self._body, 1)
            state = (dict(self._kinds), self._result)
            if state == known:
                break
            known = state
        result = self._result or NOTHING
        used = tuple(name in self._expressions.read for name in self._parameters)
        pairs = zip(self._parameters, self._given, used, strict=True)
        parameters = [
            f"{self._type(kind)} {self._expressions.name_of(name)}" for name, kind, u in pairs if u
        ]
        head = f"static {self._type(result) or 'void'} {self._program.function_name(self._node)}"
        text = "\n".join([f"{head}({', '.join(parameters) or 'void'})", "{", *lines, "}"])
        return CFunction(
            self._program.function_name(self._node), tuple(self._given), used, result, text
        )

    def _block(self, body: Sequence[ast.stmt], depth: int) -> list[str]:
        lines: list[str] = []
        for node in body:
            for name in self._places.before.get(id(node), ()):
                kind = self._kinds.get(name, REAL)
                if name not in self._kinds:
                    self._find_kind(node)
                    kind = self._kinds.get(name, REAL)
                zero = _ZERO.get(kind, "{0}") if isinstance(kind, Kind) else "{0}"
                own = f"{self._type(kind)} {self._expressions.name_of(name)}"
                lines.append(f"{INDENT * depth}{own} = {zero};")
            found = self._statement(node, depth)
            lines += [f"{INDENT * depth}{line}" for line in self._expressions.before]
            self._expressions.before = []
            lines += found
        return lines

    def _find_kind(self, node: ast.stmt) -> None:
        """Learn the kinds of variables that a statement assigns, before they are declared."""
        found, before = self._found, self._expressions.before
        self._statement(node, 0)
        self._found, self._expressions.before = found, before

    def _statement(self, node: ast.stmt, depth: int) -> list[str]:
        pad = INDENT * depth
        match node:
            case ast.Assign():
                return [f"{pad}{line}" for line in self._assign(node)]
            case ast.AugAssign():
                sign = _IN_PLACE.get(type(node.op)) or unknown(node)
                target = self._expressions.text(node.target)
                value = self._expressions.text(node.value)
                value = self._expressions.converted(value, target.kind)
                return [f"{pad}{target.code} {sign} {value.code};"]
            case ast.Expr():
                return [f"{pad}{self._expressions.text(node.value).code};"]
            case ast.Return():
                return [f"{pad}{line}" for line in self._return(node.value)]
            case ast.Break():
                return [f"{pad}break;"]
            case ast.Continue():
                return [f"{pad}continue;"]
            case ast.Pass():
                return []
            case ast.If():
                return self._if(node, depth, pad)
            case ast.While():
                test = self._expressions.condition(node.test)
                return [
                    f"{pad}while ({test.code}) {{",
                    *self._block(node.body, depth + 1),
                    f"{pad}}}",
                ]
            case ast.For():
                return self._for(node, depth, pad)
        return unknown(node)

    def _if(self, node: ast.If, depth: int, pad: str) -> list[str]:
        before = len(self._expressions.before)
        test = self._expressions.condition(node.test)
        held, self._expressions.before = self._expressions.before[:], []
        lines = [f"{pad}if ({test.code}) {{", *self._block(node.body, depth + 1)]
        if len(node.orelse) == 1 and isinstance(node.orelse[0], ast.If):
            inner = self._block(node.orelse, depth)
            if inner[0].startswith(f"{pad}if "):
                lines += [f"{pad}}} else {inner[0].lstrip()}", *inner[1:]]
                self._expressions.before = held
                return lines
            lines += [f"{pad}}} else {{", *self._block(node.orelse, depth + 1)]
        elif node.orelse:
            lines += [f"{pad}}} else {{", *self._block(node.orelse, depth + 1)]
        self._expressions.before = held
        assert before <= len(held)
        return [*lines, f"{pad}}}"]

    def _for(self, node: ast.For, depth: int, pad: str) -> list[str]:
        if not isinstance(node.target, ast.Name) or node.orelse:
            return unknown(node)
        name = node.target.id
        if not (isinstance(node.iter, ast.Call) and ast.unparse(node.iter.func) == "range"):
            return self._for_entries(node, depth, pad)
        self._kinds[name] = WHOLE
        bounds = [self._expressions.text(each) for each in node.iter.args]
        first, stop = bounds if len(bounds) == 2 else (Text("0", WHOLE), bounds[0])
        if len(bounds) > 2 or not first.kind == stop.kind == WHOLE:
            return unknown(node)
        counter = self._expressions.name_of(name) if name != "_" else f"repeat_{depth}"
        assigned = {
            n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
        }
        lines, limit = [], stop.inside(SUM)
        if assigned & {n.id for n in ast.walk(node.iter) if isinstance(n, ast.Name)}:
            self._found += 1
            limit = f"stop_{self._found}"
            lines.append(f"{pad}const int {limit} = {stop.code};")
        held, self._expressions.before = self._expressions.before, []
        body = self._block(node.body, depth + 1)
        self._expressions.before = held
        head = f"{pad}for (int {counter} = {first.code}; {counter} < {limit}; {counter}++) {{"
        return [*lines, head, *body, f"{pad}}}"]

    def _for_entries(self, node: ast.For, depth: int, pad: str) -> list[str]:
        """Translate a loop over the numbers of a tuple."""
        whole = self._expressions.text(node.iter)
        if whole.kind != NUMBERS or not isinstance(node.target, ast.Name):
            return unknown(node)
        self._kinds[node.target.id] = REAL
        name, counter = self._expressions.name_of(node.target.id), f"place_{depth}"
        head = f"{pad}for (int {counter} = 0; {counter} < {whole.code}.size; {counter}++) {{"
        entry = f"{pad}{INDENT}const {self._type(REAL)} {name} = {whole.code}.at[{counter}];"
        return [head, entry, *self._block(node.body, depth + 1), f"{pad}}}"]
