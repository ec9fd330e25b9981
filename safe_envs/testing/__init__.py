"""Checks for authors of conditions, policies and systems, as Gymnasium's `check_env` is for envs.

Each raises an `AssertionError` that names the property that does not hold.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from safe_envs.testing.condition import check_condition
    from safe_envs.testing.policy import check_policy
    from safe_envs.testing.system import check_system

__all__ = ["check_condition", "check_policy", "check_system"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(f"{__name__}.{name.removeprefix('check_')}")
    return getattr(module, name)
