"""Checksums and versions that identify the code and the files that a result depends on."""

from __future__ import annotations

import hashlib
import json
import platform
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from safe_envs.bounded_reading import read_bytes
from safe_envs.errors import ConfigurationError, shortened
from safe_envs.package_version import package_version

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


_OPTIONAL = ("numba",)
"""Packages that round results in another way where they are installed."""


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages on which results depend, by name."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    """Read the versions once: each is in a file of its own."""
    return {
        "python": platform.python_version(),
        **{package: package_version(package) for package in _PACKAGES},
        **{package: package_version(package) for package in _OPTIONAL if find_spec(package)},
    }


@cache
def source_checksum(scripts: bool = True) -> str:
    """Return the SHA-256 of this project's code and data: a developer's change is a version.

    Args:
        scripts: include `safe_envs.scripts`, on which no evaluation depends.
    """
    digest = hashlib.sha256()
    root = Path(str(files("safe_envs")))
    for path in sorted(each for kind in ("py", "yaml", "json") for each in root.rglob(f"*.{kind}")):
        if scripts or not path.is_relative_to(root / "scripts"):
            digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def file_checksum(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises:
        ConfigurationError: the file cannot be read.
    """
    try:
        return hashlib.sha256(read_bytes(path)).hexdigest()
    except OSError as error:
        raise ConfigurationError(
            f"{shortened(path)} cannot be read ({error.strerror}); check the path, and that it is"
            " on a disk that all workers share"
        ) from error


def json_checksum(document: Any) -> str:
    """Return the SHA-256 of JSON-able data, whatever the order of its names."""
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
