"""What is attainable from the starts of a problem, kept in the user's cache next to its table.

To read the table and to look ahead from thousands of starts takes seconds.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import sympy as sp

from safe_envs.agents.evaluation.attainable import AttainableSafety
from safe_envs.atomic_io import write_atomically
from safe_envs.bounded_reading import read_json
from safe_envs.errors import ConfigurationError
from safe_envs.problem.problem import SafetyProblem
from safe_envs.user_cache import cache_folder, make_room, mark_used
from safe_envs.wrappers.value.settings import ValueSettings
from safe_envs.wrappers.value.table_cache import table_key

FOLDER = "attainable"
"""Name of the folder in the user's cache."""


def place_of(problem: SafetyProblem, settings: ValueSettings) -> Path | None:
    """Return the file for what is attainable; None without a cache.

    Args:
        problem: with the starts.
        settings: of the table.

    Raises:
        ConfigurationError: No grid takes the problem.
    """
    folder = cache_folder(FOLDER)
    if folder is None:
        return None
    start = problem.starts[problem.start]
    condition = None if start.condition is None else problem.model.numeric(start.condition)
    parts = (*start.state, *start.uniforms, *problem.model.states, sp.sympify(condition or 0))
    described = [table_key(problem, settings), [sp.srepr(sp.sympify(each)) for each in parts]]
    digest = hashlib.sha256(json.dumps(described).encode()).hexdigest()
    return folder / f"{digest}.json"


def kept_attainable(place: Path | None) -> AttainableSafety | None:
    """Return what is kept in a file; None where there is none, or none to rely on."""
    if place is None or not place.is_file():
        return None
    try:
        found = AttainableSafety(**read_json(place, "remove it"))
        found = replace(
            found, coordinates=tuple(found.coordinates), cells=tuple(map(int, found.cells))
        )
        ends = [0.0, *(end for end in (found.lower, found.upper) if end is not None), 1.0]
        if ends != sorted(ends):
            return None
    except (ConfigurationError, TypeError, ValueError):
        return None
    mark_used(place)
    return found


def keep_attainable(found: AttainableSafety, place: Path | None) -> None:
    """Keep what is attainable, before anything was measured, in a file.

    Args:
        found: with both ends.
        place: of the file; None keeps nothing.
    """
    if place is None:
        return
    text = json.dumps(vars(found))
    try:
        write_atomically(place, lambda path: path.write_text(text))
    except (ConfigurationError, OSError):  # The disk may be full.
        return
    make_room()
