"""Programs that are linked, compiled and loaded."""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import logging
import shutil
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from safe_envs.atomic_io import write_atomically
from safe_envs.compiled import plain_natives
from safe_envs.compiled.formulas import Source
from safe_envs.compiled.linker import linked
from safe_envs.errors import ConfigurationError, NotCompilableError, install_extra, shortened
from safe_envs.user_cache import cache_folder, make_room, mark_used

ADVICE = f"{install_extra('fast')}, or use the engine 'numpy'"

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
        names: dict[str, Any] = {**vars(plain_natives), "entry": _unchanged, "kernel": _unchanged}
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
    stamp = f"{inspect.getsource(natives)}\n{text}"
    digest = hashlib.sha256(stamp.encode()).hexdigest()[:_DIGITS]
    folder = cache_folder(FOLDER)
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

        from safe_envs.compiled import numba_natives
    except Exception as error:
        raise NotCompilableError(f"Numba cannot be imported: {shortened(error)}") from error
    if getattr(config, "DISABLE_JIT", 0):
        raise NotCompilableError("Numba compiles nothing, as NUMBA_DISABLE_JIT says")
    return numba_natives


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
        self._functions = self._load()

    def entry(self, name: str) -> Callable[..., Any]:
        """Return an entry point, which says so where it has to be compiled first."""
        function = self._functions[name]
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
        text = f"from safe_envs.compiled.numba_natives import *\n{self._text}".encode()
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
