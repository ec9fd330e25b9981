"""A filter's decision as functions of C, translated from the source of the compiled engine."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping, Sequence

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers.export.c_context import CContext
from safe_envs.wrappers.export.c_names import comment
from safe_envs.wrappers.export.c_numbers import HELPERS, Precision
from safe_envs.wrappers.export.c_statements import FunctionTranslator
from safe_envs.wrappers.export.kinds import FLOATS, REAL, WHOLE, CFunction, Kind, Result

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

    @property
    def data_size(self) -> int:
        """Number of constants."""
        return len(self._data)

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
