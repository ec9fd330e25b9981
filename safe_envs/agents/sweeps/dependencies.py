"""The files that a cell of a sweep reads, whose content is part of its key."""

from __future__ import annotations

import ast
import importlib.util
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from safe_envs.agents.policies.names import absolute_policy, policy_files, policy_module
from safe_envs.bounded_reading import MOST_BYTES_OF_TEXT, read_bytes
from safe_envs.wrappers.conditions.names import AT_STATE
from safe_envs.wrappers.conditions.text_parts import files_of, modules_of, with_absolute_paths


def absolute(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a cell with paths that mean the same in every process."""
    text = settings["filter"]
    at = AT_STATE if text.endswith(AT_STATE) else ""
    found = {**settings, "filter": with_absolute_paths(text.removesuffix(AT_STATE)) + at}
    found["policy"] = absolute_policy(settings["policy"])
    if "system" in settings:
        file, _, name = settings["system"].rpartition(":")
        found["system"] = f"{os.path.realpath(file)}:{name}"
    return found


def read_by(settings: Mapping[str, Any]) -> Iterator[Path]:
    """Yield the files that a cell reads, without those that they import: see `with_imported`.

    A policy that does not exist is an unknown name, which `make_policy` reports.
    """
    if "system" in settings:
        yield Path(settings["system"].rpartition(":")[0])
    yield from files_of(settings["filter"].removesuffix(AT_STATE))
    yield from filter(os.path.exists, policy_files(settings["policy"]))


def installed(settings: Mapping[str, Any]) -> Iterator[Path]:
    """Yield the Python files of the packages whose conditions and policy a cell uses.

    All files of a package count, but not what it imports from others. Nothing is run.
    """
    named = modules_of(settings["filter"].removesuffix(AT_STATE))
    modules = (*named, policy_module(settings["policy"]))
    for top in dict.fromkeys(module.split(".")[0] for module in modules if module):
        try:
            spec = importlib.util.find_spec(top)
        except ValueError:  # of a script that runs, which has none
            continue
        if spec is None or top == "safe_envs":  # the versions of a cell hold its own code
            continue
        folders = spec.submodule_search_locations
        if folders is not None:
            yield from (path for folder in folders for path in sorted(Path(folder).rglob("*.py")))
        elif spec.origin is not None and spec.origin.endswith(".py"):
            yield Path(spec.origin)


def with_imported(path: Path) -> list[Path]:
    """Return a file, and if it is Python the files of its folder that it imports, or that these do.

    Nothing is run: every import statement counts, wherever in a file it is. Imports from another
    folder, or by a name that is computed at run time, are not found.
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
    """Yield the imports of a file: the folder in which each begins, and the names below it."""
    if file.suffix != ".py":
        return
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(read_bytes(file, MOST_BYTES_OF_TEXT))
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return  # whoever runs it reports what is wrong
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
    """Yield the existing modules and packages of a dotted name."""
    for name in filter(None, names):
        yield from (
            path
            for path in (folder / f"{name}.py", folder / name / "__init__.py")
            if path.is_file()
        )
        folder /= name
