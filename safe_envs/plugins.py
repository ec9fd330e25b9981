"""Extensions that other packages declare as entry points, found by name."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import os
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import cloudpickle

from safe_envs.errors import ConfigurationError, SafeEnvsError, nearest, shortened, shown
from safe_envs.files import MOST_BYTES_OF_TEXT, open_regular

if TYPE_CHECKING:
    from importlib.metadata import EntryPoints


CONDITIONS = "safe_envs.conditions"
POLICIES = "safe_envs.policies"
SYSTEMS = "safe_envs.systems"


def declared(group: str) -> EntryPoints:
    """Return what the packages on `sys.path` declare in a group; nothing is imported."""
    return _on_path(group, tuple(sys.path))


# Every reading of a filter's text asks for the names, and to look through packages takes long.
@functools.lru_cache(maxsize=16)
def _on_path(group: str, path: tuple[str, ...]) -> EntryPoints:
    # It takes as long to import as the rest of a command that prints its help.
    from importlib.metadata import entry_points

    return entry_points(group=group)


def plugin_names(group: str) -> tuple[str, ...]:
    """Return the names that installed packages declare in a group, sorted; nothing is imported."""
    return tuple(sorted(declared(group).names))


def name_of(group: str, extension: type) -> str | None:
    """Return the name under which an installed package declares a class; None if none does.

    Args:
        group: `CONDITIONS`, `POLICIES` or `SYSTEMS`.
        extension: the class.
    """
    value = f"{extension.__module__}:{extension.__qualname__}"
    return next((point.name for point in declared(group) if point.value == value), None)


def module_of(group: str, name: str) -> str | None:
    """Return the module that declares a name, which is not imported; None if no package does.

    Args:
        group: `CONDITIONS`, `POLICIES` or `SYSTEMS`.
        name: one of `plugin_names`.
    """
    return next((point.module for point in declared(group) if point.name == name), None)


def load_plugin(group: str, name: str) -> Any:
    """Import what an installed package declares under a name, which runs the code there.

    Args:
        group: `CONDITIONS`, `POLICIES` or `SYSTEMS`.
        name: one of `plugin_names`.

    Returns:
        The object.

    Raises:
        ConfigurationError: No package declares the name, more than one does, or its import fails.
    """
    found = {point.value: point for point in declared(group).select(name=name)}
    if not found:
        names = plugin_names(group)
        raise ConfigurationError(f"{group} has no {shown(name)}; {nearest(name, names)}")
    if len(found) > 1:
        raise ConfigurationError(
            f"{group}: {name!r} is declared more than once ({', '.join(sorted(found))});"
            " uninstall all but one of the packages"
        )
    (point,) = found.values()
    try:
        return point.load()
    except (Exception, SystemExit) as error:
        raise ConfigurationError(
            f"{group}: {name!r} ({point.value}) cannot be imported"
            f" ({type(error).__name__}: {shortened(error)}); repair or uninstall its package"
        ) from error


_ADVICE = "give the path of a Python file, as in my_system.py:problem"


def load_object(place: str) -> Any:
    """Import an object by its place, which runs the code there.

    A file is read again when it has changed, together with the modules of its folder that it
    imports.

    Args:
        place: FILE.py:NAME or MODULE:NAME.

    Raises:
        ConfigurationError: there is no such place, or the code there ends with an error.
    """
    source, colon, name = place.rpartition(":")
    if not (colon and source and name):
        raise ConfigurationError(
            f"{shown(place)} is not a place; give FILE.py:NAME or MODULE:NAME, like"
            " my_system.py:problem"
        )
    module = _of_file(Path(source)) if source.endswith(".py") else _of_module(source)
    if not hasattr(module, name):
        raise ConfigurationError(
            f"{shortened(source)} has no {shown(name)}; {nearest(name, _stated_in(module))}"
        )
    return getattr(module, name)


def resolved(place: str) -> str:
    """Return a place with the full path of its file, so that it holds in any folder."""
    source, _, name = place.rpartition(":")
    return f"{os.path.realpath(source)}:{name}" if source.endswith(".py") else place


def place_of(stated: type) -> str:
    """Return the place from which `load_object` imports a class.

    It is FILE.py:NAME for one of a script or of a file that was loaded by its place, MODULE:NAME
    for others.
    """
    name, place = stated.__module__, f"{stated.__module__}:{stated.__qualname__}"
    path = Path(getattr(sys.modules.get(name), "__file__", None) or "/")
    of_file = name in ("__main__", _module_name(path)) and path.suffix == ".py"
    return f"{path.resolve()}:{stated.__qualname__}" if of_file else place


def called(function: Callable[..., Any], place: str, arguments: dict[str, Any]) -> Any:
    """Call a function that was imported from a place, and return its value.

    Args:
        function: what was imported.
        place: FILE.py:NAME or MODULE:NAME of it, for errors.
        arguments: keyword arguments.

    Returns:
        What the function returns.

    Raises:
        ConfigurationError: an argument is missing or unknown, or the code there ends with an error.
    """
    try:
        inspect.signature(function).bind(**arguments)
    except TypeError as error:
        raise ConfigurationError(
            f"{place}: {error}; give its arguments by --barrier NAME=VALUE (in Python:"
            " barrier={...})"
        ) from error
    source = place.rpartition(":")[0]
    with _running(Path(source).resolve() if source.endswith(".py") else None, place):
        return function(**arguments)


def _stated_in(module: ModuleType) -> list[str]:
    """List what a module defines itself: no modules, classes or symbols."""
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and not inspect.ismodule(value)
        and getattr(value, "__module__", module.__name__)
        in (
            module.__name__,
            "safe_envs.problem.problem",
            "safe_envs.wrappers.external_env",
        )
    ]


def _of_file(path: Path) -> ModuleType:
    try:
        with open_regular(path, MOST_BYTES_OF_TEXT) as stream:
            changed = os.fstat(stream.fileno()).st_mtime_ns
    except FileNotFoundError as error:
        raise ConfigurationError(f"there is no file {shortened(path)}; {_ADVICE}") from error
    except OSError as error:
        raise ConfigurationError(
            f"{shortened(path)} cannot be read: {error.strerror}; {_ADVICE}"
        ) from error
    main = sys.modules["__main__"]
    # The script that runs is there already; a second run would state its classes again.
    if Path(getattr(main, "__file__", None) or "/").resolve() == path.resolve():
        return main
    return _loaded(path.resolve(), changed)


def _module_name(path: Path) -> str:
    return f"_{path.stem}_{zlib.crc32(bytes(path)):08x}"


@lru_cache(maxsize=32)
def _loaded(path: Path, _changed: int) -> ModuleType:
    """Import a file, once until it changes, so that its symbols are compiled once."""
    name = _module_name(path)
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigurationError(f"{path} cannot be read as Python")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    # Another process does not have this module: what is sent there takes its functions along.
    cloudpickle.register_pickle_by_value(module)
    try:
        with _running(path, str(path)):
            spec.loader.exec_module(module)
    except SafeEnvsError:
        cloudpickle.unregister_pickle_by_value(module)
        del sys.modules[name]
        raise
    return module


def _of_module(name: str) -> ModuleType:
    if name in sys.modules:
        return sys.modules[name]
    with _running(None, f"module {shortened(name)} (a file is named with .py)"):
        return importlib.import_module(name)


@contextmanager
def _running(path: Path | None, what: str) -> Iterator[None]:
    """Run a user's code: its errors become ours, with the line."""
    # Modules in its folder can be imported, as when Python runs it.
    folder = None if path is None else str(path.parent)
    known = set(sys.modules)
    if folder is not None:
        sys.path.insert(0, folder)
    try:
        yield
    except SafeEnvsError as error:
        raise type(error)(f"{what}{_line(error, path)}: {error}") from error
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {shortened(error, 400)}"
        raise ConfigurationError(
            f"{what} ended with an error{_line(error, path)}: {reason}"
        ) from error
    finally:
        if folder is not None:
            sys.path.remove(folder)
            # Another file may have a neighbour of the same name.
            for name in set(sys.modules) - known:
                if (
                    Path(getattr(sys.modules[name], "__file__", None) or "/").parent == Path(folder)
                    and sys.modules[name].__name__ == name
                ):
                    del sys.modules[name]


def _line(error: BaseException, path: Path | None) -> str:
    """Return the last line of the file that led to an error."""
    lines, trace = [], error.__traceback__
    while trace is not None:
        if path is not None and trace.tb_frame.f_code.co_filename == str(path):
            lines.append(trace.tb_lineno)
        trace = trace.tb_next
    return f" in line {lines[-1]}" if lines else ""
