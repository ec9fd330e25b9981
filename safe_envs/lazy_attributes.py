"""Attributes of a package that are imported when they are first used.

Ids, errors and the help of a command are needed at once, and symbolic algebra, which most of what a
package exports imports, takes longer than all of these.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from types import ModuleType
from typing import Any

from safe_envs.errors import RENAMED


def lazy_attributes(
    package: str, modules: Mapping[str, str], namespace: dict[str, Any]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the functions `__getattr__` and `__dir__` of a package.

    Args:
        package: its name.
        modules: the full name of the module of each attribute.
        namespace: of the package, its `globals()`; an attribute is put there once it is imported.
    """

    def get(name: str) -> Any:
        if RENAMED.get(name) in modules:
            # No AttributeError, in place of which `from ... import` has a message of its own.
            raise ImportError(f"{name} of {package} is {RENAMED[name]} now")
        if name not in modules:
            return _module_in(package, name)
        found = namespace[name] = getattr(import_module(modules[name]), name)
        return found

    def names() -> list[str]:
        return sorted({*namespace, *modules})

    return get, names


def _module_in(package: str, name: str) -> ModuleType:
    """Import a module of a package that is used as its attribute, as in `safe_envs.envs`."""
    full = f"{package}.{name}"
    try:
        # What Python and its tools look for in any module, such as __wrapped__, is none.
        if not name.startswith("_"):
            return import_module(full)
    except ModuleNotFoundError as error:
        if error.name != full:
            raise
    raise AttributeError(f"module {package!r} has no attribute {name!r}")


def package_version(package: str = "safe-envs") -> str:
    """Return the version that is installed; "0+unknown" for a folder that is only on the path.

    Args:
        package: its name, this one by default.
    """
    # Not imported before it is needed: it takes as long as all that prints the help of a command.
    from importlib.metadata import PackageNotFoundError, version  # noqa: TID251

    try:
        return version(package)
    except PackageNotFoundError:
        return "0+unknown"
