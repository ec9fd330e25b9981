"""A folder of results by key, from which an interrupted run resumes."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

from safe_envs.errors import ConfigurationError, SafeEnvsError, shortened
from safe_envs.files import read_bytes, write_atomically
from safe_envs.lazy_attributes import package_version

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


MOST_BYTES = 30_000_000
"""Largest size of a file that is read; its content may take 25 times as much memory."""

_SHOWN = 200
"""Characters of a file's content, at most, that a message repeats."""

_STALE = 3600.0
"""Age in seconds from which a temporary file is abandoned: to write one takes under a second."""

_CHECKSUM = "sha256"

Document = dict[str, Any]


class ResultStore:
    """A folder with one JSON file per result, each written completely or not at all.

    A file holds the configuration of its result (everything that the result depends on), its
    content, and a checksum of both. So a result is reused for an equal configuration only, and a
    file that was damaged or altered is never taken for a result.

    Args:
        folder: created if it does not exist.

    Raises:
        ConfigurationError: the folder cannot be created.
    """

    def __init__(self, folder: Path) -> None:
        make_folder(folder)
        self._folder = folder

    def path(self, key: str) -> Path:
        """Return the path of the file of a key, whether or not it exists."""
        return self._folder / f"{key}.json"

    def keep(self, key: str, configuration: Mapping[str, Any], content: Mapping[str, Any]) -> None:
        """Write a result.

        Args:
            key: name of the file.
            configuration: all that the result depends on, versions included; JSON-able.
            content: the result, JSON-able, without the names "configuration" and "sha256".

        Raises:
            ConfigurationError: the file cannot be written, as on a full disk; the previous one
                remains.
        """
        document = {"configuration": configuration, **content}
        document[_CHECKSUM] = json_checksum(document)
        text = json.dumps(document, indent=1, allow_nan=False)

        def write(part: Path) -> None:
            with part.open("w") as file:
                file.write(text + "\n")
                # Some disks report only now that they are full.
                file.flush()
                os.fsync(file.fileno())

        write_atomically(self.path(key), write)

    def document(self, key: str) -> Document | None:
        """Return the content of a file with its configuration, whatever that is; None without one.

        Raises:
            ConfigurationError: the file is damaged or altered; see `reading`.
        """
        path = self.path(key)
        if not os.path.exists(path):
            return None
        with reading(path):
            document = json.loads(read_bytes(path, MOST_BYTES), parse_constant=_refuse)
            digest = document.pop(_CHECKSUM)
            if not isinstance(document["configuration"], dict):
                raise ValueError("it has no configuration")
            if digest != json_checksum(document):
                raise ValueError("its content does not match its checksum")
        return document

    def read(self, key: str, configuration: Mapping[str, Any]) -> Document | None:
        """Return the content that was kept for a key under an equal configuration, or None.

        Args:
            key: name of the file.
            configuration: as for `keep`.

        Raises:
            ConfigurationError: the file is damaged or altered.
        """
        document = self.document(key)
        return document if document and document["configuration"] == configuration else None

    def require_same_options(self, keys: Iterable[str], options: Mapping[str, Any]) -> None:
        """Check that no result of other options would be overwritten.

        Args:
            keys: of the results to look at.
            options: what the configuration of each is to hold under "options".

        Raises:
            ConfigurationError: one has other options, or its file is damaged or altered.
        """
        for key in keys:
            document = self.document(key)
            if document and (found := document["configuration"].get("options")) != options:
                raise ConfigurationError(
                    f"{self._folder} holds {key} by other options: {json.dumps(found)[:_SHOWN]};"
                    " give another --out, or the same options"
                )

    def remove_unfinished(self) -> None:
        """Remove the temporary files of runs that were killed; another run may write young ones."""
        remove_stale(self._folder, ".*.json")


def make_folder(folder: Path) -> None:
    """Create a folder for results, with those above it.

    Raises:
        ConfigurationError: it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"the folder {shortened(folder)} cannot be made: {error.strerror}; give another one"
        ) from error


def remove_stale(folder: Path, pattern: str) -> None:
    """Remove files of a pattern that nobody has written to for an hour.

    Args:
        folder: to look in.
        pattern: of the names.
    """
    for path in folder.glob(pattern):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > _STALE:
                path.unlink()


@contextmanager
def reading(path: Path, advice: str = "remove it, and it is computed again") -> Iterator[None]:
    """Report whatever the content of a damaged file raises as an error that names the file.

    Args:
        path: of the file or folder.
        advice: what the user can do, to end the message with.

    Returns:
        The context.

    Raises:
        ConfigurationError: the block raised an exception, other than one of this project's.
    """
    try:
        yield
    except SafeEnvsError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {shortened(error, _SHOWN)}"
        raise ConfigurationError(
            f"{path} cannot be read ({reason}); it is damaged or altered: {advice}"
        ) from error


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")
