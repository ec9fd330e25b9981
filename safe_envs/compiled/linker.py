"""One module out of the kernels that a program reaches and the functions generated for it."""

from __future__ import annotations

import ast
import copy
import importlib
import inspect
import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from types import ModuleType
from typing import Any, NamedTuple

from safe_envs.compiled import plain_natives, slots
from safe_envs.compiled.formulas import Source
from safe_envs.errors import SystemDefinitionError

_MATH_FUNCTIONS = {name for name, value in vars(math).items() if not name.startswith("_")}


class _Module(NamedTuple):
    """What a kernel module defines.

    Attributes:
        functions: by name.
        constants: assignments of numbers by name.
        imports: module and original name by name.
    """

    functions: dict[str, ast.FunctionDef]
    constants: dict[str, ast.stmt]
    imports: dict[str, tuple[str, str]]


class Definitions(NamedTuple):
    """What a program consists of, as the kernel modules state it.

    Attributes:
        functions: by name, with docstrings and annotations.
        constants: assignments of numbers by name.
    """

    functions: dict[str, ast.FunctionDef]
    constants: dict[str, ast.stmt]


def definitions(entries: Sequence[Callable[..., Any]], generated: Source) -> Definitions:
    """Return entry points and all that they call; see `linked`.

    Args:
        entries: functions of kernel modules.
        generated: functions of this program alone.

    Raises:
        SystemDefinitionError: Two functions have one name, or a generated one is missing.
    """
    link = _Link(generated)
    for function in (*entries, *generated.uses):
        link.need(function.__module__, function.__name__)
    return link.definitions()


def linked(entries: Sequence[Callable[..., Any]], generated: Source) -> str:
    """Return the text of a module with entry points and all that they call.

    Functions that the generated ones define take the place of functions of the same name, which the
    kernel modules import as a declaration.

    Args:
        entries: functions of kernel modules; they are marked `@entry`, all others `@kernel`.
        generated: functions of this program alone.

    Raises:
        SystemDefinitionError: Two functions have one name, or a generated one is missing.
    """
    link = _Link(generated)
    for function in entries:
        link.need(function.__module__, function.__name__)
    for function in generated.uses:
        link.need(function.__module__, function.__name__)
    return link.text({function.__name__ for function in entries})


class _Link:
    def __init__(self, generated: Source) -> None:
        self._generated: dict[str, ast.FunctionDef] = {}
        for node in ast.parse(generated.text).body:
            if not isinstance(node, ast.FunctionDef) or node.name in self._generated:
                raise SystemDefinitionError(f"generated twice, or no function: {ast.unparse(node)}")
            self._generated[node.name] = node
        self._found: dict[str, tuple[str, ast.stmt]] = {}
        self._math: set[str] = set()
        for node in self._generated.values():
            self._need_math(node)

    def _need_math(self, node: ast.AST) -> None:
        """Note functions of `math`, which generated code calls without an import."""
        for each in _names(node):
            if each in _MATH_FUNCTIONS:
                self._math.add(each)

    def need(self, module: str, name: str) -> None:
        """Add a definition of a kernel module, and what it calls."""
        if name in self._generated:
            return
        if module == "math":
            self._math.add(name)
            return
        if module == plain_natives.__name__:
            return
        if module == slots.__name__:
            raise SystemDefinitionError(f"the program needs a function {name!r}, which is missing")
        known = _parsed(module)
        if name in known.imports:
            self.need(*known.imports[name])
            return
        node = known.functions.get(name) or known.constants.get(name)
        if node is None:
            return
        if name in self._found:
            other, found = self._found[name]
            # A constant of one value may be stated in several modules.
            if other != module and ast.unparse(found) != ast.unparse(node):
                raise SystemDefinitionError(
                    f"two kernels are called {name!r}, in {other} and {module}"
                )
            return
        self._found[name] = module, node
        for each in _names(_bare(node) if isinstance(node, ast.FunctionDef) else node):
            self.need(module, each)

    def definitions(self) -> Definitions:
        """Return what was found."""
        found = {name: node for name, (_, node) in self._found.items()}
        functions = {n: d for n, d in found.items() if isinstance(d, ast.FunctionDef)}
        constants = {n: d for n, d in found.items() if not isinstance(d, ast.FunctionDef)}
        return Definitions(functions | self._generated, constants)

    def text(self, entries: set[str]) -> str:
        """Return the module."""
        functions, constants = self.definitions()
        parts = [f"from math import {', '.join(sorted(self._math))}"] * bool(self._math)
        parts += [ast.unparse(constants[name]) for name in sorted(constants)]
        for name, node in sorted(functions.items()):
            mark = "entry" if name in entries else "kernel"
            parts.append(f"@{mark}\n{ast.unparse(_bare(node))}\n")
        return "\n".join(parts)


def _names(node: ast.AST) -> set[str]:
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}


@lru_cache(maxsize=64)
def _parsed(module: str) -> _Module:
    """Read a kernel module."""
    found: ModuleType = importlib.import_module(module)
    known = _Module({}, {}, {})
    for node in ast.parse(inspect.getsource(found)).body:
        if isinstance(node, ast.FunctionDef):
            known.functions[node.name] = node
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            known.constants[node.targets[0].id] = node
        elif isinstance(node, ast.ImportFrom) and node.module:
            known.imports.update({a.asname or a.name: (node.module, a.name) for a in node.names})
    return known


def _bare(node: ast.FunctionDef) -> ast.FunctionDef:
    """Return a function without docstring and annotations."""
    bare = copy.deepcopy(node)
    bare.returns = None
    for argument in bare.args.args:
        argument.annotation = None
    if ast.get_docstring(bare) is not None:
        bare.body = bare.body[1:] or [ast.Pass()]
    return bare
