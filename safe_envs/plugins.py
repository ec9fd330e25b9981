"""Extensions that other packages declare as entry points, found by name."""

from __future__ import annotations

import functools
import sys
from typing import TYPE_CHECKING, Any

from safe_envs.errors import ConfigurationError, nearest, shortened, shown

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
