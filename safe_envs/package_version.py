"""The version of this package."""

from __future__ import annotations


def package_version() -> str:
    """Return the version that is installed; "0+unknown" for a folder that is only on the path."""
    # Not imported before it is needed: it takes as long as all that prints the help of a command.
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("safe-envs")
    except PackageNotFoundError:
        return "0+unknown"
