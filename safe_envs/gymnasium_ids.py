"""Registration of this project's ids with Gymnasium, in whatever order the two are imported.

Gymnasium and NumPy take several times as long to import as a command needs to print its help, and
Gymnasium loads no entry points. So the package does not import them itself: where Gymnasium is
there already, the ids are registered at once, and else at the end of its import.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from safe_envs.systems import register_all

_GYMNASIUM = "gymnasium"


class _GymnasiumFinder(MetaPathFinder):
    """Find Gymnasium where the other finders do, and let its loader register the ids."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != _GYMNASIUM:
            return None
        for finder in sys.meta_path:
            find = None if finder is self else getattr(finder, "find_spec", None)
            spec = find and find(fullname, path, target)
            if spec is not None and spec.loader is not None:
                spec.loader.exec_module = partial(_execute, spec.loader)
                return spec
        return None


def _execute(loader: Any, module: ModuleType) -> None:
    """Execute Gymnasium by its own loader, then register the ids."""
    del loader.exec_module
    loader.exec_module(module)
    _remove_finders()
    register_all()


def _remove_finders() -> None:
    """Forget the finder, also one of an earlier import of this package."""
    sys.meta_path[:] = [f for f in sys.meta_path if type(f).__module__ != __name__]


def register_with_gymnasium() -> None:
    """Register all ids now if Gymnasium is imported, or else as soon as it is."""
    if _GYMNASIUM in sys.modules:
        register_all()
    else:
        _remove_finders()
        sys.meta_path.insert(0, _GymnasiumFinder())
