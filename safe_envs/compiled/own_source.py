"""Objects that say themselves what they are in a compiled program."""

from __future__ import annotations

from typing import Any


def has_own_source(given: Any, *computing: str) -> bool:
    """Return whether an object has a method `source` that tells what it computes.

    That of a base tells nothing about a class that computes otherwise.

    Args:
        given: any object.
        computing: names of the methods by which it computes in NumPy.
    """
    classes = type(given).__mro__

    def place(name: str) -> int:
        return next((k for k, c in enumerate(classes) if name in vars(c)), len(classes))

    return place("source") < len(classes) and all(
        place("source") <= place(name) and name not in getattr(given, "__dict__", {})
        for name in computing
    )
