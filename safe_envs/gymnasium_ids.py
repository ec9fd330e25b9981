"""Registration of this project's ids with Gymnasium, in whatever order the two are imported.

Gymnasium and NumPy take several times as long to import as a command needs to print its help. So
the package does not import them itself: where Gymnasium is there already, the ids are registered at
once, and else at the end of its import.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_GYMNASIUM = "gymnasium"


class _RegisteringLoader(Loader):
    """Load Gymnasium by its own loader, and register the ids then."""

    def __init__(self, own: Any, finder: MetaPathFinder) -> None:
        self._own, self._finder = own, finder

    def __getattr__(self, name: str) -> Any:
        if name == "_own":  # A copy asks before it has one.
            raise AttributeError(name)
        return getattr(self._own, name)

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._own.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        spec: Any = module.__spec__
        spec.loader = module.__loader__ = self._own
        self._own.exec_module(module)
        if self._finder in sys.meta_path:
            sys.meta_path.remove(self._finder)
        _register()


class _GymnasiumFinder(MetaPathFinder):
    """Find Gymnasium where the other finders do."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != _GYMNASIUM:
            return None
        for finder in sys.meta_path:
            find = None if finder is self else getattr(finder, "find_spec", None)
            spec = find and find(fullname, path, target)
            if spec is not None and spec.loader is not None:
                spec.loader = _RegisteringLoader(spec.loader, self)
                return spec
        return None


def register_with_gymnasium() -> None:
    """Register all ids now if Gymnasium is imported, or else as soon as it is."""
    if _GYMNASIUM in sys.modules:
        _register()
    else:
        # One of an earlier import of the package would ask this one, and this one that.
        sys.meta_path[:] = [f for f in sys.meta_path if type(f).__module__ != __name__]
        sys.meta_path.insert(0, _GymnasiumFinder())


def _register() -> None:
    from safe_envs.systems import register_all

    register_all()
