"""The files that a cell of a sweep reads, by whose content it is known."""

from __future__ import annotations

import ast
import os
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from safe_envs.agents.policies.registry import policy_file
from safe_envs.bounded_reading import MOST_BYTES_OF_TEXT, read_bytes

_FILE = re.compile("(?<=file=)[^:+]+")


def absolute(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a cell with paths that mean the same in every process."""
    found = {
        **settings,
        "filter": _FILE.sub(lambda match: os.path.realpath(match.group()), settings["filter"]),
    }
    if policy_file(settings["policy"]) and os.path.exists(settings["policy"]):
        found["policy"] = os.path.realpath(settings["policy"])
    if "system" in settings:
        file, _, name = settings["system"].rpartition(":")
        found["system"] = f"{os.path.realpath(file)}:{name}"
    return found


def read_by(settings: Mapping[str, Any]) -> Iterator[Path]:
    """The files that a cell reads, of which those of Python may not be all: see `with_imported`.

    A policy that is not there is an unknown name, which `make_policy` says better.
    """
    if "system" in settings:
        yield Path(settings["system"].rpartition(":")[0])
    yield from (Path(match) for match in _FILE.findall(settings["filter"]))
    policy = policy_file(settings["policy"])
    if policy is not None and os.path.exists(policy):
        yield policy


def with_imported(path: Path) -> list[Path]:
    """A file, and where it is one of Python those of its own folder that it imports, or that these
    import.

    Nothing is run: every import statement counts, wherever in a file it stands. What is imported by
    another folder or by a name that is made while the code runs is not found.
    """
    found: dict[Path, None] = {}
    left = [path]
    while left:
        file = left.pop()
        if file not in found:
            found[file] = None
            left += [
                each
                for folder, names in _imports(file, path.parent)
                for each in _files_of(folder, names)
            ]
    return list(found)


def _imports(file: Path, root: Path) -> Iterable[tuple[Path, Sequence[str]]]:
    """The import statements of a file: each as the folder in which it begins, and the names down
    from there."""
    if file.suffix != ".py":
        return
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(read_bytes(file, MOST_BYTES_OF_TEXT))
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return  # Who runs it says what is wrong.
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((root, each.name.split(".")) for each in node.names)
        elif isinstance(node, ast.ImportFrom):
            folder = file.parents[node.level - 1] if node.level else root
            # What is imported from a package may be a module of it.
            yield from (
                (folder, [*(node.module or "").split("."), each.name]) for each in node.names
            )


def _files_of(folder: Path, names: Sequence[str]) -> Iterable[Path]:
    """The modules and packages that are there of a dotted name."""
    for name in filter(None, names):
        yield from (
            path
            for path in (folder / f"{name}.py", folder / name / "__init__.py")
            if path.is_file()
        )
        folder /= name
