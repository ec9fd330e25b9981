"""Imports through the links at the top level of a checkout.

`wrappers`, `agents` and `scripts` name the modules of `safe_envs`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any


class _SameModule(Loader):
    """Return the module of `safe_envs` itself, never a second copy with other classes."""

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = import_module(f"safe_envs.{spec.name}")
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        # The import system has just written the alias' spec over the module's own.
        alias: Any = module.__spec__
        module.__spec__ = alias.loader_state
        module.__loader__ = module.__spec__.loader if module.__spec__ else None


class _LinkFinder(MetaPathFinder):
    """Find the modules below one link."""

    def __init__(self, name: str) -> None:
        self._below = f"{name}."

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, _SameModule()) if fullname.startswith(self._below) else None


def redirect(name: str) -> None:
    """Make a package imported through its link the package of that name in `safe_envs`.

    Args:
        name: of the link: "wrappers", "agents" or "scripts".
    """
    sys.meta_path.insert(0, _LinkFinder(name))
    sys.modules[name] = import_module(f"safe_envs.{name}")
