"""Versions of what results depend on."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import version

_PACKAGES = (
    "safe-envs",
    "gymnasium",
    "numpy",
    "scipy",
    "sympy",
    "proxsuite",
    "stable-baselines3",
    "torch",
)


def package_versions() -> dict[str, str]:
    """Versions of Python and of the packages on which results depend, by name."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    """Read once: each is in a file of its own."""
    return {
        "python": platform.python_version(),
        **{package: version(package) for package in _PACKAGES},
    }
