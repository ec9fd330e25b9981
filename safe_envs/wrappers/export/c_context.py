"""Names, constants and types that the functions of a C program share."""

from __future__ import annotations

import ast
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

from safe_envs.compiled.data import Data
from safe_envs.compiled.formulas import Source
from safe_envs.compiled.linker import definitions
from safe_envs.errors import NotCompilableError
from safe_envs.wrappers.export.c_names import KEYWORDS, OWN, c_names
from safe_envs.wrappers.export.c_numbers import HELPERS, MATH, Precision
from safe_envs.wrappers.export.kinds import REAL, WHOLE, CFunction, Kind, Result, Struct, Text
from safe_envs.wrappers.qp.rounding import ROUNDING

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

    def is_library(self, name: str) -> bool:
        """Return whether a function is taken from <math.h>."""
        return name in MATH

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
