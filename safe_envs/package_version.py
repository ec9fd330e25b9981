"""Versions of packages, this one among them."""

from __future__ import annotations


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
