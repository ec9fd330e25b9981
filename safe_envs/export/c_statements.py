"""From the functions of kernels to functions of C."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from safe_envs.engine.formulas import Source
from safe_envs.engine.slots import Data
from safe_envs.errors import NotCompilableError
from safe_envs.export.c_expressions import (
    FLOATS,
    HELPERS,
    NOTHING,
    NUMBERS,
    REAL,
    SUM,
    TRUTH,
    WHOLE,
    CContext,
    CFunction,
    Expressions,
    Kind,
    Precision,
    Result,
    Struct,
    Text,
    comment,
    common,
    tuple_of,
    unknown,
)


class Declarations(NamedTuple):
    """Where variables are declared.

    Attributes:
        before: by the id of a statement, the variables that are declared before it.
        inline: by the id of an assignment, the variables that it declares.
        fixed: variables that are assigned once, where they are declared.
    """

    before: dict[int, list[str]]
    inline: dict[int, set[str]]
    fixed: set[str]


class _Occurrence(NamedTuple):
    """A statement that names a variable, with those around it, from the outermost one."""

    blocks: tuple[int, ...]
    statements: tuple[ast.stmt, ...]


def declared(body: Sequence[ast.stmt], parameters: Sequence[str]) -> Declarations:
    """Find the innermost block for each variable that holds all statements that name it.

    Where its first statement there assigns it, that declares it; else it is declared before. The
    counter of a loop belongs to the loop.

    Args:
        body: statements of a function.
        parameters: names of its parameters.

    Returns:
        Where each variable is declared.
    """
    found: dict[str, list[_Occurrence]] = defaultdict(list)
    stores: dict[str, int] = defaultdict(int)
    for name, occurrence, is_store in _occurrences(body, (id(body),), (), frozenset(parameters)):
        found[name].append(occurrence)
        stores[name] += is_store
    result = Declarations(defaultdict(list), defaultdict(set), set())
    for name, occurrences in found.items():
        if not stores[name] or name == "_":
            continue
        depth = _common_depth([o.blocks for o in occurrences])
        first = occurrences[0]
        statement = first.statements[depth - 1]
        if _is_plain_assignment(statement, name):
            result.inline[id(statement)].add(name)
            if stores[name] == 1:
                result.fixed.add(name)
            continue
        # A variable that lives through the rounds of a loop is declared before it.
        loops = [
            k
            for k, s in enumerate(first.statements[: depth - 1])
            if isinstance(s, ast.For | ast.While)
        ]
        outermost = first.statements[loops[0]] if loops else statement
        result.before[id(outermost)].append(name)
    return result


def _occurrences(
    body: Sequence[ast.stmt],
    blocks: tuple[int, ...],
    statements: tuple[ast.stmt, ...],
    hidden: frozenset[str],
) -> Iterator[tuple[str, _Occurrence, bool]]:
    for node in body:
        around = (*statements, node)
        inner = [getattr(node, part, []) for part in ("body", "orelse")]
        within = hidden
        if isinstance(node, ast.For) and isinstance(node.target, ast.Name):
            within = hidden | {node.target.id}
            heads: list[ast.AST] = [node.iter]
        elif isinstance(node, ast.If | ast.While):
            heads = [node.test]
        else:
            heads = [node]
        for head in heads:
            for each in ast.walk(head):
                if isinstance(each, ast.Name) and each.id not in hidden:
                    is_store = isinstance(each.ctx, ast.Store)
                    yield each.id, _Occurrence(blocks, around), is_store
        for k, part in enumerate(inner):
            if part:
                yield from _occurrences(part, (*blocks, id(node) * 2 + k), around, within)


def _common_depth(blocks: Sequence[tuple[int, ...]]) -> int:
    shortest = min(len(b) for b in blocks)
    return next(
        (k for k in range(shortest) if len({b[k] for b in blocks}) > 1),
        shortest,
    )


def _is_plain_assignment(node: ast.stmt, name: str) -> bool:
    """Return whether a statement gives a variable its first value, for which it needs no other."""
    if not isinstance(node, ast.Assign) or _chooses_tuple(node.value):
        return False
    read = {e.id for e in ast.walk(node.value) if isinstance(e, ast.Name)}
    targets = [e for t in node.targets for e in (t.elts if isinstance(t, ast.Tuple) else [t])]
    named = [t for t in targets if isinstance(t, ast.Name) and t.id == name]
    loads = {
        e.id
        for t in targets
        if not isinstance(t, ast.Name)
        for e in ast.walk(t)
        if isinstance(e, ast.Name)
    }
    return bool(named) and name not in read and name not in loads


def _chooses_tuple(value: ast.expr) -> bool:
    return isinstance(value, ast.IfExp) and isinstance(value.body, ast.Tuple)


INDENT = "    "


_ZERO = {REAL: "0", WHOLE: "0", TRUTH: "false"}
_IN_PLACE = {ast.Add: "+=", ast.Sub: "-=", ast.Mult: "*=", ast.Div: "/="}


class FunctionTranslator:
    """Translates one function, for parameters of given kinds.

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


_WIDTH = 100

_TYPES = """/* Entries of a scratch array. */
typedef struct {
    real *at;
    int size;
} vector;

/* The same with two indices. */
typedef struct {
    real *at;
    int height;
    int width;
} table;

/* Entries that are only read. */
typedef struct {
    const real *at;
    int size;
} numbers;
"""

_FLOATS = """/* Entries of a table that is only read. */
typedef struct {
    const float *at;
    int size;
} floats;
"""


class CProgram(CContext):
    """Functions of C that a filter's decision needs.

    Args:
        source: `decide`, and what it calls.
        data: numbers of the source.
        precision: of the numbers.
        symbols: by argument of the generated formulas, the names of C of its entries.
        documented: what generated functions do, by name.
    """

    def __init__(
        self,
        source: Source,
        data: Data,
        precision: Precision,
        symbols: Mapping[str, Sequence[str]],
        documented: Mapping[str, str],
    ) -> None:
        super().__init__(source, data, precision, symbols)
        self._documented = documented
        self._functions: dict[str, CFunction] = {}

    def text(self) -> str:
        """Return types, constants and functions, each one before those that need it."""
        parts = [_TYPES.replace("real", self.precision.type)]
        if any(FLOATS in function.kinds for function in self._functions.values()):
            parts.append(_FLOATS)
        parts += [self._struct(k.type, [("at", k)]) for _, k in sorted(self._tuples.items())]
        parts.append("".join(f"{line}\n" for line in self._constants.values()))
        for name in HELPERS:
            if name in self._helpers:
                doc, text = HELPERS[name]
                text = re.sub(r"\breal\b", self.precision.type, text)
                text = text.replace("fmod", self.precision.function("fmod"))
                parts.append(f"/* {doc} */\n{text}\n")
        for name, function in self._functions.items():
            if name in self._records:
                record = self._records[name]
                parts.append(self._struct(record.type, record.fields))
            doc = self._doc(name)
            parts.append("\n".join([f"/* {doc} */"] * bool(doc) + [function.text]) + "\n")
        return "\n".join(wrapped(part) for part in parts if part)

    def data_table(self) -> str:
        """Return the constants that functions read by their place; "" where none does."""
        digits = [self.precision.number(self.single_tolerance(v)) for v in self._data]
        lines = [", ".join(digits[i : i + 6]) for i in range(0, len(digits), 6)]
        inner = ",\n    ".join(lines)
        doc = "/* Numbers that functions read by their place: weights and biases of networks. */"
        return f"{doc}\nstatic const {self.precision.type} constants[] = {{\n    {inner},\n}};\n"

    def function(self, name: str, kinds: Sequence[Result]) -> CFunction:
        """Return a function for arguments of given kinds, translated once.

        Args:
            name: of the function.
            kinds: of its arguments.

        Raises:
            NotCompilableError: It has no form in C, or is called with arguments of other kinds.
        """
        known = self._functions.get(name)
        if known is None:
            node = self.definitions.functions[name]
            wanted = [WHOLE if k == WHOLE else k for k in kinds]
            for i, argument in enumerate(node.args.args):
                if argument.annotation is not None and ast.unparse(argument.annotation) == "float":
                    wanted[i] = REAL
            known = FunctionTranslator(self, node, wanted).translated()
            # A function comes after those that it calls.
            self._functions.pop(name, None)
            self._functions[name] = known
        for given, kind in zip(kinds, known.kinds, strict=True):
            if given != kind and not (kind == REAL and given == WHOLE):
                raise NotCompilableError(f"{name} is called with arguments of several kinds")
        return known

    def _struct(self, name: str, fields: Sequence[tuple[str, Kind]]) -> str:
        lines = []
        for field, kind in fields:
            if kind.size and field == "at":
                lines.append(f"    {self.precision.type} at[{kind.size}];")
            else:
                lines.append(f"    {self.precision.type if kind == REAL else kind.type} {field};")
        return "\n".join(["typedef struct {", *lines, f"}} {name};", ""])

    def _doc(self, name: str) -> str:
        known = self._documented.get(name)
        if known is None:
            known = (ast.get_docstring(self.definitions.functions[name]) or "").split("\n\n")[0]
        return comment(known)


def wrapped(text: str) -> str:
    """Return C with lines of at most 100 characters, as far as they have spaces.

    A compiler need not read lines of more than 4095.
    """
    lines: list[str] = []
    for line in text.split("\n"):
        rest, indent = line, " " * (len(line) - len(line.lstrip()) + 4)
        while len(rest) > _WIDTH:
            ends = [rest.rfind(mark, len(indent), _WIDTH) + 1 for mark in (", ", " ")]
            end = next((e for e in ends if e > _WIDTH // 2), max(ends))
            if end <= len(indent):
                break
            lines.append(rest[:end].rstrip())
            rest = indent + rest[end:].lstrip()
        lines.append(rest)
    return "\n".join(lines)
