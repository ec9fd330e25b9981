"""From assignments and returned values in kernels to those in C."""

from __future__ import annotations

import ast
from collections.abc import Sequence

from safe_envs.wrappers.export.c_calls import Expressions
from safe_envs.wrappers.export.c_context import CContext
from safe_envs.wrappers.export.c_expressions import unknown
from safe_envs.wrappers.export.declarations import declared
from safe_envs.wrappers.export.kinds import (
    REAL,
    WHOLE,
    Kind,
    Result,
    Struct,
    Text,
    common,
    tuple_of,
)

INDENT = "    "


class Assignments:
    """Translates the assignments and the returned values of one function.

    Args:
        program: that it belongs to.
        node: the function.
        kinds: of its parameters.
    """

    def __init__(self, program: CContext, node: ast.FunctionDef, kinds: Sequence[Result]) -> None:
        self._program, self._node = program, node
        self._parameters = [a.arg for a in node.args.args]
        self._given = list(kinds)
        self._kinds: dict[str, Result] = dict(zip(self._parameters, kinds, strict=True))
        self._result: Result | None = None
        self._fields: list[str] = []
        body = node.body[1:] if ast.get_docstring(node) is not None else node.body
        self._body, self._places = body, declared(body, self._parameters)
        self._expressions, self._found = Expressions(program, self._kinds), 0

    def _type(self, kind: Result) -> str:
        if isinstance(kind, Kind) and kind.size:
            self._program.need_tuple(kind)
        return self._program.precision.type if kind == REAL else kind.type

    def _assign(self, node: ast.Assign) -> list[str]:
        lines: list[str] = []
        for target in node.targets:
            lines += (
                self._assign_tuple(node, target, node.value)
                if isinstance(target, ast.Tuple)
                else self._assign_one(node, target, node.value)
            )
        return lines

    def _assign_one(self, node: ast.stmt, target: ast.expr, value: ast.expr) -> list[str]:
        entries = self._expressions.entries(value)
        if entries is not None and isinstance(target, ast.Name):
            kind = tuple_of(len(entries))
            inner = ", ".join(self._expressions.as_real(e).code for e in entries)
            self._kinds[target.id] = kind
            name = self._expressions.name_of(target.id)
            return [f"const {self._type(kind)} {name} = {{{{{inner}}}}};"]
        return self._set(node, target, self._expressions.text(value), value)

    def _set(
        self, node: ast.stmt, target: ast.expr, found: Text, value: ast.expr | None = None
    ) -> list[str]:
        """Write a value to a target."""
        if not isinstance(target, ast.Name):
            place = self._expressions.text(target)
            return [f"{place.code} = {self._expressions.converted(found, place.kind).code};"]
        name = target.id
        if name == "_":
            return []
        kind = common(self._kinds.get(name, found.kind), found.kind) or unknown(target)
        self._kinds[name] = kind
        code = self._expressions.converted(found, kind).code
        own = self._expressions.name_of(name)
        self._note_columns(name, own, value)
        if name in self._places.inline.get(id(node), ()):
            fixed = "const " * (name in self._places.fixed)
            return [f"{fixed}{self._type(kind)} {own} = {code};"]
        return [f"{own} = {code};"]

    def _note_columns(self, name: str, own: str, value: ast.expr | None) -> None:
        """Note how many columns a table has that is named once."""
        if isinstance(value, ast.Call) and ast.unparse(value.func) == "table_view":
            last = value.args[-1]
            columns = last.value if isinstance(last, ast.Constant) else None
            if isinstance(columns, int) and name in self._places.fixed:
                self._expressions.columns[own] = columns

    def _assign_tuple(self, node: ast.stmt, target: ast.Tuple, value: ast.expr) -> list[str]:
        match value:
            case ast.Tuple():
                return self._assign_entries(node, target, value)
            case ast.IfExp(body=ast.Tuple() as body, orelse=ast.Tuple() as other):
                test = self._expressions.condition(value.test).code
                first, second = (self._assign_tuple(node, target, v) for v in (body, other))
                inner = (
                    [f"{INDENT}{line}" for line in first],
                    [f"{INDENT}{line}" for line in second],
                )
                return [f"if ({test}) {{", *inner[0], "} else {", *inner[1], "}"]
            case ast.Attribute(attr="shape"):
                whole = self._expressions.text(value.value)
                axes = [Text(f"{whole.code}.{axis}", WHOLE) for axis in ("height", "width")]
                pairs = zip(target.elts, axes, strict=True)
                return [line for t, axis in pairs for line in self._set(node, t, axis)]
        found = self._expressions.text(value)
        name = self._expressions.part(found)
        lines: list[str] = []
        for i, each in enumerate(target.elts):
            if isinstance(found.kind, Struct):
                field, kind = found.kind.fields[i]
                lines += self._set(node, each, Text(f"{name}.{field}", kind))
            else:
                lines += self._set(node, each, Text(f"{name}.at[{i}]", REAL))
        return lines

    def _assign_entries(self, node: ast.stmt, target: ast.Tuple, value: ast.Tuple) -> list[str]:
        """Write several values; those that an earlier target changes are read before."""
        lines: list[str] = []
        changed: set[str] = set()
        waiting: list[tuple[ast.expr, Text]] = []
        for each, entry in zip(target.elts, value.elts, strict=True):
            read = {n.id for n in ast.walk(entry) if isinstance(n, ast.Name)}
            found = self._expressions.text(entry)
            if read & changed:
                self._found += 1
                fresh = f"next_{self._found}"
                lines.insert(0, f"const {self._type(found.kind)} {fresh} = {found.code};")
                waiting.append((each, Text(fresh, found.kind)))
            else:
                lines += self._set(node, each, found, entry)
            changed |= {n.id for n in ast.walk(each) if isinstance(n, ast.Name)}
        for each, found in waiting:
            lines += self._set(node, each, found)
        return lines

    def _return(self, value: ast.expr | None) -> list[str]:
        if value is None:
            return ["return;"]
        if isinstance(value, ast.IfExp) and isinstance(value.body, ast.Tuple):
            test = self._expressions.condition(value.test).code
            first, second = self._return(value.body), self._return(value.orelse)
            inner = [f"{INDENT}{line}" for line in first]
            return [f"if ({test}) {{", *inner, "}", *second]
        entries = self._expressions.entries(value)
        if entries is not None:
            return self._return_entries(value, entries)
        found = self._expressions.text(value)
        kind = found.kind if self._result is None else common(self._result, found.kind)
        self._result = kind or unknown(value)
        return [f"return {self._expressions.converted(found, self._result).code};"]

    def _return_entries(self, value: ast.expr, entries: Sequence[Text]) -> list[str]:
        kinds = [e.kind for e in entries]
        # A number may be written without a point.
        plain = all(e.kind == REAL or (e.kind == WHOLE and e.code.isdigit()) for e in entries)
        if plain and not isinstance(self._result, Struct):
            self._result = tuple_of(len(entries))
        else:
            self._result = self._record(value, kinds)
        whole = isinstance(self._result, Struct)
        goals = (
            [k for _, k in self._result.fields]
            if isinstance(self._result, Struct)
            else [REAL] * len(entries)
        )
        pairs = zip(entries, goals, strict=True)
        inner = ", ".join(self._expressions.converted(e, kind).code for e, kind in pairs)
        inner = inner if whole else f"{{{inner}}}"
        own = {each.id for each in ast.walk(self._node) if isinstance(each, ast.Name)}
        name = "found" if "found" not in own else "answer"
        return [f"const {self._type(self._result)} {name} = {{{inner}}};", f"return {name};"]

    def _record(self, value: ast.expr, kinds: Sequence[Result]) -> Struct:
        """Return the struct of a result; its fields have the names of what is returned."""
        elements = value.elts if isinstance(value, ast.Tuple) else []
        if not self._fields:
            named = self._program.names_of_results(self._node.name)
            for i, each in enumerate(elements):
                own = each.id if isinstance(each, ast.Name) else f"item_{i}"
                self._fields.append(self._program.local_name(named.get(i, own)))
        known = self._result.fields if isinstance(self._result, Struct) else ()
        merged: list[Kind] = []
        for i, kind in enumerate(kinds):
            both = common(known[i][1], kind) if known else kind
            assert isinstance(both, Kind)
            merged.append(both)
        record = Struct(
            f"{self._program.function_name(self._node)}_result",
            tuple(zip(self._fields, merged, strict=True)),
        )
        self._program.need_record(record)
        return record
