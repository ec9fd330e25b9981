"""Programs that are linked, compiled and loaded."""

from __future__ import annotations

import ast
import copy
import ctypes
import hashlib
import importlib
import importlib.util
import inspect
import logging
import math
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from safe_envs.engine import plain_natives, slots
from safe_envs.engine.decide import decide_at, decide_columns
from safe_envs.engine.formulas import Source
from safe_envs.engine.qp import project_rows
from safe_envs.errors import (
    ConfigurationError,
    NotCompilableError,
    SystemDefinitionError,
    shortened,
)
from safe_envs.files import cache_folder, make_room, mark_used, write_atomically
from safe_envs.lazy_attributes import package_version

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


def linked(
    entries: Sequence[Callable[..., Any]],
    generated: Source,
    marks: tuple[str, str] = ("entry", "kernel"),
) -> str:
    """Return the text of a module with entry points and all that they call.

    Functions that the generated ones define take the place of functions of the same name, which the
    kernel modules import as a declaration.

    Args:
        entries: functions of kernel modules.
        generated: functions of this program alone.
        marks: what entry points are marked with, and all others; see `numba_natives`.

    Raises:
        SystemDefinitionError: Two functions have one name, or a generated one is missing.
    """
    link = _Link(generated)
    for function in (*entries, *generated.uses):
        link.need(function.__module__, function.__name__)
    return link.text([function.__name__ for function in entries], marks)


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
        is_function = isinstance(node, ast.FunctionDef)
        for each in _kernel(module, name)[1] if is_function else _names(node):
            self.need(module, each)

    def text(self, entries: Sequence[str], marks: tuple[str, str]) -> str:
        """Return the module."""
        found = {name: node for name, (_, node) in self._found.items()}
        functions = {n: d for n, d in found.items() if isinstance(d, ast.FunctionDef)}
        constants = {n: d for n, d in found.items() if n not in functions}
        functions |= self._generated
        parts = [f"from math import {', '.join(sorted(self._math))}"] * bool(self._math)
        parts += [ast.unparse(constants[name]) for name in sorted(constants)]
        # Entry points come last: some are compiled where they are defined.
        parts_of = sorted(name for name in functions if name not in entries)
        for name in (*parts_of, *entries):
            text = ast.unparse(_bare(functions[name])) if name in self._generated else ""
            text = text or _kernel(self._found[name][0], name)[0]
            parts.append(f"@{marks[name not in entries]}\n{text}\n")
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


@cache
def _kernel(module: str, name: str) -> tuple[str, frozenset[str]]:
    """Return a kernel's text without docstring and annotations, and the names in it."""
    bare = _bare(_parsed(module).functions[name])
    return ast.unparse(bare), frozenset(_names(bare))


def _bare(node: ast.FunctionDef) -> ast.FunctionDef:
    """Return a function without docstring and annotations."""
    bare = copy.deepcopy(node)
    bare.returns = None
    for argument in bare.args.args:
        argument.annotation = None
    if ast.get_docstring(bare) is not None:
        bare.body = bare.body[1:] or [ast.Pass()]
    return bare


ADVICE = "pip install numba, or use the engine 'numpy'"

_LOG = logging.getLogger("safe_envs")
_FILE = "program.py"
_DIGITS = 32

FOLDER = "compiled"
"""Name of the folder of programs in the user's cache."""

Functions = dict[str, Callable[..., Any]]
"""Entry points by name."""


def is_available() -> bool:
    """Return whether Numba is installed, without importing it."""
    return importlib.util.find_spec("numba") is not None


class Program:
    """Entry points, linked with the functions that were generated for a problem.

    Args:
        title: what the program computes, for the message that it is being compiled.
        entries: functions of kernel modules.
        generated: functions of this program alone.

    Attributes:
        text: of the program, in Python.

    Raises:
        SystemDefinitionError: Two functions have one name, or a generated one is missing.
    """

    def __init__(
        self, title: str, entries: Sequence[Callable[..., Any]], generated: Source
    ) -> None:
        self._title = title
        self._names = tuple(function.__name__ for function in entries)
        self.text = linked(entries, generated)

    def plain(self) -> Functions:
        """Return the entry points as plain Python functions, which are slow."""
        marks = {"entry": _unchanged, "kernel": _unchanged}
        names: dict[str, Any] = {**vars(plain_natives), **marks, "decide_at": decide_at}
        exec(self.text, names)
        return {name: names[name] for name in self._names}

    def compiled(self) -> Functions:
        """Return the entry points; each is compiled, or read from disk, at its first call.

        Raises:
            ConfigurationError: Numba is not installed.
            NotCompilableError: It cannot be used.
        """
        if not is_available():
            raise ConfigurationError(f"the compiled engine needs Numba, which is missing; {ADVICE}")
        return _loaded(self.text, self._names, self._title)


def _unchanged(function: Callable[..., Any]) -> Callable[..., Any]:
    return function


@lru_cache(maxsize=64)
def _loaded(text: str, names: tuple[str, ...], title: str) -> Functions:
    natives = _natives()
    if "decide_at(" in text:
        register_decide()
    digest, folder = _digest(inspect.getsource(natives), text), cache_folder(FOLDER)
    try:
        if folder is not None:
            program = _KeptProgram(folder / digest, text, title)
            make_room()
            return {name: program.entry(name) for name in names}
    except (OSError, ConfigurationError):  # The disk may be full.
        pass
    _LOG.warning("compiling %s; there is no folder of yours to keep it in", title)
    found = _not_kept(text)
    return {name: found[name] for name in names}


def _natives() -> ModuleType:
    """Import what needs Numba, which may not suit the other packages."""
    try:
        from numba.core import config

        from safe_envs.engine import numba_natives
    except Exception as error:
        raise NotCompilableError(f"Numba cannot be imported: {shortened(error)}") from error
    if getattr(config, "DISABLE_JIT", 0):
        raise NotCompilableError("Numba compiles nothing, as NUMBA_DISABLE_JIT says")
    return numba_natives


SWITCH = "SAFE_ENVS_COMPILE"
"""Environment variable; 0 has the decisions of filters interpreted."""


class MachineCode(NamedTuple):
    """`safe_envs.engine.decide.decide_columns` in machine code, a function of an address.

    Attributes:
        one: for one state, which takes no longer than other threads may wait in any case.
        many: for a batch; meanwhile other threads run.
    """

    one: Callable[[int], int]
    many: Callable[[int], int]


def decider(compiling: bool = True) -> MachineCode | None:
    """Return what decides in machine code, which is compiled once for each machine and version.

    Args:
        compiling: whether to compile it where it has not been yet, which takes some 20 seconds.

    Returns:
        None where there is none: it is not compiled, Numba cannot be used, or `SWITCH` is 0.
    """
    if os.environ.get(SWITCH) == "0" or not (compiling or _is_kept()):
        return None
    return _decider()


@lru_cache(maxsize=1)
def _decider() -> MachineCode | None:
    try:
        address = register_decide()
    except NotCompilableError as error:
        _LOG.warning("filters decide in plain Python, which is slow: %s", error)
        return None
    kinds = (ctypes.PYFUNCTYPE, ctypes.CFUNCTYPE)
    return MachineCode(*[kind(ctypes.c_int64, ctypes.c_void_p)(address) for kind in kinds])


@lru_cache(maxsize=1)
def _decide_text() -> tuple[str, str]:
    """Return the text of `decide_columns`, and the name of its folder."""
    text = linked([project_rows, decide_columns], Source(""), ("c_entry", "part"))
    natives = Path(__file__).with_name("numba_natives.py").read_text(encoding="utf-8")
    # Numba keeps nothing for its other versions.
    return text, _digest(package_version("numba"), natives, text)


def _digest(*parts: str) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:_DIGITS]


def _places_of_decide() -> list[Path]:
    """Return where Numba keeps its machine code: elsewhere if the user has set a folder."""
    folder, digest = cache_folder(FOLDER), _decide_text()[1]
    elsewhere = os.environ.get("NUMBA_CACHE_DIR")
    found = [] if elsewhere is None else [*Path(elsewhere).glob(f"{digest}_*")]
    return found if folder is None else [folder / digest, *found]


def _is_kept() -> bool:
    index = f"**/*.decide_columns-*.py{sys.version_info[0]}{sys.version_info[1]}*.nbi"
    return any(any(place.glob(index)) for place in _places_of_decide())


@lru_cache(maxsize=1)
def register_decide() -> int:
    """Return the address of `safe_envs.engine.decide.decide_columns`, which programs call.

    Raises:
        NotCompilableError: Numba cannot be used.
    """
    if not is_available():
        raise NotCompilableError("Numba is missing; pip install numba")
    natives = _natives()
    try:
        _load_decide()
        return natives.address_of("decide_columns")
    except Exception as error:
        raise NotCompilableError(
            f"Numba cannot compile the decisions of filters: {shortened(error)}"
        ) from error


def _load_decide() -> None:
    """Compile the decisions of filters, or read them from disk."""
    (text, digest), folder = _decide_text(), cache_folder(FOLDER)
    if folder is None or not _keep_decide(folder / digest, text):
        _LOG.warning("%s; there is no folder of yours to keep them in", _COMPILING)
        _not_kept(text)


_COMPILING = "compiling the decisions of filters, which takes some 20 seconds"


def _keep_decide(folder: Path, text: str) -> bool:
    """Return whether the decisions of filters are compiled and kept, or read from disk."""
    is_kept = _is_kept()
    if not is_kept:
        _LOG.warning("%s, once for this machine", _COMPILING)
    try:
        _KeptProgram(folder, text, "the decisions of filters")
    except Exception as error:
        if not is_kept or isinstance(error, OSError | ConfigurationError):
            return False  # The disk may be full.
        # Kernels raise nothing: what is kept cannot be read.
        for place in _places_of_decide():
            shutil.rmtree(place, ignore_errors=True)
        return not _is_kept() and _keep_decide(folder, text)
    if not is_kept:
        make_room()
    return True


def _not_kept(text: str) -> dict[str, Any]:
    natives = _natives()
    names = {**vars(natives), "entry": natives.passing_entry}
    exec(text, names)
    return names


class _KeptProgram:
    """A program in a folder of its own, where Numba keeps what it compiles."""

    def __init__(self, folder: Path, text: str, title: str) -> None:
        self._folder, self._title, self._told = folder, title, False
        self._text = text
        self.functions = self._load()

    def entry(self, name: str) -> Callable[..., Any]:
        """Return an entry point, which says so where it has to be compiled first."""
        function = self.functions[name]
        is_new = True

        def call(*arguments: Any) -> Any:
            nonlocal function, is_new
            if not is_new:
                return function(*arguments)
            # Elsewhere where the user has set NUMBA_CACHE_DIR.
            place = Path(function.stats.cache_path)
            is_kept = any(place.glob(f"*.{name}-*.nbi"))
            if not (is_kept or self._told):
                _LOG.warning("compiling %s, which takes some seconds once", self._title)
                self._told = True
            is_new = False
            try:
                return function(*arguments)
            except OSError:  # The disk may be full.
                function = _not_kept(self._text)[name]
            except Exception:
                if not is_kept:
                    raise
                # Kernels raise nothing: what is kept cannot be read.
                shutil.rmtree(place, ignore_errors=True)
                function = self._load()[name]
            return function(*arguments)

        return call

    def _load(self) -> dict[str, Any]:
        file = self._folder / _FILE
        text = f"from safe_envs.engine.numba_natives import *\n{self._text}".encode()
        self._folder.mkdir(mode=0o700, exist_ok=True)
        if not file.is_file() or file.read_bytes() != text:
            write_atomically(file, lambda path: path.write_bytes(text))
        mark_used(self._folder)
        name = f"safe_envs_program_{self._folder.name}"
        spec: Any = importlib.util.spec_from_file_location(name, file)
        module = importlib.util.module_from_spec(spec)
        # Numba finds a function's module by its name.
        sys.modules[name] = module
        spec.loader.exec_module(module)
        return vars(module)


def has_own_source(given: Any, *computing: str) -> bool:
    """Return whether an object has a method `source` that tells what it computes.

    That of a base tells nothing about a class that computes otherwise.

    Args:
        given: any object.
        computing: names of the methods by which it computes in NumPy.
    """
    classes = type(given).__mro__

    def place(name: str) -> int:
        return next((k for k, c in enumerate(classes) if name in vars(c)), len(classes))

    return place("source") < len(classes) and all(
        place("source") <= place(name) and name not in getattr(given, "__dict__", {})
        for name in computing
    )
