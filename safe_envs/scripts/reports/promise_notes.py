"""Notes on the bounds of promise filters."""

from __future__ import annotations

from collections.abc import Iterable

from safe_envs.wrappers.conditions.text_parts import names_promise


def computed_notes(names: Iterable[str]) -> list[str]:
    """Return what the bounds of promise filters are.

    Args:
        names: of the filters that have a bound.
    """
    found = [name for name in names if names_promise(name)]
    if not found:
        return []
    which = f"the bound of {found[0]} is" if len(found) == 1 else "bounds of promise filters are"
    return [
        f"{which} computed, not estimated: the mean of p_0 over the starts, which the filter keeps"
        " for every policy up to the horizon, in the floating-point numbers of its table."
    ]
