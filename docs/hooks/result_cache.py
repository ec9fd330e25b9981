"""Results of examples, notebooks and pictures, reused from one build of the site to the next.

An entry is found by a checksum of everything that it depends on: the example itself, this project's
code and examples, these hooks, and the versions of all installed packages. So it is used as long as
running the example would repeat what it did. Prose is not part of it.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import platform
from collections.abc import Callable
from functools import cache
from importlib.metadata import distributions
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from safe_envs.files import own_cache, write_atomically

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / ".docs_cache"

_BYTES = "base64:"

_used: set[Path] = set()


def cached(subject: Any, make: Callable[[], Any]) -> Any:
    """Return what `make` returned when it was called for this subject and this code, or call it.

    Args:
        subject: JSON-able data, all that the result depends on but for the project and packages.
        make: returns JSON-able data, in which bytes may be the values of a dict. It is called with
            a cache of its own for tables of values, so that a page does not depend on what the
            user, or another page, has computed before.
    """
    about = json.dumps([subject, _checksum_at_start(), _packages()])
    digest = hashlib.sha256(about.encode()).hexdigest()
    path = FOLDER / f"{digest}.json"
    _used.add(path)
    with contextlib.suppress(OSError, ValueError):
        return json.loads(path.read_text(), object_hook=_decoded)
    with own_cache():
        found = make()
    # Code that was edited meanwhile may have been imported before or after the edit.
    if code_checksum() == _checksum_at_start():
        FOLDER.mkdir(exist_ok=True)
        text = json.dumps(found, default=_encoded)
        write_atomically(path, lambda temporary: temporary.write_text(text))
    return found


def forget_unused() -> None:
    """Remove the entries that the builds of this process have not asked for."""
    for path in set(FOLDER.glob("*.json")) - _used:
        path.unlink(missing_ok=True)


def code_checksum() -> str:
    """Return a checksum of the files that examples are run with, as they are now."""
    package = find_spec("safe_envs")
    digest = hashlib.sha256()
    for folder in (
        *map(Path, (package and package.submodule_search_locations) or ()),
        ROOT / "examples",
        ROOT / "docs" / "hooks",
    ):
        for path in sorted(folder.rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                digest.update(f"{path.relative_to(folder)}\0".encode())
                digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


@cache
def _checksum_at_start() -> str:
    return code_checksum()


@cache
def _packages() -> list[str]:
    return [
        platform.python_version(),
        platform.machine(),
        *sorted(f"{each.name} {each.version}" for each in distributions()),
    ]


def _encoded(value: bytes) -> dict[str, str]:
    return {_BYTES: base64.b64encode(value).decode()}


def _decoded(found: dict[str, Any]) -> Any:
    return base64.b64decode(found[_BYTES]) if _BYTES in found else found
