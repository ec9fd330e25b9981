"""Imports through the top-level links of a checkout.

There `wrappers`, `agents` and `scripts` are links into `safe_envs`. Without this module Python
would load every file a second time under its short name, and `wrappers.CBF` would be another class
than `safe_envs.wrappers.CBF`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import InspectLoader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import CodeType, ModuleType
from typing import Any


class _Alias(MetaPathFinder, InspectLoader):
    """Give `NAME.module` the module object of `safe_envs.NAME.module`."""

    def __init__(self, name: str) -> None:
        self._prefix = f"{name}."

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname.startswith(self._prefix) else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = import_module(f"safe_envs.{spec.name}")
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        # The import system has just overwritten the module's own spec with that of the alias.
        alias: Any = module.__spec__
        module.__spec__ = alias.loader_state

    def get_source(self, fullname: str) -> None:
        """Return no source: `get_code` does without."""

    def get_code(self, fullname: str) -> CodeType | None:
        """Return the code for `python -m scripts.evaluate` and the like."""
        spec: Any = find_spec(f"safe_envs.{fullname}")
        return spec.loader.get_code(spec.name)


def redirect(name: str) -> None:
    """Replace a package that was imported through its link by that of `safe_envs`.

    Args:
        name: Name of the link: "wrappers", "agents" or "scripts".
    """
    sys.meta_path.insert(0, _Alias(name))
    sys.modules[name] = import_module(f"safe_envs.{name}")
