"""Programs that are linked, compiled and loaded."""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import logging
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from safe_envs.atomic_io import write_atomically
from safe_envs.compiled import plain_natives
from safe_envs.compiled.cache import cache_folder, forget_old_programs
from safe_envs.compiled.formulas import Source
from safe_envs.compiled.linker import linked
from safe_envs.errors import ConfigurationError

ADVICE = "install it with pip install 'safe-envs[fast]', or use the engine 'numpy'"

_LOG = logging.getLogger("safe_envs")
_FILE = "program.py"

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
        ConfigurationError: Two functions that the program needs have one name.
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
        """
        if not is_available():
            raise ConfigurationError(f"the compiled engine needs Numba, which is missing; {ADVICE}")
        return _loaded(self.text, self._names, self._title)


def _unchanged(function: Callable[..., Any]) -> Callable[..., Any]:
    return function


@lru_cache(maxsize=64)
def _loaded(text: str, names: tuple[str, ...], title: str) -> Functions:
    from safe_envs.compiled import numba_natives

    stamp = f"{inspect.getsource(numba_natives)}\n{text}"
    digest = hashlib.sha256(stamp.encode()).hexdigest()[:32]
    folder = cache_folder()
    if folder is None:
        _LOG.warning("compiling %s; there is no folder of yours to keep it in", title)
        return _functions({**vars(numba_natives), "entry": numba_natives.kernel}, text, names)
    program = folder / digest
    if not any(program.glob("**/*.nbi")):
        _LOG.warning("compiling %s, which takes some seconds once", title)
    found = _kept(program, text)
    forget_old_programs(folder)
    return {name: _Entry(found[name], program, text).__call__ for name in names}


def _functions(names: dict[str, Any], text: str, wanted: Sequence[str]) -> Functions:
    exec(text, names)
    return {name: names[name] for name in wanted}


def _kept(program: Path, text: str) -> dict[str, Any]:
    """Load a program from its folder, made if need be: Numba keeps what it compiles beside it."""
    file = program / _FILE
    program.mkdir(mode=0o700, exist_ok=True)
    whole = f"from safe_envs.compiled.numba_natives import *\n{text}"
    if not file.is_file() or file.read_text() != whole:
        write_atomically(file, lambda path: path.write_text(whole))
    os.utime(program)
    name = f"safe_envs_program_{program.name}"
    spec: Any = importlib.util.spec_from_file_location(name, file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    # Numba has a cache of its own; bytecode would be one more file that others could write.
    spec.loader.exec_module(module)
    return vars(module)


class _Entry:
    """An entry point that compiles its program anew where what is kept on disk cannot be read."""

    def __init__(self, function: Callable[..., Any], program: Path, text: str) -> None:
        self._function, self._program, self._text = function, program, text

    def __call__(self, *arguments: Any) -> Any:
        try:
            return self._function(*arguments)
        except Exception:
            # Kernels raise nothing.
            with suppress(OSError):
                shutil.rmtree(self._program)
            self._function = _kept(self._program, self._text)[self._function.__name__]
            return self._function(*arguments)
