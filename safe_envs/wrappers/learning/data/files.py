"""Models, policies and data as files: arrays and JSON in an npz, no pickle, under a checksum."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from safe_envs import array_files
from safe_envs.array_files import ArrayFile, reading, write_arrays
from safe_envs.errors import shortened, shown
from safe_envs.package_version import package_version
from safe_envs.wrappers.learning.data.signature import Signature
from safe_envs.wrappers.learning.data.values import LearnedFileError, require_text

DATA = "transitions"
"""Kind of a file that holds data; others hold models or policies."""

_FORMAT = 2
_PACKAGES = ("safe-envs", "numpy", "sympy", "torch")


@dataclass(frozen=True)
class Content:
    """The content of a file.

    Attributes:
        kind: of model or data.
        signature: of which system.
        details: JSON-able.
        arrays: by name.
        sha256: checksum of it all.
    """

    kind: str
    signature: Signature
    details: dict[str, Any]
    arrays: dict[str, np.ndarray]
    sha256: str


def checksum(
    kind: str, signature: Signature, details: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> str:
    """Return the SHA-256 of everything that is saved, as hexadecimal digits.

    Args:
        kind: of model or data.
        signature: of which system.
        details: JSON-able.
        arrays: numbers by name.
    """
    return array_files.checksum([kind, asdict(signature), details], arrays)


def save(
    path: Path,
    kind: str,
    signature: Signature,
    details: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
) -> None:
    """Write a file, whole or not at all.

    Args:
        path: where.
        kind: of model or data.
        signature: of which system.
        details: JSON-able.
        arrays: numbers by name; none may be called "header".

    Raises:
        ConfigurationError: it cannot be written there, or would be too large to be read.
    """
    header = {
        "format": _FORMAT,
        "kind": kind,
        "signature": asdict(signature),
        "details": dict(details),
        "versions": {package: package_version(package) for package in _PACKAGES},
        "sha256": checksum(kind, signature, details, arrays),
    }
    write_arrays(path, header, arrays)


def load(path: Path, writer: str = "safe-envs identify") -> Content:
    """Read a file.

    Args:
        path: of the file.
        writer: command that writes such files, for the messages.

    Raises:
        LearnedFileError: it is missing, a folder, no such file, truncated or altered.
    """
    name = shortened(path)
    with reading(path, writer, LearnedFileError) as file:
        content = _content(name, file, writer)
    if content.sha256 != checksum(content.kind, content.signature, content.details, content.arrays):
        raise LearnedFileError(
            f"{name} was altered: its content does not match its checksum. Run `{writer}` again"
        )
    return content


def _content(name: str, file: ArrayFile, writer: str) -> Content:
    """Read a file; of what is no file of this project, nothing but the header."""
    header = file.header
    if header["format"] != _FORMAT:
        raise LearnedFileError(
            f"{name} has the format {shown(header['format'])}; this version reads {_FORMAT}. Run"
            f" `{writer}` again"
        )
    kind, signature, details = (
        require_text(header["kind"]),
        Signature.from_json(header["signature"]),
        dict(header["details"]),
    )
    return Content(kind, signature, details, file.arrays(), require_text(header["sha256"]))
